"""Exposures of photographs, fitted while a field trains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp

import warpnerf as wn
from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_trainings import (
    NO_GROWTH,
    STEPS,
    ball,
    early_growth,
    stopped_at,
    tiny_config,
    without_seconds,
)
from warpnerf.checks import InputError
from warpnerf.rendering.rays import RayBatch
from warpnerf.runs.checkpoint import load_checkpoint, save_checkpoint
from warpnerf.runtime.parallel import Workers
from warpnerf.training import exposure
from warpnerf.training.exposure import Exposures
from warpnerf.training.peers import ALONE
from warpnerf.training.trainer import Trainer

__all__ = ["early_growth"]


@pytest.fixture(autouse=True)
def early_exposures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Photographs are judged within a short training."""
    monkeypatch.setattr(exposure, "FIRST_RAYS", 0)
    monkeypatch.setattr(exposure, "JUDGED_RAYS", 0)


GAINS = np.array([[0.6, 0.8, 0.7], [1.0, 1.1, 1.2], [1.5, 1.2, 1.1]])
OFFSETS = np.array([[0.1, 0.0, 0.05], [0.0, 0.02, 0.0], [-0.1, -0.02, -0.05]])


def test_exposures_of_known_photographs_are_found(device: str) -> None:
    """Up to those of all, which the field has: colours of the field are fitted once more."""
    workers, rng = Workers(device, 2), np.random.default_rng(0)
    exposures = Exposures(3, workers)
    for _ in range(30):
        views = rng.integers(0, 3, 3000)
        colours = rng.uniform(0.2, 0.8, (3000, 3))
        pixels = GAINS[views] * colours + OFFSETS[views]
        gains, offsets = exposures.gains.numpy(), exposures.offsets.numpy()
        target = (pixels - offsets[views]) / gains[views]
        vectors = [wp.array(v, dtype=wp.vec3, device=workers.device) for v in (target, colours)]
        batch = RayBatch(
            **dict.fromkeys(("directions", "offsets", "background"), vectors[0]),
            origins=vectors[0],
            content_distance=vectors[0],
            target_rgb=vectors[0],
            views=wp.array(views, dtype=wp.int32, device=workers.device),
        )
        exposures.add(batch, vectors[1], 1.0, 1)
        exposures.fit(3000)
    found = exposures.by_name(["a", "b", "c"])
    mean = np.exp(np.log(GAINS).mean(axis=0))
    for name, gain in zip("abc", GAINS, strict=True):
        np.testing.assert_allclose(found[name].gain, gain / mean, rtol=0.02)
    offsets = np.array([found[name].offset for name in "abc"])
    np.testing.assert_allclose(offsets.mean(axis=0), 0.0, atol=1e-6)
    words = exposures.in_words(["a", "b", "c"])
    assert words.endswith("grey, a is 0.81 times as bright, c 1.17 times")
    assert exposures.used


def exposed() -> wn.Scene:
    """The ball, of one colour, whose second photograph is much darker."""
    scene = ball()
    for view in scene.views:
        view.image[..., :3] = [50, 60, 40] if view is scene.views[1] else [150, 180, 120]
    return scene


def grey_of(result: wn.TrainResult) -> dict[str, float]:
    """What half grey looks like in each photograph."""
    assert result.exposures is not None
    of_all = result.exposures.items()
    return {name: float(0.5 * np.mean(of.gain) + np.mean(of.offset)) for name, of in of_all}


def test_a_darker_photograph_has_a_smaller_gain() -> None:
    result = wn.train(exposed(), tiny_config(grid=NO_GROWTH, appearance="affine", steps=80))
    grey = grey_of(result)
    assert list(grey) == result.scene.training_names
    assert min(grey, key=grey.__getitem__) == result.scene.views[1].name
    assert min(grey.values()) < 0.8 * max(grey.values())
    plain = wn.train(exposed(), tiny_config(grid=NO_GROWTH, appearance="none"))
    assert plain.exposures is None


def test_auto_fits_those_that_differ_alone() -> None:
    config = tiny_config(grid=NO_GROWTH, appearance="auto", steps=120)
    result = wn.train(exposed(), config)
    assert grey_of(result)[result.scene.views[1].name] < 0.45
    alike = exposed()
    for view in alike.views:
        view.image[..., :3] = [150, 180, 120]
    trainer = Trainer(alike, config)
    trainer.run()
    assert trainer.exposures is None
    batch = trainer._draw(1)
    rgb = np.array([150, 180, 120]) / 255.0
    opaque = batch.target_rgb.numpy()[batch.views.numpy() >= 0]
    np.testing.assert_allclose(opaque, np.broadcast_to(rgb, opaque.shape), rtol=1e-6)


def of_sums(sums: np.ndarray, settled: bool) -> Exposures:
    """Exposures as they are resumed, of three photographs with these sums of each channel."""
    each = np.broadcast_to(sums, (3, 3, 5)).ravel()
    arrays = (each, [float(settled)])
    of_arrays = (wp.array(values, dtype=wp.float32, device="cpu") for values in arrays)
    state = dict(zip(("sums", "settled"), of_arrays, strict=True))
    return Exposures(3, Workers("cpu", 1), settled=not settled, state=state)


ALIKE = np.array([500.0, 0.0, 0.0, 40.0, 40.0])
"""Sums of a channel of a photograph whose gain is 1."""


def test_older_rays_count_less_by_how_many_came_since() -> None:
    exposures = of_sums(ALIKE, True)
    exposures.fit(1500)  # of which each photograph has 500
    exposures.fit(10_500)
    np.testing.assert_allclose(exposures.sums.numpy()[::5], 500.0 * np.exp(-1.0), rtol=1e-6)


def test_auto_judges_once_it_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exposure, "JUDGED_RAYS", 320)
    alike = of_sums(ALIKE, False)
    for fraction, drawn in ((exposure.JUDGED - 0.01, 320), (exposure.JUDGED_BY - 0.01, 319)):
        assert alike.judged(fraction, drawn, ALONE) is alike and not alike.settled
    assert alike.judged(exposure.JUDGED, 320, ALONE) is None
    assert of_sums(ALIKE, False).judged(exposure.JUDGED_BY, 319, ALONE) is None
    settled = of_sums(ALIKE, True)
    assert settled.judged(1.0, 1000, ALONE) is settled


def test_auto_leaves_photographs_as_they_are_where_it_cannot_begin_in_time() -> None:
    exposures = Exposures(3, Workers("cpu", 1), settled=False)
    assert exposures.judged(exposure.LATEST, 10, ALONE) is exposures
    assert exposures.judged(exposure.LATEST + 0.01, 10, ALONE) is None


@pytest.mark.parametrize("red", [0.3, -0.3])
def test_brightness_is_judged_and_not_white_balance(red: float) -> None:
    """A field whose colours depend on the direction of view has that of one exposure, too."""
    sums = np.broadcast_to(ALIKE, (3, 3, 5)).copy()
    sums[1, :, 2] += ALIKE[0] * np.array([red, 0.0, 0.3])
    exposures = of_sums(sums, False)
    assert (exposures.gains.numpy() == 1.0).all() and (exposures.offsets.numpy() != 0.0).any()
    differ = exposures.judged(1.0, 2_000_000, ALONE) is exposures
    assert differ == exposures.settled == (red > 0.0)
    assert (exposures.offsets.numpy() != 0.0).any() == differ  # else drawn as they are


def test_a_limit_that_is_raised_leaves_exposures_as_they_are() -> None:
    """Rays are taken in then as before, though less than BEGIN of the training is done."""
    exposures = of_sums(ALIKE, True)
    batch = Trainer(exposed(), tiny_config())._draw(1)
    exposures.add(batch, batch.target_rgb, 0.0, 0)
    assert exposures.accumulated[0].arrays["weights"].numpy().any()
    fresh = Exposures(3, Workers("cpu", 1))
    fresh.add(batch, batch.target_rgb, 0.0, 0)
    fresh.fit(1000)
    assert not fresh.accumulated[0].arrays["weights"].numpy().any() and not fresh.used


def test_the_mean_of_one_photograph_is_itself() -> None:
    scene = replace(exposed(), splits={"train": (0,), "test": (3,)})
    with pytest.raises(InputError, match="noise has one training photograph, and none that it"):
        Trainer(scene, tiny_config(appearance="affine"))
    result = wn.train(scene, tiny_config(grid=NO_GROWTH))
    assert result.exposures is None


@pytest.mark.ci
def test_photographs_of_the_room_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in a training that is too short to show more than a blur."""
    monkeypatch.undo()
    scene = wn.load_scene("builtin:room-sparse", downscale=4)
    grid = wn.GridConfig(voxels=100_000)
    config = replace(wn.PRESETS["fast"], model="rgb", coarse_steps=0, grid=grid, threads=2)
    trainer = Trainer(scene, replace(config, steps=900))
    while trainer.steps_done < 80:  # more than 8 % of them
        trainer.update()
    assert trainer.exposures is not None and not trainer.exposures.settled
    while trainer.steps_done < 330:
        trainer.update()
    assert trainer.exposures is None


def test_the_first_share_of_a_training_has_none() -> None:
    trainer = Trainer(exposed(), tiny_config(appearance="affine", steps=80))
    assert trainer.exposures is not None
    while trainer.fraction < exposure.BEGIN:
        trainer.update()
    assert (trainer.exposures.sums.numpy() == 0.0).all()
    assert (trainer.exposures.gains.numpy() == 1.0).all()
    trainer.update()
    assert (trainer.exposures.gains.numpy() != 1.0).any()


def test_batches_are_drawn_by_the_exposures_as_they_stand() -> None:
    trainer = Trainer(exposed(), tiny_config(appearance="affine", average_pixels=False))
    assert trainer.exposures is not None
    before = trainer._draw(1).target_rgb.numpy().copy()
    trainer.exposures.gains.fill_(wp.vec3(0.5, 0.5, 0.5))
    batch = trainer._draw(1)
    opaque = batch.views.numpy() >= 0
    assert opaque.any() and not opaque.all()
    after = batch.target_rgb.numpy()
    np.testing.assert_allclose(after[opaque], 2.0 * before[opaque], rtol=1e-6)
    np.testing.assert_array_equal(after[~opaque], before[~opaque])


@pytest.mark.parametrize("appearance", ["auto", "affine"])
@pytest.mark.parametrize("step", [1, 2, 5, 6, 7, 17])
def test_resumed_it_ends_the_same(
    step: int, appearance: Any, tmp_path: Path, on_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exposure, "JUDGED", 0.3)
    config = tiny_config(appearance=appearance, threads=2)
    whole = stopped_at(STEPS, tmp_path / "whole", config, exposed())
    begun = stopped_at(step, tmp_path / "begun", config, exposed())
    resumed = stopped_at(STEPS, tmp_path / "resumed", begun.config, exposed(), begun)
    assert_same_state(without_seconds(resumed), without_seconds(whole))
    assert (whole.optimiser[exposure.STATE]["sums"].numpy() != 0.0).any()


def test_what_does_not_fit_the_photographs_is_refused(tmp_path: Path, on_cpu: None) -> None:
    file, config = tmp_path / "begun", tiny_config(appearance="affine")
    begun = stopped_at(9, file, config, exposed())
    n = exposure.NUMBERS
    for sums, settled, says in (
        (np.zeros(2 * n), 1.0, "exposures of 2 photographs, but the scene has 3; bring"),
        (np.zeros(7), 1.0, "its tensor 'exposures.sums' does not fit its photographs"),
        (np.full(3 * n, np.nan), 1.0, "does not fit its photographs"),
        (np.tile([-1.0, 0.0, 0.0, -1.0, 0.0], 9), 1.0, "does not fit its photographs"),
        (np.tile([9.0, 9.0, 0.0, 1.0, 0.0], 9), 1.0, "does not fit its photographs"),
        (np.zeros(3 * n), 0.0, "its tensor 'exposures.settled' does not fit its appearance"),
    ):
        arrays = {
            name: wp.array(values, dtype=wp.float32, device="cpu")
            for name, values in (("sums", sums), ("settled", [settled]))
        }
        other = replace(begun, optimiser=begun.optimiser | {exposure.STATE: arrays})
        save_checkpoint(file, other)
        with pytest.raises(InputError, match=says):
            Trainer(exposed(), config, load_checkpoint(file))
    with pytest.raises(InputError, match="appearance is none, but the training to be resumed has"):
        Trainer(exposed(), tiny_config(appearance="none"), begun)
    with pytest.raises(InputError, match="appearance must be one of auto, none, affine, not"):
        tiny_config(appearance="gain")
