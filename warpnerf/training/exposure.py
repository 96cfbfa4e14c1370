"""Exposures of photographs: what each does to the field's colours, fitted while that learns them.

Photographs of one scene differ in exposure and white balance where a camera chooses both for each.
A field that all of them train then has to be all of these at once: it makes up for them with fog
near the cameras, which each camera sees alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vec3
from warpnerf_kernels.optim import exposure as kernels

from warpnerf.checks import InputError
from warpnerf.config import Appearance
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.parameters import Parameter
from warpnerf.rendering.rays import RayBatch
from warpnerf.runtime.parallel import RAYS, LaunchCache, Workers
from warpnerf.scenes.scene import Scene
from warpnerf.training.peers import Peers

BEGIN, FIRST_RAYS = 0.05, 200_000
"""Share of the training, and rays, before the first fit: a field that shows nothing yet has the
mean colour of each photograph explained by its exposure."""
LATEST = 0.06
"""Share of the training after which auto no longer begins: the training is too short to judge in,
and to recover where photographs turn out to be alike."""
JUDGED, JUDGED_RAYS = 0.08, 1_300_000
"""Share of the training, and rays, after which auto judges whether photographs differ: a field that
is still blurred shows differences between photographs of one exposure."""
JUDGED_BY = 0.4
"""Share of the training after which it judges, however few rays a time limit leaves for."""
DIFFERENT = 0.06
"""Deviation of the logarithm of their brightness from which they do. Single channels deviate more,
also of photographs of one exposure, where colours depend on the direction of view."""
WINDOW = 4000.0
"""Rays of a photograph, after which the weight of those before has fallen to 1/e."""
PRIOR = 50.0
"""Rays, of colours that are uniform and the same in photograph and field, which each photograph has
besides its own."""
NUMBERS = 3 * kernels.MOMENTS
"""Sums of a photograph."""
STATE = "exposures"
"""The name of what checkpoints keep."""


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """What a photograph does to the field's colours: pixel = gain colour + offset."""

    gain: tuple[float, float, float]
    """Of red, green and blue, above 0; the geometric mean over photographs is 1."""
    offset: tuple[float, float, float]
    """Of the same, of colours in [0, 1]; the mean over photographs is 0."""


class Exposures:
    """Exposures of the photographs of a training, and the sums that they are fitted to."""

    def __init__(
        self,
        n_views: int,
        workers: Workers,
        settled: bool = True,
        state: dict[str, wp.array] | None = None,
    ) -> None:
        """Those that change nothing, or those of a training to be resumed.

        Args:
            n_views: Photographs.
            workers: Where to work.
            settled: Whether they stay, whatever ``judged`` would find.
            state: Of that training.

        Raises:
            InputError: It is not of so many photographs.
        """
        device = workers.device
        self._workers = workers
        self._in_turn = workers if device.is_cuda else Workers("cpu", 1)
        self._launches = LaunchCache()
        self.gains = wp.ones(n_views, dtype=vec3, device=device)
        """[n_views] vec3, by which photographs are drawn."""
        self.offsets = wp.zeros(n_views, dtype=vec3, device=device)
        """[n_views] vec3, likewise."""
        self._moments = wp.zeros((1, n_views * NUMBERS), device=device)
        self.settled = settled
        """Whether it is known that photographs differ, or does not matter."""
        self.used = False
        """Whether something was fitted, and photographs have been drawn by it."""
        self.sums = wp.zeros(n_views * NUMBERS, device=device)
        """[n_views * 3 * 5], see ``warpnerf_kernels.optim.exposure``."""
        if state is not None:
            self.sums, self.settled = state["sums"], bool(state["settled"].numpy()[0])
            if self.sums.size != n_views * NUMBERS:
                raise InputError(
                    f"the training to be resumed has exposures of {self.sums.size // NUMBERS} "
                    f"photographs, but the scene has {n_views}; bring its photographs back, or "
                    "start a new training."
                )
            self.used = bool(self.sums.numpy().any())
            self.fit(0)

    def add(self, batch: RayBatch, rgb: wp.array, fraction: float, drawn: int) -> None:
        """Take rays of a batch in, those of opaque pixels that are neither black nor white.

        Args:
            batch: As it was drawn.
            rgb: [n_rays] vec3, what was rendered.
            fraction: Of the training, that is done. The first rays are taken in after BEGIN, those
                that follow always: a limit may be raised.
            drawn: Rays of the steps done, FIRST_RAYS or more likewise.
        """
        self.used = self.used or (fraction >= BEGIN and drawn >= FIRST_RAYS)
        if not self.used:
            return
        self._in_turn.launch(
            kernels.add_moments,
            batch.count,
            *(batch.views, rgb, batch.target_rgb, self.gains, self.offsets, self._moments),
            at_once=RAYS,
            cache=self._launches,
        )

    def judged(self, fraction: float, drawn: int, peers: Peers) -> Exposures | None:
        """Whether photographs differ, once it is time to say so, and from then on as was said.

        Args:
            fraction: Of the training, that is done.
            drawn: Rays of the steps done.
            peers: The first of them judges.

        Returns:
            These, or None: photographs are alike, and drawn as they are from now on.
        """
        if self.settled:
            return self
        if not self.used:
            return None if fraction > LATEST else self
        if fraction < JUDGED or (drawn < JUDGED_RAYS and fraction < JUDGED_BY):
            return self
        self.settled = peers.from_first(self._differ)
        if self.settled:
            return self
        self.gains.fill_(vec3(1.0, 1.0, 1.0))
        self.offsets.zero_()
        return None

    def _differ(self) -> bool:
        found = brightness(self.gains.numpy(), self.offsets.numpy())
        return bool(np.log(found).std() >= DIFFERENT)

    @cached_property
    def accumulated(self) -> tuple[Gradients, Parameter]:
        """What was taken in since the last fit, as several processes add it up: as the gradient of
        weights is, which no rule updates."""
        gradients = Gradients(arrays={"weights": self._moments}, struct=None)
        parameter = Parameter(
            name=STATE,
            values=self.sums,
            rule="weights",
            learning_rates=np.zeros(1),
            gradient=("weights",),
        )
        return gradients, parameter

    def fit(self, n_rays: int) -> None:
        """Fit the exposures to what was taken in.

        Args:
            n_rays: Drawn since the last time, of all photographs.
        """
        if not self.used:
            return
        n_views = len(self.gains)
        kept = math.exp(-n_rays / (n_views * WINDOW))
        found = self.gains, self.offsets
        given = kept, PRIOR, self._moments, self.sums
        self._workers.launch(kernels.fit_exposures, n_views, *given, *found)
        self._workers.launch(kernels.centre_exposures, 3, *found)

    @property
    def state(self) -> dict[str, dict[str, wp.array]]:
        """What a checkpoint keeps; the sums are live."""
        settled = wp.array([float(self.settled)], dtype=wp.float32, device=self.sums.device)
        return {STATE: {"sums": self.sums, "settled": settled}}

    def in_words(self, names: Sequence[str]) -> str:
        """How far they differ.

        Args:
            names: Of the photographs.
        """
        grey = brightness(self.gains.numpy(), self.offsets.numpy())
        low, high = int(grey.argmin()), int(grey.argmax())
        return (
            f"exposures: where the scene is grey, {names[low]} is {grey[low]:.2f} times as bright, "
            f"{names[high]} {grey[high]:.2f} times"
        )

    def by_name(self, names: Sequence[str]) -> dict[str, Exposure]:
        """The exposures as they stand.

        Args:
            names: Of the photographs.
        """
        pairs = zip(self.gains.numpy().tolist(), self.offsets.numpy().tolist(), strict=True)
        found = (Exposure(gain=tuple(gain), offset=tuple(offset)) for gain, offset in pairs)
        return dict(zip(names, found, strict=True))


def exposures_of(
    scene: Scene, appearance: Appearance, workers: Workers, kept: dict[str, wp.array] | None
) -> Exposures | None:
    """The exposures of a training's photographs, where it is to fit them.

    Args:
        scene: What is trained on.
        appearance: ``TrainConfig.appearance``.
        workers: Where to work.
        kept: By a checkpoint, of a training to be resumed.

    Raises:
        InputError: There is one photograph, or they are not those of the checkpoint.
    """
    if appearance == "none":
        return None
    n_views = len(scene.splits["train"])
    if appearance == "affine" and n_views == 1:
        raise InputError(
            f"appearance is affine, but {scene.name} has one training photograph, and none that it "
            "could differ from; leave --appearance out."
        )
    return Exposures(n_views, workers, appearance == "affine", kept)


def in_use(exposures: Exposures | None) -> Exposures | None:
    """Those by which photographs have been drawn; None: these were taken as they are."""
    return None if exposures is None or not exposures.used else exposures


def brightness(gains: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """How much brighter each photograph is where the field is half grey.

    Args:
        gains: [n_views, 3].
        offsets: [n_views, 3].

    Returns:
        [n_views], at least 0.001.
    """
    return np.maximum((gains + 2.0 * offsets).mean(axis=1), 1e-3)


def are_sums(sums: np.ndarray) -> bool:
    """Whether numbers can be sums over rays: finite, counts and variances not below 0, to rounding.

    Args:
        sums: [n_views * NUMBERS], in any shape.
    """
    n, x, _, xx, _ = sums.reshape(-1, kernels.MOMENTS).T.astype(np.float64)
    return bool(np.isfinite(sums).all() and (n >= 0).all() and (n * xx - x * x >= -n).all())
