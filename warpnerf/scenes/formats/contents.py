"""What a folder without a scene holds, and the command that makes one of it."""

from __future__ import annotations

import importlib.util
import shlex
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import ENDINGS, exists
from warpnerf.scenes.formats import llff
from warpnerf.scenes.formats.blender import SPLITS, split_file
from warpnerf.scenes.formats.colmap_models import find_model
from warpnerf.scenes.formats.found_photographs import is_written
from warpnerf.scenes.formats.npz import is_scene_file, single_npz
from warpnerf.scenes.formats.programs import exports_in
from warpnerf.scenes.images.masks import without_masks

UNREAD_PHOTOGRAPHS = (".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf")
"""Endings of photographs that phones and cameras write and that are not read."""

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")

BESIDE_PHOTOGRAPHS = ("sparse/0", "sparse")
"""Where a model is looked for of which a file is missing."""

NEEDED = 3
"""Photographs, at least, whose poses can be estimated."""


def holds_scene(folder: Path) -> bool:
    """Whether a folder holds one of the formats that ``load_scene`` reads."""
    files = [*map(split_file, SPLITS[:1]), "transforms.json", llff.FILE]
    known = any(exists(folder / name) for name in files)
    if known or find_model(folder) is not None or exports_in(folder):
        return True
    archive = single_npz(folder)  # programs export other things as .npz too
    return archive is not None and is_scene_file(archive)


def photographs_in(folder: Path) -> list[Path]:
    """The photographs of a folder, by name: those directly in it, or else those in its images/.

    Args:
        folder: To look into.

    Returns:
        Their paths; those of neither place are none.

    Raises:
        InputError: The folder cannot be read.
    """
    for place in (folder, folder / "images"):
        photographs = without_masks(_with_endings(place, ENDINGS))
        if photographs:
            return photographs
    return []


def unread_photographs(folder: Path) -> list[Path]:
    """Photographs in the same places whose formats are not read."""
    places = (folder, folder / "images")
    return [path for place in places for path in _with_endings(place, UNREAD_PHOTOGRAPHS)]


def is_unposed(path: Path) -> bool:
    """Whether a path leads to what poses can be estimated of: photographs without any, a video.

    A COLMAP model in any folder within is not skipped unasked.
    """
    if path.is_dir():
        posed = holds_scene(path) or _lacking(path, BESIDE_PHOTOGRAPHS) is not None
        if posed or len(photographs_in(path)) < NEEDED:
            return False
        return all(find_model(inner) is None for inner in _entries(path) if inner.is_dir())
    return path.suffix.lower() in VIDEOS and exists(path)


def what_is_there(folder: Path) -> str:
    """What of use a folder without a scene holds, and the one command for it: half a sentence."""
    try:
        return _what_is_there(folder)
    except InputError as error:
        return str(error).removeprefix(f"{folder}: ").removesuffix(".")


def _what_is_there(folder: Path) -> str:
    named = shlex.quote(str(folder))
    inner = [path for path in _entries(folder) if path.is_dir() and _readable(path)]
    scenes = [path for path in inner if holds_scene(path)]
    if scenes:
        first = shlex.quote(str(scenes[0]))
        if len(scenes) == 1:
            return f"its folder {scenes[0].name} holds one; use {first}"
        return f"{len(scenes)} of its folders hold one each (first: {scenes[0].name}); use {first}"
    photographs = photographs_in(folder)
    if photographs:
        n = len(photographs)
        lacking = _lacking(folder, BESIDE_PHOTOGRAPHS)
        if lacking is not None:
            return (
                f"its COLMAP model lacks {lacking}; copy or export the model again, or estimate "
                f"other poses by {pose_command(named)}"
            )
        if n < NEEDED:
            return (
                f"it holds {n} photograph{'s' if n > 1 else ''}, and poses need at least {NEEDED}"
            )
        return f"it holds {n} photographs without poses; estimate them by {pose_command(named)}"
    half = _half_a_model(folder)
    if half:
        return half
    videos = _with_endings(folder, VIDEOS)
    if videos:
        first = shlex.quote(str(videos[0]))
        return f"it holds the video {videos[0].name}; make a scene of it by {pose_command(first)}"
    unread = unread_photographs(folder)
    if unread:
        return f"it holds {len(unread)} photographs as {_kind(unread[0])}; convert them to JPEG"
    deeper = [path for path in inner if photographs_in(path) and not is_written(path)]
    if deeper:
        first = shlex.quote(str(deeper[0]))
        n = len(photographs_in(deeper[0]))
        return (
            f"its folder {deeper[0].name} holds {n} photographs without poses; estimate them by "
            f"{pose_command(first)}"
        )
    if not _entries(folder):
        return "it is empty"
    return "it holds neither poses nor photographs nor a video"


def pose_command(source: str) -> str:
    """The command that estimates poses, and before it what has to be installed for that."""
    command = f"`warpnerf pose {source} --output SCENE`"
    if importlib.util.find_spec("pycolmap") is None:
        return f'`pip install "warpnerf[sfm]"` and {command}'
    return command


def _half_a_model(folder: Path) -> str | None:
    """What to say of a COLMAP project that is not finished."""
    lacking = _lacking(folder, (*BESIDE_PHOTOGRAPHS, "."))
    if lacking is not None:
        return f"its COLMAP model lacks {lacking}; copy or export the model again"
    if exists(folder / "database.db"):
        return "it holds a database of COLMAP but no model (sparse/0) and no photographs; copy both"
    return None


def _lacking(folder: Path, places: tuple[str, ...]) -> str | None:
    """The file that is missing where one of a model's two is there; None: no such half."""
    for place in places:
        for ending in ("bin", "txt"):
            files = ("cameras", "images")
            absent = [name for name in files if not exists(folder / place / f"{name}.{ending}")]
            if len(absent) == 1:
                return f"{Path(place) / absent[0]}.{ending}"
    return None


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be read ({error.strerror}); give access to it."
        ) from None


def _readable(folder: Path) -> bool:
    try:
        next(folder.iterdir(), None)
    except OSError:
        return False
    return True


def _with_endings(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    """Files of a folder with one of these endings, by name; none where there is no folder."""
    if not folder.is_dir():
        return []
    return [p for p in _entries(folder) if p.suffix.lower() in endings and p.is_file()]


def _kind(path: Path) -> str:
    return path.suffix.lstrip(".").upper()
