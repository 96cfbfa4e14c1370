"""PSNR of test views during a training: when, of what, and that it changes nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_trainings import NO_GROWTH, STEPS, ball, early_growth, tiny_config
from warpnerf.checks import InputError
from warpnerf.training.held_out import VIEWS, HeldOut
from warpnerf.training.trainer import Trainer

__all__ = ["early_growth"]


def reports_of(every: int | None) -> tuple[list[wn.Progress], wn.TrainResult]:
    found: list[wn.Progress] = []
    config = tiny_config(grid=NO_GROWTH)
    result = wn.train(ball(), config, on_progress=found.append, eval_every=every)
    return found, result


def test_reports_have_the_psnr_of_test_views_where_it_is_time() -> None:
    found, result = reports_of(7)
    plain, other = reports_of(None)
    values = result.field.storage.tensors()["values"]
    np.testing.assert_array_equal(values, other.field.storage.tensors()["values"])
    assert [a.loss for a in found] == [b.loss for b in plain]
    assert all(report.test_psnr is None for report in plain)
    assert [a.step for a in found if a.test_psnr is not None] == [9, 15, STEPS]
    measured = wn.evaluate(result.field, ball(), "test").mean["psnr"]
    assert result.progress.test_psnr == found[-1].test_psnr == pytest.approx(measured, abs=1e-9)
    assert "test PSNR" in str(found[-1]) and "test PSNR" not in str(plain[-1])


def test_a_few_views_are_spread() -> None:
    scene = ball()
    many = replace(scene, splits={"train": (0, 1, 2), "test": (3, 0, 1, 2, 3, 0, 1, 2, 3)})
    held_out = HeldOut(Trainer(many, tiny_config(grid=NO_GROWTH)), 5)
    assert len(held_out._views) == VIEWS
    assert held_out._views[0] is held_out._views[-1] is scene.views[3]


def test_without_test_views_it_is_refused() -> None:
    scene = replace(ball(), splits={"train": (0, 1, 2, 3), "test": ()})
    with pytest.raises(InputError, match="eval_every is 5, but noise has no test views; withhold"):
        wn.train(scene, tiny_config(), eval_every=5)
    with pytest.raises(InputError, match="eval_every must be a whole number of at least 1, not 0"):
        wn.train(ball(), tiny_config(), eval_every=0)
