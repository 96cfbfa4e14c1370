"""An update of the parameters takes one step or several, whose gradients are accumulated."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.small_model import small
from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_trainings import (
    NO_GROWTH,
    STEPS,
    accumulating,
    ball,
    stopped_at,
    tiny_config,
    without_seconds,
)
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.checks import InputError
from warpnerf.config import GridConfig
from warpnerf.fields import total_variation
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.total_variation import TotalVariation
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering import adjoint
from warpnerf.training import trainer as training
from warpnerf.training.train import train
from warpnerf.training.trainer import Trainer


@pytest.mark.parametrize(
    ("shares", "updates"),
    [
        ((), [1, 2, 3, 4, 5, 6, 7]),
        ((0.3,), [1, 2, 3, 5, 7]),
        ((0.4, 0.6), [1, 2, 3, 5, 7]),  # the last update has only two steps left
        ((0.1, 0.1, 0.1), [1, 7]),
    ],
)
def test_updates_take_more_steps_as_training_goes_on(
    shares: tuple[float, ...], updates: list[int]
) -> None:
    seen: list[int] = []
    config = accumulating(tiny_config(steps=7, checkpoint_every=1e-9), *shares)
    train(ball(), config, on_checkpoint=lambda state: seen.append(state.progress.step))
    assert seen == updates


@pytest.mark.parametrize(
    ("unbounded", "channels", "late"),
    [
        (False, 3, [13, 14, 15, 16, 18, 20, 28, 40]),
        (False, 4, [14, 16, 24, 40]),
        (True, 3, [*range(13, 21), *range(22, 29, 2), 32, 36, 40]),
        (True, 4, [*range(13, 21), *range(22, 29, 2), 32, 36, 40]),
    ],
)
def test_updates_take_more_steps_the_less_rays_meet_unless_told(
    unbounded: bool, channels: int, late: list[int]
) -> None:
    scene = ball()
    views = [replace(view, image=view.image[..., :channels]) for view in scene.views]
    seen: list[int] = []
    train(
        replace(scene, views=views, unbounded=unbounded),
        tiny_config(steps=40, checkpoint_every=1e-9, optim=OptimConfig()),
        on_checkpoint=lambda state: seen.append(state.progress.step),
    )
    assert seen == [*range(1, 13), *late]


@pytest.mark.parametrize("shares", [(0.0,), (0.5, 0.4), (1.0,), (math.nan,)])
def test_shares_that_are_none_are_refused(shares: tuple[float, ...]) -> None:
    for make, name in (
        (lambda: OptimConfig(accumulate_at=shares), r"optim\.accumulate_at"),
        (lambda: GridConfig(grow_at=shares), r"grid\.grow_at"),
    ):
        with pytest.raises(InputError, match=rf"^{name} must be shares between 0 and 1"):
            make()


def test_updates_of_very_many_steps_or_none_are_refused() -> None:
    OptimConfig(accumulate_at=(0.5,) * 6)
    with pytest.raises(InputError, match=r"^optim\.accumulate_at must hold at most 6.*, not 7:"):
        OptimConfig(accumulate_at=(0.5,) * 7)
    with pytest.raises(InputError, match=r"^optim\.accumulate_at must be auto or shares .*'never'"):
        OptimConfig(accumulate_at="never")  # type: ignore[arg-type]


def test_updates_are_counted_apart_from_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    smoothed: list[tuple[int, int]] = []
    updates: list[int] = []
    rates: list[float] = []
    looked: list[int] = []
    asked: list[int] = []
    add, adam, spans = TotalVariation.__call__, training.adam_step, total_variation.thread_spans
    look = Trainer._look_for_free_space
    config = accumulating(tiny_config(grid=NO_GROWTH), 0.2, 0.5)
    trainer = Trainer(ball(), replace(config, optim=replace(config.optim, decay=0.3)))

    def adding(
        smooth: TotalVariation, gradients: Gradients, update: int, fraction: float, n_steps: int
    ) -> None:
        asked.clear()
        add(smooth, gradients, update, fraction, n_steps)
        if asked:  # it has launched something
            smoothed.append((update, n_steps))

    def stretched(*arguments: Any) -> tuple[int, int]:
        asked.append(1)
        return spans(*arguments)

    def updating(*arguments: Any) -> None:
        updates.append(arguments[3])
        rates.append(arguments[4])
        adam(*arguments)

    def looking(trainer: Trainer) -> None:
        looked.append(trainer.steps_done)
        look(trainer)

    monkeypatch.setattr(TotalVariation, "__call__", adding)
    monkeypatch.setattr(total_variation, "thread_spans", stretched)
    monkeypatch.setattr(training, "adam_step", updating)
    monkeypatch.setattr(Trainer, "_look_for_free_space", looking)
    trainer.run()
    # Updates end after 1, 2, 3, 4, 6, 8, 10, 14, 18 and 20 steps.
    assert updates == list(range(1, 11))
    begun, n_steps = [0, 1, 2, 3, 4, 6, 8, 10, 14, 18], [1, 1, 1, 1, 2, 2, 2, 4, 4, 2]
    fading = 0.3 ** (np.array(begun) / STEPS)
    np.testing.assert_allclose(rates, fading * np.array(n_steps) ** 0.25, rtol=1e-12)
    assert smoothed == [(0, 1), (3, 1), (6, 2), (9, 2)]  # every third
    assert looked == [0, 6]  # before every fifth


@pytest.mark.parametrize(
    ("model", "threads", "records"),
    [
        *(("deferred", *how) for how in ((1, 1 << 26), (3, 1 << 26), (3, 32000))),
        ("rgb", 3, 32000),
        pytest.param("per_sample", 3, 32000, marks=pytest.mark.slow),
    ],
)
def test_an_update_adds_up_the_gradients_of_its_steps(
    model: str, threads: int, records: int, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    """Also where its rays take turns."""
    monkeypatch.setattr(adjoint, "RECORDS", records)
    taken: list[np.ndarray] = []
    of_weights: list[np.ndarray] = []

    def no_update(parameters: Any, states: Any, gradients: Gradients, *rest: Any) -> None:
        taken.append(gradients.values.numpy().copy())
        of_weights.append(gradients.weights.numpy().sum(axis=0))
        gradients.values.zero_()
        gradients.weights.zero_()

    monkeypatch.setattr(training, "adam_step", no_update)  # so both see one grid
    optim = OptimConfig(tv_density=0.0, tv_rgb=0.0, accumulate_at=())
    config = tiny_config(steps=5, grid=NO_GROWTH, optim=optim, threads=threads, model=small(model))
    train(ball(), config)
    train(ball(), accumulating(config, 0.1, 0.2))
    for found in (taken, of_weights) if of_weights[0].size else (taken,):
        assert len(found) == 5 + 2
        single, together = found[:5], found[5:]
        np.testing.assert_array_equal(together[0], single[0])
        largest = np.abs(together[1]).max()
        np.testing.assert_allclose(together[1], np.sum(single[1:], axis=0), atol=1e-5 * largest)
        assert largest > 0.0


def test_reports_come_as_often_where_an_update_takes_many_steps() -> None:
    reported: list[int] = []
    config = accumulating(tiny_config(), 0.1, 0.3)  # updates after 1, 2, 4, 6, 10, 14, ... steps
    train(ball(), config, on_progress=lambda progress: reported.append(progress.step))
    assert reported == [4, 6, 10, 14, 18, 20]


@pytest.mark.parametrize("threads", [1, 3])
def test_resumed_between_updates_of_several_steps_it_ends_the_same(
    threads: int, tmp_path: Path, on_cpu: None
) -> None:
    config = accumulating(tiny_config(threads=threads), 0.2, 0.5)
    whole = stopped_at(STEPS, tmp_path / "whole", config, ball())
    assert whole.updates == 10
    for step in (4, 6, 10, 14, 18):
        begun = stopped_at(step, tmp_path / "begun", config, ball())
        resumed = stopped_at(STEPS, tmp_path / "resumed", config, ball(), begun)
        assert_same_state(without_seconds(resumed), without_seconds(whole))
