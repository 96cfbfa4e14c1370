"""What limits a training's quality: voxels, photographs or time, and what to try next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.scenes.extent.space_plan import BLUR_POWER
from warpnerf.training.state import Progress

if TYPE_CHECKING:
    from warpnerf.training.trainer import Trainer

SHARP = 1.5
"""Pixels: narrower voxels hardly blur."""
USUAL_GAP = 1.5
"""dB by which test views lie below training views where there are photographs enough."""
USUAL_RISE = 0.5
"""dB that the PSNR rises in the last third of a training that has had time enough: learning rates
fall then."""
USUAL_CORRECTION = 0.3
"""dB by which test views come closer where their colours are corrected, of photographs of one
exposure."""
NOTABLE = 0.5
"""dB that a limit is thought to cost before it is named."""


@dataclass(frozen=True, kw_only=True)
class Limit:
    """What a training's quality is limited by most."""

    name: str
    """voxels, photographs, time, exposures; or nothing: none of these stands out."""
    cost: float
    """About how many dB it costs, a guess."""
    sentence: str
    """What was seen, and what to try next."""

    def __str__(self) -> str:
        """The sentence."""
        return self.sentence


def voxel_pixels(trainer: Trainer) -> float | None:
    """Width of a voxel of the grid that a training has now, where cameras look.

    Args:
        trainer: Of the training.

    Returns:
        Pixels, the median; None: nodes do not say how fine the field is.
    """
    if not trainer.config.field.as_fine_as_nodes:
        return None
    plan, lattice = trainer.plan, trainer.lattice
    # As planned, with what cameras were found to see, which a scene that is read again does not
    # tell. A tighter box, and numbers of nodes that are whole, make voxels smaller or larger.
    edge = lattice.space.voxel_edge(math.prod(lattice.size))
    return plan.voxel_pixels.median * edge / plan.space.voxel_edge(plan.config.grid.n_nodes)


def what_limits(
    reports: Sequence[Progress],
    width: float | None,
    test: Mapping[str, float] | None,
    exposed: bool = False,
) -> Limit | None:
    """What limits the quality of a training.

    Args:
        reports: Of the training, from its first to its last.
        width: Of a voxel of the final grid where cameras look, pixels; None: voxels do not say how
            fine the field is.
        test: Mean metrics of its test views, psnr and cc_psnr among them; None: there are none.
        exposed: Whether exposures of photographs were fitted: those of test views were not, so that
            cc_psnr tells how good these are.

    Returns:
        What costs most, by thresholds that are rules of thumb; None: there are too few reports, as
        of a training that was resumed near its end.
    """
    done = np.array([report.fraction for report in reports])
    psnr = np.array([report.picture_psnr for report in reports])
    late, before = done > 0.9, (done > 0.55) & (done <= 0.7)
    if not (late.any() and before.any()):
        return None
    # Pixels are averaged on coarser grids, which makes PSNR higher.
    size = reports[int(np.flatnonzero(before)[-1])].size
    before &= np.array([report.size == size for report in reports])
    reached = float(psnr[late].mean())
    rise = reached - float(psnr[before].mean())
    # A field that has become finer is worse at first: with more time it gets past where it was.
    grew = math.prod(reports[-1].size) > math.prod(reports[int(np.sum(done <= 2.0 / 3.0)) - 1].size)
    change = abs(rise) if grew else rise
    risen = f"{'fell' if rise < 0.0 else 'rose'} by {abs(rise):.1f} dB in the last third"
    psnr_of_test = reached if test is None else test["cc_psnr" if exposed else "psnr"]
    gap = reached - psnr_of_test
    gain = 0.0 if test is None else test["cc_psnr"] - psnr_of_test
    corrected = " with their colours corrected" if exposed else ""
    of_exposures = max(gain - USUAL_CORRECTION, 0.0)
    wide = "" if width is None else f"voxels are {width:.2g} pixels wide, "
    pixels = SHARP if width is None else max(width, SHARP)
    limits = [
        Limit(
            name="voxels",
            cost=10.0 * BLUR_POWER * math.log10(pixels / SHARP),
            sentence=f"limited by voxels: one is {pixels:.2g} pixels wide where cameras look; try "
            "more --voxels, or a smaller --box",
        ),
        Limit(
            name="photographs",
            cost=gap - of_exposures - USUAL_GAP,
            sentence=f"limited by photographs: training views reach {reached:.1f} dB, test views "
            f"{reached - gap:.1f}{corrected}; try photographs from more places, or fewer --voxels",
        ),
        Limit(
            name="time",
            cost=change - USUAL_RISE,
            sentence=f"limited by time: PSNR of training views {risen}"
            f"{', in which the grid grew' if grew and rise < 0.0 else ''}; try more --steps, and a "
            "longer --time-limit where there is one",
        ),
        Limit(
            name="exposures",
            cost=of_exposures,
            sentence=f"limited by exposures: test views come {gain:.1f} dB closer with their "
            "brightness and white balance corrected; try --appearance affine",
        ),
    ]
    most = max(limits, key=lambda limit: limit.cost)
    if most.cost < NOTABLE:
        return Limit(
            name="nothing",
            cost=0.0,
            sentence=f"neither voxels nor photographs nor time stands out as a limit: {wide}"
            f"training views reach {reached:.1f} dB, and {risen}",
        )
    return most
