"""The entry point for scenes of every format: ``load_scene``."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import get_args

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_one_of
from warpnerf.runtime.memory import require_threads
from warpnerf.scenes.files import exists
from warpnerf.scenes.formats import llff
from warpnerf.scenes.formats.blender import SPLITS, load_blender, split_file
from warpnerf.scenes.formats.colmap import find_model, load_colmap
from warpnerf.scenes.formats.contents import VIDEOS, is_unposed, pose_command, what_is_there
from warpnerf.scenes.formats.npz import load_npz, single_npz
from warpnerf.scenes.formats.transforms import load_transforms
from warpnerf.scenes.images.photographs import Keeping, Place
from warpnerf.scenes.scene import Scene

__all__ = ["load_scene"]

BUILTIN = "builtin:"
BUILTIN_NAMES = ("room", "room-sparse")


@checked_arguments
def load_scene(
    path: str | Path,
    *,
    downscale: int = 1,
    masks: str | Path | None = None,
    images: Place = "auto",
    image_folder: Path | None = None,
    threads: int | None = None,
) -> Scene:
    """Load a scene: photographs, cameras, split, and the extent estimated from the cameras.

    A folder is tried as Blender / NeRF-synthetic (transforms_train.json), then as instant-ngp or
    nerfstudio (transforms.json), COLMAP (sparse/0), LLFF (poses_bounds.npy), and one .npz file.

    Args:
        path: A folder, a transforms*.json, poses_bounds.npy or .npz file in it, the folder of a
            COLMAP model, or "builtin:" and the name of a built-in scene.
        downscale: Edge of the blocks of pixels that become one; 1 keeps the images as they are.
        masks: Folder of masks, named after the photographs: pixels that are black there are neither
            trained on nor measured. They take the place of masks that the scene brings itself.
        images: Where their pixels are kept: memory; disk, in a file that takes their place there
            and is gone when the scene is; files, read again whenever one is looked at; auto, memory
            or disk by what is free. Built-in scenes are in memory.
        image_folder: For the file on disk; None: a folder for large temporary files.
        threads: That read photographs; None: one per usable core. Built-in scenes are drawn by all
            cores.

    Returns:
        The scene; distances are the file's own.

    Raises:
        InputError: Nothing there can be loaded, or something in it is wrong; the message names the
            file and the field.
    """
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise InputError(f"downscale must be a whole number of at least 1, not {downscale!r}.")
    require_one_of("images", images, get_args(Place))
    if threads is not None:
        require_threads(threads)
    if isinstance(path, str) and path.startswith(BUILTIN):
        if masks is not None:
            raise InputError(f"--masks {masks}: {path} takes no masks; leave them out.")
        return _load_builtin(path.removeprefix(BUILTIN), downscale)
    keeping = Keeping(place=images, folder=image_folder, threads=threads)
    path = Path(path)
    masks = None if masks is None else Path(masks)
    if not exists(path):
        known = ", ".join(BUILTIN + name for name in BUILTIN_NAMES)
        raise InputError(
            f"{path}: does not exist; give a scene's folder, or a built-in scene ({known})."
        )
    if path.is_dir():
        return _load_folder(path, downscale, masks, keeping)
    if path.name in [split_file(split) for split in SPLITS]:
        return load_blender(path.parent, downscale=downscale, masks=masks, keeping=keeping)
    if re.fullmatch(r"transforms.*\.json", path.name):
        return load_transforms(path, downscale=downscale, masks=masks, keeping=keeping)
    if path.name == llff.FILE:
        return llff.load_llff(path.parent, downscale=downscale, masks=masks, keeping=keeping)
    if path.suffix == ".npz":
        return load_npz(path, downscale=downscale, masks=masks, keeping=keeping)
    if path.suffix.lower() in VIDEOS:
        command = pose_command(shlex.quote(str(path)))
        raise InputError(f"{path}: is a video, not a scene; make one of it by {command}.")
    raise InputError(f"{path}: is not a scene; give its folder or a transforms*.json in it.")


def _load_folder(folder: Path, downscale: int, masks: Path | None, keeping: Keeping) -> Scene:
    if exists(folder / split_file("train")):
        return load_blender(folder, downscale=downscale, masks=masks, keeping=keeping)
    if exists(folder / "transforms.json"):
        return load_transforms(
            folder / "transforms.json", downscale=downscale, masks=masks, keeping=keeping
        )
    model = find_model(folder)
    if model is not None:
        return load_colmap(model, downscale=downscale, masks=masks, keeping=keeping)
    if exists(folder / llff.FILE):
        return llff.load_llff(folder, downscale=downscale, masks=masks, keeping=keeping)
    archive = single_npz(folder)
    if archive is not None and not is_unposed(folder):
        return load_npz(archive, downscale=downscale, masks=masks, keeping=keeping)
    raise InputError(
        f"{folder}: no scene found: {what_is_there(folder)}. A scene has {split_file('train')} "
        "(Blender), transforms.json (instant-ngp, nerfstudio), sparse/0 (COLMAP), "
        f"{llff.FILE} (LLFF), or one .npz file."
    )


def _load_builtin(name: str, downscale: int) -> Scene:
    if name not in BUILTIN_NAMES:
        known = " and ".join(BUILTIN + known for known in BUILTIN_NAMES)
        raise InputError(f"{BUILTIN}{name}: no such built-in scene; there are {known}.")
    from warpnerf.scenes.builtin.room import (
        room_scene,  # a ray tracer: loaded only where it is used
    )

    return room_scene(downscale=downscale, sparse=name == "room-sparse")
