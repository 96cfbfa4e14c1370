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
    from warpnerf.checks import InputError
    from warpnerf.config import GridConfig, LossConfig, MarchConfig, OptimConfig, TrainConfig
    from warpnerf.evaluation.evaluate import Evaluation, evaluate
    from warpnerf.evaluation.inspection import Inspection, inspect
    from warpnerf.exporting.export import export
    from warpnerf.exporting.sight import Sight, look
    from warpnerf.exporting.splats import Splats, splats_of
    from warpnerf.exporting.surface import Surface, extract_surface
    from warpnerf.media.camera_path import camera_path
    from warpnerf.media.demonstration import Demo, demo
    from warpnerf.media.filming import render_stills, render_video
    from warpnerf.media.recorded_path import RecordedPath, read_path
    from warpnerf.media.scene_plan import plan_picture
    from warpnerf.model.interface import Model
    from warpnerf.model.models import Deferred, Features, Rgb, SphericalHarmonics
    from warpnerf.presets import PRESETS
    from warpnerf.rendering.field import Field, Rendering
    from warpnerf.scenes.camera import Camera
    from warpnerf.scenes.load import load_scene
    from warpnerf.scenes.scene import Scene, View
    from warpnerf.sfm.config import PoseConfig
    from warpnerf.sfm.pose import pose
    from warpnerf.sfm.summary import Posing
    from warpnerf.training.checkpoint import (
        load_checkpoint,
        load_field,
        save_checkpoint,
        save_field,
    )
    from warpnerf.training.state import Progress, TrainingState
    from warpnerf.training.train import TrainResult, train
    from warpnerf.viewer.view import view

__version__ = "0.1.0"

_HOMES = {
    "Camera": "scenes.camera",
    "camera_path": "media.camera_path",
    "load_checkpoint": "training.checkpoint",
    "load_field": "training.checkpoint",
    "save_checkpoint": "training.checkpoint",
    "save_field": "training.checkpoint",
    "InputError": "checks",
    "PRESETS": "presets",
    "GridConfig": "config",
    "LossConfig": "config",
    "MarchConfig": "config",
    "OptimConfig": "config",
    "TrainConfig": "config",
    "Deferred": "model.models",
    "Features": "model.models",
    "Model": "model.interface",
    "Rgb": "model.models",
    "SphericalHarmonics": "model.models",
    "load_scene": "scenes.load",
    "Demo": "media.demonstration",
    "demo": "media.demonstration",
    "Evaluation": "evaluation.evaluate",
    "evaluate": "evaluation.evaluate",
    "export": "exporting.export",
    "Sight": "exporting.sight",
    "look": "exporting.sight",
    "Splats": "exporting.splats",
    "splats_of": "exporting.splats",
    "Surface": "exporting.surface",
    "extract_surface": "exporting.surface",
    "Field": "rendering.field",
    "Rendering": "rendering.field",
    "render_stills": "media.filming",
    "render_video": "media.filming",
    "RecordedPath": "media.recorded_path",
    "read_path": "media.recorded_path",
    "Inspection": "evaluation.inspection",
    "inspect": "evaluation.inspection",
    "plan_picture": "media.scene_plan",
    "PoseConfig": "sfm.config",
    "Posing": "sfm.summary",
    "pose": "sfm.pose",
    "Scene": "scenes.scene",
    "View": "scenes.scene",
    "Progress": "training.state",
    "TrainingState": "training.state",
    "TrainResult": "training.train",
    "train": "training.train",
    "view": "viewer.view",
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
    "LossConfig",
    "MarchConfig",
    "OptimConfig",
    "TrainConfig",
    "Deferred",
    "Features",
    "Model",
    "Rgb",
    "SphericalHarmonics",
    "load_scene",
    "Demo",
    "demo",
    "Evaluation",
    "evaluate",
    "export",
    "Sight",
    "look",
    "Splats",
    "splats_of",
    "Surface",
    "extract_surface",
    "Field",
    "Rendering",
    "render_stills",
    "render_video",
    "RecordedPath",
    "read_path",
    "Inspection",
    "inspect",
    "plan_picture",
    "PoseConfig",
    "Posing",
    "pose",
    "Scene",
    "View",
    "Progress",
    "TrainingState",
    "TrainResult",
    "train",
    "view",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'warpnerf' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warpnerf.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
