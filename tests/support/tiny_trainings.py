"""Trainings of twenty steps, of something round that is there in every picture."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.small_model import SMALL, SQUARED
from tests.training.test_determinism import small_scene
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.optim_config import OptimConfig
from warpnerf.runs.checkpoint import load_checkpoint, save_checkpoint
from warpnerf.scenes.scene import Scene
from warpnerf.training import free_space
from warpnerf.training import trainer as training
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

STEPS = 20
FIRST_LOOK, GROWING = 4, (7, 13)
"""The steps at which the grid of ``tiny_config`` grows: the first with a share above 0.3, 0.6."""


@pytest.fixture(autouse=True)
def early_growth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Free space is looked for, the grid grows, and all settles, within a short training."""
    monkeypatch.setattr(training, "FIRST_LOOK", FIRST_LOOK)
    monkeypatch.setattr(training, "REPORT_EVERY", 3)
    monkeypatch.setattr(free_space, "FIRST_SETTLED", FIRST_LOOK)


NO_GROWTH = GridConfig(voxels=6000, grow_at=(), alpha_init=0.1)


# Rates at which most of the empty space is found within a few steps.
QUICK: dict[str, Any] = {
    "steps": 60,
    "model": "rgb",
    "optim": OptimConfig(learning_rate_density=3.0, accumulate_at=()),
    "grid": GridConfig(voxels=20_000, grow_at=(), alpha_init=0.1),
}


def ball() -> Scene:
    """Something round of many colours, with nothing around it."""
    scene = small_scene()
    v, u = np.mgrid[:18, :24]
    inside = np.hypot(v - 8.5, u - 11.5) < 4.0
    for view in scene.views:
        view.image[..., 3] = 255 * inside
    return scene


def large_ball() -> Scene:
    """The same on photographs four times as wide."""
    scene = ball()
    views = []
    for view in scene.views:
        c = view.camera
        sizes = {"width": 4 * c.width, "height": 4 * c.height}
        lens = {"fx": 4 * c.fx, "fy": 4 * c.fy, "cx": 4 * c.cx, "cy": 4 * c.cy}
        image = view.image.repeat(4, axis=0).repeat(4, axis=1)
        views.append(replace(view, camera=replace(c, **sizes, **lens), image=image))
    return replace(scene, views=views)


def tiny_config(**changes: Any) -> TrainConfig:
    return replace(
        TrainConfig(
            steps=STEPS,
            rays_per_step=300,
            occupancy_every=5,
            alpha_min=0.1,
            background="random",
            threads=1,
            model=SMALL,
            loss=SQUARED,
            grid=GridConfig(voxels=6000, grow_at=(0.301, 0.601), alpha_init=0.1),
            optim=OptimConfig(tv_every=3, tv_density=1e-4, tv_rgb=1e-4, accumulate_at=()),
        ),
        **changes,
    )


def stopped_at(
    step: int, file: Path, config: TrainConfig, scene: Scene, resume: TrainingState | None = None
) -> TrainingState:
    """Train up to a step, and what a file then gives back."""
    trainer = Trainer(scene, config, resume)
    trainer.run(
        on_checkpoint=lambda state: save_checkpoint(file, state),
        stop=lambda: trainer.steps_done >= step,
    )
    assert trainer.steps_done == step
    return load_checkpoint(file)


def without_seconds(state: TrainingState) -> TrainingState:
    """The one thing that no two trainings share."""
    return replace(state, progress=replace(state.progress, seconds=0.0))


def accumulating(config: TrainConfig, *shares: float) -> TrainConfig:
    return replace(config, optim=replace(config.optim, accumulate_at=shares))
