"""What limits a training is named, the largest cost first."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_trainings import ball
from warpnerf.config import GridConfig
from warpnerf.model.storage_kinds import Hash
from warpnerf.presets import PRESETS
from warpnerf.reports.limits import voxel_pixels, what_limits
from warpnerf.scenes.extent.sharpness import sharpness
from warpnerf.training.plan import resolve
from warpnerf.training.state import Progress


def reports(rise: float, seen: float = 1.0, n: int = 100) -> list[Progress]:
    """Of a training whose PSNR rises to 30 dB over whole pictures, by so much in the last third."""
    return [
        Progress(
            step=100 * k,
            fraction=float(k / n),
            seconds=float(k),
            loss=0.1,
            psnr=30.0 - rise * (1.0 - k / n) * 3.0 + 10.0 * np.log10(seen),
            samples_per_ray=20.0,
            size=(9, 9, 9),
            occupied=0.1,
            seen=seen,
        )
        for k in range(1, n + 1)
    ]


def metrics_of(psnr: float | None) -> dict[str, float] | None:
    """Of test views of the same exposure."""
    return None if psnr is None else {"psnr": psnr, "cc_psnr": psnr + 0.1}


@pytest.mark.parametrize(
    ("rise", "pixels", "test_psnr", "name", "says"),
    [
        (0.3, 4.5, 29.0, "voxels", "4.5 pixels wide where cameras look; try more --voxels"),
        (0.3, 1.3, 26.2, "photographs", "training views reach 30.0 dB, test views 26.2; try photo"),
        (3.0, 1.3, 29.0, "time", "rose by 2.9 dB in the last third; try more --steps"),
        (3.0, 1.3, None, "time", "rose by 2.9 dB"),
        (0.3, 1.5, 29.0, "nothing", "neither voxels nor photographs nor time stands out"),
        (0.3, None, 29.0, "nothing", "as a limit: training views reach 30.0 dB"),
    ],
)
def test_the_largest_is_named(
    rise: float, pixels: float | None, test_psnr: float | None, name: str, says: str
) -> None:
    limit = what_limits(reports(rise), pixels, metrics_of(test_psnr))
    assert limit is not None and limit.name == name
    assert says in str(limit)


def test_a_fall_is_called_so_and_is_for_want_of_time_where_the_grid_has_just_grown() -> None:
    """Colours of what is not yet clear come closer where they are corrected, too."""
    test = {"psnr": 28.0, "cc_psnr": 30.2}
    fallen = what_limits(reports(-5.0), 1.3, test)
    assert fallen is not None and fallen.name == "exposures"
    grown = [
        replace(report, size=(20, 20, 20)) if report.fraction > 0.75 else report
        for report in reports(-5.0)
    ]
    limit = what_limits(grown, 1.3, test)
    assert limit is not None and limit.name == "time"
    assert "fell by 4.9 dB in the last third, in which the grid grew; try more --st" in str(limit)
    before = [replace(r, size=(20, 20, 20)) if r.fraction > 0.6 else r for r in reports(-5.0)]
    fallen = what_limits(before, 1.3, test)
    assert fallen is not None and fallen.name == "exposures"
    # Of the third before the last, those of the coarser grid do not count: pixels were averaged.
    coarse = [
        replace(r, size=(5, 5, 5), psnr=r.psnr + 9.0) if r.fraction < 0.6 else r
        for r in reports(3.0)
    ]
    limit = what_limits(coarse, 1.3, metrics_of(29.0))
    assert limit is not None and "rose by 2.7 dB in the last third" in str(limit)
    nothing = what_limits(reports(-0.9), 1.3, metrics_of(29.0))
    assert nothing is not None and str(nothing).endswith("and fell by 0.9 dB in the last third")


def test_exposures_are_named_where_corrected_colours_come_closer() -> None:
    for test, corrected, name in ((28.1, 28.4, "nothing"), (26.4, 27.9, "exposures")):
        limit = what_limits(reports(0.3), 1.3, {"psnr": test, "cc_psnr": corrected})
        assert limit is not None and limit.name == name
    fitted = what_limits(reports(0.3), 1.3, {"psnr": 22.0, "cc_psnr": 28.4}, exposed=True)
    assert fitted is not None and fitted.name == "nothing"  # test views have others
    assert "come 1.5 dB closer" in str(limit) and "try --appearance affine" in str(limit)


def test_pixels_that_meet_nothing_count() -> None:
    """As they do in test views: or an object that fills a tenth of them has 10 dB less."""
    assert reports(0.3, seen=0.1)[-1].picture_psnr == pytest.approx(30.0)
    limit = what_limits(reports(0.3, seen=0.1), 1.3, metrics_of(26.2))
    assert limit is not None and limit.name == "photographs"


def test_the_width_of_voxels_is_that_of_the_plan_in_the_box_that_there_is() -> None:
    """Also where a run is resumed, whose scene does not tell what a short training found."""
    config = replace(PRESETS["fast"], grid=GridConfig(voxels=8000))
    plan = resolve(ball(), config)
    space = plan.space
    half = 0.5 * (space.box_max - space.box_min)
    tight = replace(space, box_min=space.box_min + 0.5 * half, box_max=space.box_max - 0.5 * half)
    for now, share in ((space, 1.0), (tight, 0.5)):
        lattice = SimpleNamespace(space=now, size=(20, 20, 20))
        trainer: Any = SimpleNamespace(config=config, plan=plan, lattice=lattice, scene=None)
        width = voxel_pixels(trainer)
        assert width == pytest.approx(share * plan.voxel_pixels.median)
        assert width == pytest.approx(sharpness(ball(), now, 8000, True).median)
    hashed: Any = SimpleNamespace(config=replace(config, field=Hash()))
    assert voxel_pixels(hashed) is None


def test_a_training_of_few_reports_says_nothing() -> None:
    assert what_limits(reports(0.3)[-3:], 4.5, metrics_of(20.0)) is None
    assert what_limits([], 4.5, None) is None
