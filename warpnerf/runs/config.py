"""config.json in a run's folder: what was trained, on what, and how."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from warpnerf.config import TrainConfig
from warpnerf.config_json import config_from_json, config_to_json, decode
from warpnerf.media.pictures import picture_files
from warpnerf.scenes.files import read_json
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.split import Split

Keep = Literal["field", "checkpoint"]


class FoundExtent(msgspec.Struct, frozen=True):
    """What was found before the training, in scene units; see ``training.coarse``."""

    content_distance: float
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]


class TrainedScene(msgspec.Struct, frozen=True, kw_only=True):
    """On what photographs something was trained, as far as it is read again."""

    scene: str
    """Path, in the file relative to its folder if it lies there; or built-in name."""
    downscale: int
    """Pixels of the photographs averaged, in each direction."""
    content_distance: float
    """The one in use, scene units."""
    masks: str | None = None
    """Absolute path of the folder of masks that was given for all photographs; None: none was."""
    pictures: list[str] | None = None
    """File names of the pictures in test/; None in runs of the version before, which wrote all."""
    found: FoundExtent | None = None
    """In place of the scene's own extent, where the cameras did not tell."""
    split: Literal["all", "sector"] | int | list[str] | None = None
    """What is withheld for testing, see ``load_scene``; None: what the scene says."""
    offset: tuple[float, float, float] | None = None
    """What was subtracted from the coordinates of the scene's file, scene units; see ``Scene``."""

    def as_trained(self, scene: Scene) -> Scene:
        """A scene, as it was read, with the run's coordinates and the extent that it has found."""
        scene = scene.at_offset(None if self.offset is None else np.array(self.offset))
        if self.found is None:
            return scene
        return replace(
            scene,
            content_distance=self.found.content_distance,
            box_min=np.array(self.found.box_min),
            box_max=np.array(self.found.box_max),
            guessed=False,
        )


class RunConfig(TrainedScene, frozen=True, kw_only=True):
    """What config.json says, as far as it is read again."""

    train: TrainConfig
    """What was requested."""
    keep: Keep = "field"
    """What is kept of the training once it has finished: its field alone, or checkpoints too."""
    box_min: tuple[float, float, float] | None = None
    """Lower corner of the scene's box as trained on, scene units."""
    box_max: tuple[float, float, float] | None = None
    """Upper corner."""


def pictures_of(scene: Scene) -> list[str]:
    """``RunConfig.pictures`` of a scene."""
    return sorted(picture_files([view.name for view in scene.views]).values())


def describe(
    scene: Scene,
    stored: str,
    downscale: int,
    content_distance: float,
    config: TrainConfig,
    masks: str | None,
    found: bool,
    keep: Keep = "field",
    split: Split | None = None,
) -> dict[str, Any]:
    """What config.json says of a run that begins; some of it only for those who open it.

    Args:
        scene: Photographs and extent, as trained on.
        stored: Its place, as ``RunConfig.scene`` has it.
        downscale: See ``RunConfig``.
        content_distance: See ``RunConfig``.
        config: What was requested.
        masks: See ``RunConfig``.
        found: Whether the scene's extent was found before the training.
        keep: See ``RunConfig``.
        split: See ``RunConfig``.
    """
    extent = {"box_min": scene.box_min.tolist(), "box_max": scene.box_max.tolist()}
    content = {
        "scene": stored,
        "downscale": downscale,
        "masks": masks,
        "content_distance": content_distance,
        **extent,
        "notes": [*scene.warnings, *scene.notes],
        "keep": keep,
        "split": split,
        "pictures": pictures_of(scene),
        "train": config_to_json(config),
    }
    if scene.offset is not None:
        content["offset"] = scene.offset.tolist()
    if found:
        content["found"] = {"content_distance": scene.content_distance, **extent}
    return content


def read_run_config(path: Path) -> RunConfig:
    """Read config.json.

    Raises:
        InputError: It is not what ``describe`` gave.
    """

    def prepare(tree: Any) -> Any:
        if isinstance(tree, dict) and isinstance(tree.get("train"), dict):
            return tree | {"train": config_from_json(tree["train"])}
        return tree

    return read_json(path, RunConfig, prepare, decode)
