"""Voxel-grid radiance fields from posed photographs, with fewer floaters near the cameras.

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
    from warpnerf.config import GridConfig, MarchConfig, TrainConfig
    from warpnerf.evaluation.evaluate import Evaluation, evaluate
    from warpnerf.exporting.export import ExportOptions, export, export_all
    from warpnerf.exporting.splats import Splats, splats_of
    from warpnerf.exporting.surface import Surface, extract_surface
    from warpnerf.exporting.visibility import Visibility, visibility
    from warpnerf.inspection.inspection import Inspection, inspect
    from warpnerf.loss_config import LossConfig
    from warpnerf.media.camera_path import camera_path
    from warpnerf.media.filming import render_stills, render_video
    from warpnerf.media.recorded_path import RecordedPath, read_path
    from warpnerf.media.scene_plan import plan_picture
    from warpnerf.model.interface import Model
    from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
    from warpnerf.model.sampler_kinds import Resampled
    from warpnerf.model.storage_kinds import Dense, Hash, Vm
    from warpnerf.optim_config import OptimConfig
    from warpnerf.presets import PRESETS
    from warpnerf.rendering.composite import CompositeField
    from warpnerf.rendering.field import Field, Rendering
    from warpnerf.reports.demonstration import Demo, demo
    from warpnerf.runs.checkpoint import (
        load_checkpoint,
        load_field,
        save_checkpoint,
        save_field,
    )
    from warpnerf.scenes.cameras.camera import Camera
    from warpnerf.scenes.formats.load import load_scene
    from warpnerf.scenes.scene import Scene, View
    from warpnerf.sfm.config import PoseConfig
    from warpnerf.sfm.pose import pose
    from warpnerf.sfm.summary import Posing
    from warpnerf.training.state import Progress, TrainingState
    from warpnerf.training.train import TrainResult, train
    from warpnerf.viewer.view import view

__version__ = "0.1.0"

_HOMES = {
    "Camera": "scenes.cameras.camera",
    "camera_path": "media.camera_path",
    "load_checkpoint": "runs.checkpoint",
    "load_field": "runs.checkpoint",
    "save_checkpoint": "runs.checkpoint",
    "save_field": "runs.checkpoint",
    "InputError": "checks",
    "PRESETS": "presets",
    "GridConfig": "config",
    "LossConfig": "loss_config",
    "MarchConfig": "config",
    "OptimConfig": "optim_config",
    "TrainConfig": "config",
    "Deferred": "model.models",
    "PerSample": "model.models",
    "Model": "model.interface",
    "Rgb": "model.models",
    "SphericalHarmonics": "model.models",
    "Dense": "model.storage_kinds",
    "Hash": "model.storage_kinds",
    "Resampled": "model.sampler_kinds",
    "Vm": "model.storage_kinds",
    "load_scene": "scenes.formats.load",
    "Demo": "reports.demonstration",
    "demo": "reports.demonstration",
    "Evaluation": "evaluation.evaluate",
    "evaluate": "evaluation.evaluate",
    "export": "exporting.export",
    "export_all": "exporting.export",
    "ExportOptions": "exporting.export",
    "Visibility": "exporting.visibility",
    "visibility": "exporting.visibility",
    "Splats": "exporting.splats",
    "splats_of": "exporting.splats",
    "Surface": "exporting.surface",
    "extract_surface": "exporting.surface",
    "Field": "rendering.field",
    "CompositeField": "rendering.composite",
    "Rendering": "rendering.field",
    "render_stills": "media.filming",
    "render_video": "media.filming",
    "RecordedPath": "media.recorded_path",
    "read_path": "media.recorded_path",
    "Inspection": "inspection.inspection",
    "inspect": "inspection.inspection",
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
    "PerSample",
    "Model",
    "Rgb",
    "SphericalHarmonics",
    "Dense",
    "Hash",
    "Resampled",
    "Vm",
    "load_scene",
    "Demo",
    "demo",
    "Evaluation",
    "evaluate",
    "export",
    "export_all",
    "ExportOptions",
    "Visibility",
    "visibility",
    "Splats",
    "splats_of",
    "Surface",
    "extract_surface",
    "Field",
    "CompositeField",
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
        from warpnerf.renamed import FORMER_NAMES, warn_renamed

        if name in FORMER_NAMES:
            warn_renamed(f"warpnerf.{name}", f"warpnerf.{FORMER_NAMES[name]}")
            return getattr(importlib.import_module("warpnerf"), FORMER_NAMES[name])
        raise AttributeError(f"module 'warpnerf' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"warpnerf.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
