"""Voxel-grid radiance fields from posed photographs, without floaters near the cameras.

    scene = warpnerf.load_scene("path/to/scene")
    result = warpnerf.train(scene)
    image = result.field.render(scene.cameras[0])

Names are imported when they are first used, so that importing the package is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpnerf.camera import Camera
    from warpnerf.checkpoint import load_checkpoint, load_field, save_checkpoint, save_field
    from warpnerf.checks import InputError
    from warpnerf.config import PRESETS, GridConfig, MarchConfig, OptimConfig, TrainConfig
    from warpnerf.data import load_scene
    from warpnerf.demonstration import Demo, demo
    from warpnerf.evaluation import Evaluation, evaluate
    from warpnerf.field import Field, Rendering
    from warpnerf.filming import render_stills, render_video
    from warpnerf.flight import camera_path
    from warpnerf.inspection import Inspection, inspect
    from warpnerf.plan import plan_picture
    from warpnerf.scene import Scene, View
    from warpnerf.state import Progress, TrainingState
    from warpnerf.training import TrainResult, train

__version__ = "0.1.0"

_HOMES = {
    "Camera": "camera",
    "camera_path": "flight",
    "load_checkpoint": "checkpoint",
    "load_field": "checkpoint",
    "save_checkpoint": "checkpoint",
    "save_field": "checkpoint",
    "InputError": "checks",
    "PRESETS": "config",
    "GridConfig": "config",
    "MarchConfig": "config",
    "OptimConfig": "config",
    "TrainConfig": "config",
    "load_scene": "data",
    "Demo": "demonstration",
    "demo": "demonstration",
    "Evaluation": "evaluation",
    "evaluate": "evaluation",
    "Field": "field",
    "Rendering": "field",
    "render_stills": "filming",
    "render_video": "filming",
    "Inspection": "inspection",
    "inspect": "inspection",
    "plan_picture": "plan",
    "Scene": "scene",
    "View": "scene",
    "Progress": "state",
    "TrainingState": "state",
    "TrainResult": "training",
    "train": "training",
}

__all__ = [  # noqa: RUF022 (grouped by home, as above)
    "Camera",
    "camera_path",
    "load_checkpoint",
    "load_field",
    "save_checkpoint",
    "save_field",
    "InputError",
    "PRESETS",
    "GridConfig",
    "MarchConfig",
    "OptimConfig",
    "TrainConfig",
    "load_scene",
    "Demo",
    "demo",
    "Evaluation",
    "evaluate",
    "Field",
    "Rendering",
    "render_stills",
    "render_video",
    "Inspection",
    "inspect",
    "plan_picture",
    "Scene",
    "View",
    "Progress",
    "TrainingState",
    "TrainResult",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpnerf' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warpnerf.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
