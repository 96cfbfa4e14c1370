"""Presets train, and those of DVGO are made of what was published."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest
from test_frustum import facing
from tiny_scenes import ring, tiny_scene
from tiny_trainings import ball

import warpnerf as wn
from warpnerf.cli import train
from warpnerf.presets import EVERYDAY, PRESETS
from warpnerf.scenes.scene import Scene
from warpnerf.training.trainer import Trainer

STEPS = 120


def smaller(name: str, **changes: Any) -> wn.TrainConfig:
    """A preset at a size for tests: what it is made of, on fewer nodes, rays and steps."""
    preset = PRESETS[name]
    values = {
        "steps": STEPS,
        "rays_per_step": 128,
        "time_limit": None,
        "threads": 1,
        "grid": replace(preset.grid, voxels=4096, planes=16),
    }
    return replace(preset, **(values | changes))


def squared_error(field: wn.Field, scene: Scene) -> float:
    """Mean over the training views, of photographs before the field's background."""
    errors = []
    for view in (scene.views[index] for index in scene.splits["train"]):
        image = view.image / 255.0
        alpha = image[..., 3:] if image.shape[2] == 4 else 1.0
        target = image[..., :3] * alpha + np.array(field.background) * (1.0 - alpha)
        errors.append(np.square(field.render(view.camera).rgb - target).mean())
    return float(np.mean(errors))


@pytest.mark.slow  # compiles networks as wide as DVGO's
@pytest.mark.parametrize(
    ("name", "scene"),
    [
        ("fast", ball()),
        ("quality", ball()),
        ("dvgo", ball()),
        ("dvgo-unbounded", tiny_scene(ring(4))),
        ("dvgo-llff", facing()),
    ],
)
def test_presets_train(name: str, scene: Scene) -> None:
    trainer = Trainer(scene, smaller(name))
    before = squared_error(trainer.field(), scene)
    trainer.run()
    assert trainer.steps_done == STEPS
    assert squared_error(trainer.field(), scene) < 0.8 * before
    for parameter in trainer.parameters():
        values = parameter.values.numpy()
        assert values.any() and np.isfinite(values).all()


def test_the_command_knows_all() -> None:
    hints = get_type_hints(train.train_command, include_extras=True)
    literal = get_args(hints["preset"])[0]
    assert get_args(literal) == tuple(PRESETS)


def test_those_of_dvgo_are_all_there_and_the_others_are_everyday() -> None:
    dvgo = {"dvgo", "dvgo-unbounded", "dvgo-llff"}
    assert set(PRESETS) == {*EVERYDAY, *dvgo}
    for name in dvgo:
        config = PRESETS[name]
        assert config.model.name == "features" and not config.model.residual
        assert config.optim.restart_at_growth and config.grid.shift_at_growth == 1.0
        assert config.loss.entropy == pytest.approx(3 * 1e-3)
        assert config.loss.sample_colour == pytest.approx(3 * 1e-2)
        assert (config.loss.distortion > 0.0) == (name != "dvgo")
        # Learning rates fall by ten in 20 000 steps, or in 80 000 of the unbounded one.
        pace = 80_000 if name == "dvgo-unbounded" else 20_000
        assert config.optim.decay == pytest.approx(0.1 ** (config.steps / pace))
