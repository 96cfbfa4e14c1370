"""The folder of a posed scene: transforms.json, pose.json, and how all of it comes into place.

images/ or the user's own      the photographs
transforms.json                lenses and poses of those that were placed, OpenGL axes, z up
sparse_pc.ply                  the points that they share
sparse/0/                      the same as a COLMAP model
masks/                         those that were given
pose.json                      what was found, what it was made of, and which files were written
"""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from warpnerf.checks import InputError
from warpnerf.scenes.files import exists, read_json
from warpnerf.scenes.formats.assemble import POSED
from warpnerf.scenes.formats.contents import holds_scene
from warpnerf.sfm.photographs import put_into

TRANSFORMS = "transforms.json"
POINTS = "sparse_pc.ply"
MODEL = "sparse/0"
SUMMARY = POSED
IN_RUN = "scene"
"""Folder of a run that was given photographs without poses, for the scene made of them."""
NEXT_IN_RUN = "next/scene"
"""Where that scene is until the run begins: until then the folder may hold another run."""


class Record(msgspec.Struct):
    """What pose.json says, as far as it is read again."""

    made_of: dict[str, Any]
    written: list[str]


def read_record(folder: Path) -> Record | None:
    """What pose.json in a folder says; None where there is none."""
    return read_json(folder / SUMMARY, Record) if exists(folder / SUMMARY) else None


def require_free(folder: Path, source: Path, overwrite: bool) -> None:
    """Raise InputError unless a posed scene may be written to a folder.

    Args:
        folder: Need not exist; may be that of the photographs.
        source: The photographs' folder, or a video.
        overwrite: Whether a posed scene in it may be replaced.

    Raises:
        InputError: It is a file, or holds something else, or a scene.
    """
    if not exists(folder):
        return
    if not folder.is_dir():
        raise InputError(f"--output {folder} is a file; name a folder for the scene.")
    if read_record(folder) is not None:
        if overwrite:
            return
        raise InputError(
            f"--output {folder} holds a posed scene already; replace it by --overwrite, or name "
            "another folder."
        )
    if holds_scene(folder):
        raise InputError(f"--output {folder} holds a scene already; name another folder.")
    own = source.resolve().is_relative_to(folder.resolve())
    if not own and any(folder.iterdir()):
        raise InputError(f"--output {folder} holds other files; name a new folder.")


def move_into(prepared: Path, folder: Path) -> None:
    """Put the files of a prepared folder in their place, its record and transforms.json last.

    A posed scene that is there already loses the files that its record lists and the new one's does
    not, once the new one is whole: until then the older one can still be loaded.

    Raises:
        OSError: They cannot be moved.
    """
    if not exists(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        prepared.replace(folder)
        return
    older, newer = read_record(folder), read_record(prepared)
    last = [prepared / SUMMARY, prepared / TRANSFORMS]
    files = [path for path in prepared.rglob("*") if path.is_file() and path not in last]
    for path in [*files, *filter(exists, last)]:
        target = folder / path.relative_to(prepared)
        target.parent.mkdir(parents=True, exist_ok=True)
        path.replace(target)
    if older is not None:
        kept = set() if newer is None else set(newer.written)
        remove_written(folder, Record(older.made_of, sorted({*older.written} - kept)))
    shutil.rmtree(prepared)  # empty folders


def copy_written(folder: Path, record: Record, target: Path) -> None:
    """Put the files of a posed scene into another folder too, as hard links where possible.

    The record comes first, so that whatever is there of a copy can be removed by it.

    Raises:
        OSError: They cannot be written.
    """
    for path in sorted(_written(folder, record), key=lambda path: path.name != SUMMARY):
        place = target / path.relative_to(folder.resolve())
        put_into(place.parent, path, path.name)


def remove_written(folder: Path, record: Record) -> None:
    """Remove the files of a posed scene, and folders that are then empty; nothing else."""
    root = folder.resolve()
    for path in _written(folder, record):
        path.unlink()
    folders = {parent for name in record.written for parent in Path(name).parents[:-1]}
    for inner in sorted((root / name for name in folders), reverse=True):
        if inner.resolve().is_relative_to(root):
            with suppress(OSError):  # not empty, or never made
                inner.rmdir()


def remove_posed(folder: Path) -> None:
    """Remove what the record of a posed scene lists, and the folder if that was all."""
    record = read_record(folder)
    if record is not None:
        remove_written(folder, record)
        with suppress(OSError):  # not empty
            folder.rmdir()


def _written(folder: Path, record: Record) -> list[Path]:
    """The files that a record lists, as far as they are there; none outside the folder."""
    root = folder.resolve()
    paths = [root / name for name in record.written]
    return [p for p in paths if p.resolve().is_relative_to(root) and p.is_file()]
