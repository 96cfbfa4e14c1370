"""warpnerf: voxel-grid radiance fields from posed photographs, without floaters.

    import warpnerf as wn
    scene = wn.load_scene("builtin:room")
    result = wn.train(scene, wn.TrainConfig(steps=2000, scaling="clamped"))
    print(wn.evaluate(result.field, scene, split="test"))

Names are imported from their modules when first used, so that ``import warpnerf`` costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpnerf.camera import Camera
    from warpnerf.checkpoint import load_field, save_field
    from warpnerf.checks import InputError
    from warpnerf.config import PRESETS, GridConfig, MarchConfig, OptimConfig, TrainConfig
    from warpnerf.data import load_scene
    from warpnerf.evaluate import Evaluation, evaluate
    from warpnerf.field import Field, Rendering
    from warpnerf.scene import Scene, View
    from warpnerf.train import TrainResult, train

__version__ = "0.1.0"

__all__ = [
    "PRESETS",
    "Camera",
    "Evaluation",
    "Field",
    "GridConfig",
    "InputError",
    "MarchConfig",
    "OptimConfig",
    "Rendering",
    "Scene",
    "TrainConfig",
    "TrainResult",
    "View",
    "evaluate",
    "load_field",
    "load_scene",
    "save_field",
    "train",
]

_HOMES = {
    "camera": ("Camera",),
    "checkpoint": ("load_field", "save_field"),
    "checks": ("InputError",),
    "config": ("PRESETS", "GridConfig", "MarchConfig", "OptimConfig", "TrainConfig"),
    "data": ("load_scene",),
    "evaluate": ("Evaluation", "evaluate"),
    "field": ("Field", "Rendering"),
    "scene": ("Scene", "View"),
    "train": ("TrainResult", "train"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Import a public name from its home (PEP 562)."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """The public names, imported or not."""
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Keeps ``warpnerf.train`` the function: importing the module of that name would rebind it."""

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOME_OF and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
