"""The photographs of a run, read once more: reduced, masked and measured as for its training."""

from __future__ import annotations

from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.runs.config import TrainedScene, pictures_of
from warpnerf.scenes.files import exists
from warpnerf.scenes.formats.load import BUILTIN, load_scene
from warpnerf.scenes.scene import Scene


def load_run_scene(
    config: TrainedScene, moved: str | None = None, threads: int | None = None
) -> Scene:
    """Read the scene that a run was trained on; images stay in their files.

    Args:
        config: Of the run.
        moved: Where the scene is now; None: where it was. Masks that lay inside it are looked for
            there first.
        threads: See ``load_scene``.

    Raises:
        InputError: The scene cannot be read, the run's masks are gone, or what it is said to have
            moved to is another one.
    """
    path, masks = path_of(config, moved), masks_of(config, moved)
    scene = load_scene(
        path,
        downscale=config.downscale,
        masks=masks,
        images="files",
        threads=threads,
        split=config.split,
    )
    pictures = pictures_of(scene)
    if moved is not None and config.pictures is not None and pictures != config.pictures:
        n, trained = len(pictures), len(config.pictures)
        how = f"it has {n} photographs, not {trained}"
        if n == trained:
            how = "its photographs have other names"
        raise InputError(
            f"--scene {moved}: is not what the run was trained on: {how}; name where the run's "
            "photographs are now."
        )
    return config.as_trained(scene)


def path_of(config: TrainedScene, moved: str | None = None) -> str:
    """Where the scene is that a run was trained on.

    Args:
        config: Of the run.
        moved: Where it is now; None: where it was.

    Raises:
        InputError: It is not where it was.
    """
    if moved is None and not config.scene.startswith(BUILTIN) and not exists(Path(config.scene)):
        raise InputError(
            f"{config.scene}: the scene that the run was trained on is no longer there; put it "
            "back, or name where it is now by --scene, for train as SCENE."
        )
    return moved or config.scene


def masks_of(config: TrainedScene, moved: str | None = None) -> Path | None:
    """The folder of the masks that a run was trained with; None where there were none.

    Args:
        config: Of the run.
        moved: Where its scene is now; None: where it was. Masks that lay inside it are looked for
            there first.

    Raises:
        InputError: They are gone.
    """
    if config.masks is None:
        return None
    masks, scene = Path(config.masks), Path(config.scene)
    if moved is not None and masks.is_relative_to(scene):
        inside = Path(moved) / masks.relative_to(scene)
        if inside.is_dir():
            return inside
    if not masks.is_dir():
        raise InputError(
            f"{masks}: the masks that the run was trained with are gone; put the folder back, or "
            "a link to where it is now."
        )
    return masks
