"""When a grid grows, how many steps share an update, and what learning rates are multiplied by."""

from __future__ import annotations

from dataclasses import replace

import pytest

from warpnerf.config import GridConfig, TrainConfig
from warpnerf.grid_config import GROW_AT
from warpnerf.optim_config import ACCUMULATE_AT, OptimConfig
from warpnerf.training.schedule import Schedule

GIVEN = Schedule.of(
    TrainConfig(
        grid=GridConfig(grow_at=(0.25, 0.5)),
        optim=OptimConfig(accumulate_at=(0.25, 0.75, 0.75), decay=0.01),
    ),
    "bounded",
)


@pytest.mark.parametrize(
    ("fraction", "growths", "steps"),
    [
        (0.0, 0, 1),
        (0.249, 0, 1),
        (0.25, 1, 2),
        (0.5, 2, 2),
        (0.749, 2, 2),
        (0.75, 2, 8),
        (1.0, 2, 8),
    ],
)
def test_each_share_counts_from_where_it_is(fraction: float, growths: int, steps: int) -> None:
    assert GIVEN.growths(fraction) == growths
    assert GIVEN.steps_an_update(fraction) == steps
    assert GIVEN.most_steps_an_update == 8


@pytest.mark.parametrize("kind", ["object", "bounded", "unbounded"])
def test_auto_is_what_suits_the_kind_of_scene(kind: str) -> None:
    schedule = Schedule.of(TrainConfig(), kind)  # type: ignore[arg-type]
    grow, share = GROW_AT[kind], ACCUMULATE_AT[kind]  # type: ignore[index]
    for fraction in (0.0, 0.15, 0.35, 0.45, 0.55, 0.65, 0.8):
        assert schedule.growths(fraction) == sum(at <= fraction for at in grow)
        assert schedule.steps_an_update(fraction) == 2 ** sum(at <= fraction for at in share)
    assert schedule.most_steps_an_update == 2 ** len(share)


def test_rates_decay_and_grow_with_the_root_of_the_root_of_the_steps() -> None:
    for fraction, grown, n_steps, rate in (
        (0.0, 0, 1, 1.0),
        (0.5, 0, 1, 0.1),
        (1.0, 2, 1, 0.01),
        (0.5, 1, 16, 0.2),
        (0.0, 0, 81, 3.0),
    ):
        assert GIVEN.rate(fraction, grown, n_steps) == pytest.approx(rate)
    anew = replace(GIVEN, restart_at_growth=True)
    assert anew.rate(0.25, 0, 1) == pytest.approx(0.01**0.25)
    assert anew.rate(0.25, 1, 1) == pytest.approx(1.0)
    assert anew.rate(0.75, 2, 16) == pytest.approx(2.0 * 0.01**0.25)
