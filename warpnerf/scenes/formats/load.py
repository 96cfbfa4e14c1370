"""The entry point for scenes of every format: ``load_scene``."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_one_of
from warpnerf.runtime.memory import require_threads
from warpnerf.scenes.files import ARCHIVES, exists, printable
from warpnerf.scenes.formats import llff
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.blender import is_frames, is_split, load_blender, split_file
from warpnerf.scenes.formats.colmap import load_colmap
from warpnerf.scenes.formats.colmap_models import find_model
from warpnerf.scenes.formats.contents import VIDEOS, is_unposed, pose_command, what_is_there
from warpnerf.scenes.formats.npz import load_npz, single_npz
from warpnerf.scenes.formats.part import ENDING, part_of, read_part
from warpnerf.scenes.formats.programs import export_of, exports_in
from warpnerf.scenes.formats.survey import forms_in
from warpnerf.scenes.formats.transforms import load_transforms
from warpnerf.scenes.images.photographs import Keeping, Place
from warpnerf.scenes.scene import Scene
from warpnerf.scenes.split import Split, checked_split, withheld

__all__ = ["load_scene"]

BUILTIN = "builtin:"
BUILTIN_NAMES = ("room", "room-sparse")
BUILTIN_KNOWN = ", ".join(BUILTIN + name for name in (*BUILTIN_NAMES, "building-N"))


@checked_arguments
def load_scene(
    path: str | Path,
    *,
    downscale: int = 1,
    masks: str | Path | None = None,
    images: Place = "auto",
    image_folder: Path | None = None,
    threads: int | None = None,
    split: Split | Sequence[str] | None = None,
) -> Scene:
    """Load a scene: photographs, cameras, split, and the extent estimated from the cameras.

    A folder is tried as Blender / NeRF-synthetic (transforms_train.json), then as instant-ngp or
    nerfstudio (transforms.json), COLMAP (sparse/0), LLFF (poses_bounds.npy), an export of Polycam,
    Record3D, Metashape or RealityCapture, and one .npz file.

    Args:
        path: A folder, a transforms*.json, poses_bounds.npy, .npz or exported file in it, the
            folder of a COLMAP model, a .part.json of `warpnerf blocks`, or "builtin:" and the name
            of a built-in scene.
        downscale: Edge of the blocks of pixels that become one; 1 keeps the images as they are.
        masks: Folder of masks, named after the photographs: pixels that are black there are neither
            trained on nor measured. They take the place of masks that the scene brings itself.
        images: Where their pixels are kept: memory; disk, in a file that takes their place there
            and is gone when the scene is; files, read again whenever one is looked at; auto, memory
            or disk by what is free. Built-in scenes are in memory.
        image_folder: For the file on disk; None: a folder for large temporary files.
        threads: That read photographs; None: one per usable core. Built-in scenes are drawn by all
            cores.
        split: What is withheld for testing: "all": nothing, all photographs are trained on; a
            number N: every Nth, by name from the first; "sector": an eighth, of cameras side
            by side; names of photographs: these. None: as the scene says, else every 8th.

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
    split = None if split is None else checked_split(split)
    if isinstance(path, str) and path.startswith(BUILTIN):
        if masks is not None:
            raise InputError(f"--masks {masks}: {path} takes no masks; leave them out.")
        return _with_split(_load_builtin(path.removeprefix(BUILTIN), downscale), split)
    keeping = Keeping(place=images, folder=image_folder, threads=threads)
    path = Path(path)
    masks = None if masks is None else Path(masks)
    if not exists(path):
        raise InputError(
            f"{path}: does not exist; give a scene's folder, or a built-in scene ({BUILTIN_KNOWN})."
        )
    reading = Reading(downscale=downscale, masks=masks, keeping=keeping, withhold=split)
    if path.name.endswith(ENDING):
        return _load_part(path, reading)
    if path.is_dir():
        return _load_folder(path, reading)
    if is_split(path):
        return load_blender(path.parent, reading)
    if re.fullmatch(r"transforms.*\.json", path.name):
        return load_transforms(path, reading)
    if path.name == llff.FILE:
        return llff.load_llff(path.parent, reading)
    if path.suffix == ".npz":
        return load_npz(path, reading)
    export = export_of(path)
    if export is not None:
        return export.load(path, reading)
    if path.suffix.lower() == ".json" and is_frames(path):
        return load_transforms(path, reading)
    if path.suffix.lower() in VIDEOS:
        command = pose_command(shlex.quote(str(path)))
        raise InputError(f"{path}: is a video, not a scene; make one of it by {command}.")
    if path.suffix.lower() in ARCHIVES:
        raise InputError(f"{path}: is an archive; unpack it, and give the folder that it makes.")
    raise InputError(f"{path}: is not a scene; give its folder or a transforms*.json in it.")


def _load_part(path: Path, reading: Reading) -> Scene:
    part = read_part(path)
    whole = load_scene(
        part.part_of,
        downscale=reading.downscale,
        masks=reading.masks,
        images="files",
        threads=reading.keeping.threads,
        split=part.split if reading.withhold is None else reading.withhold,
    )
    return part_of(whole, part, path, reading.keeping, reading.downscale)


def _with_split(scene: Scene, split: Split | None) -> Scene:
    """A scene of which other views are withheld for testing."""
    if split is None:
        return scene
    names = [view.name for view in scene.views]
    test, note = withheld(split, names, [view.camera.c2w for view in scene.views])
    splits: dict[str, tuple[int, ...]] = {"train": (), "test": ()}
    for index, name in enumerate(names):
        splits["test" if name in test else "train"] += (index,)
    return replace(scene, splits=splits, notes=(note, *scene.notes))


def _load_folder(folder: Path, reading: Reading) -> Scene:
    try:
        scene = _first_of_folder(folder, reading)
    except InputError as error:
        model = find_model(folder)
        if model is None or not str(error).startswith(str(folder / "transforms")):
            raise
        way_out = f"or name the COLMAP model beside it, {printable(str(model))}"
        raise InputError(f"{str(error).removesuffix('.')}; {way_out}.") from None
    others = forms_in(folder)[1:]
    if not others:
        return scene
    note = f"also in the folder, and not read: {', '.join(others)}"
    return replace(scene, notes=(*scene.notes, note))


def _first_of_folder(folder: Path, reading: Reading) -> Scene:
    """The scene of the first form that a folder has."""
    if exists(folder / split_file("train")):
        return load_blender(folder, reading)
    if exists(folder / "transforms.json"):
        return load_transforms(folder / "transforms.json", reading)
    model = find_model(folder)
    if model is not None:
        return load_colmap(model, reading)
    if exists(folder / llff.FILE):
        return llff.load_llff(folder, reading)
    for export in exports_in(folder):
        return export.load(export.path, reading)
    archive = single_npz(folder)
    if archive is not None and not is_unposed(folder):
        return load_npz(archive, reading)
    raise InputError(
        f"{folder}: no scene found: {what_is_there(folder)}. A scene has {split_file('train')} "
        "(Blender), transforms.json (instant-ngp, nerfstudio), sparse/0 (COLMAP), "
        f"{llff.FILE} (LLFF), an export of Polycam, Record3D, Metashape (.xml) or RealityCapture "
        "(.csv), or one .npz file."
    )


def _load_builtin(name: str, downscale: int) -> Scene:
    rooms = re.fullmatch(r"building-(\d{1,9})", name)
    if rooms is not None:
        from warpnerf.scenes.builtin.building import building_scene

        return building_scene(int(rooms[1]), downscale=downscale)
    if name not in BUILTIN_NAMES:
        raise InputError(f"{BUILTIN}{name}: no such built-in scene; there are {BUILTIN_KNOWN}.")
    from warpnerf.scenes.builtin.room import (
        room_scene,  # a ray tracer: loaded only where it is used
    )

    return room_scene(downscale=downscale, sparse=name == "room-sparse")
