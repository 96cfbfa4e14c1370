"""What a folder without a scene holds, and the command that makes one of it."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
from contextlib import suppress
from itertools import islice
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import (
    ANY_PHOTOGRAPHS,
    ENDINGS,
    UNREAD_ENDINGS,
    beginning,
    exists,
    printable,
)
from warpnerf.scenes.formats import llff
from warpnerf.scenes.formats.blender import SPLITS, other_transforms, split_file
from warpnerf.scenes.formats.colmap_models import find_model, model_kind
from warpnerf.scenes.formats.found_photographs import is_written
from warpnerf.scenes.formats.npz import is_scene_file, single_npz
from warpnerf.scenes.formats.programs import exports_in
from warpnerf.scenes.images.masks import without_masks

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".avi", ".webm")

SPHERES = (".insv", ".insp", ".360")
"""Of Insta360 and GoPro Max."""

BESIDE_PHOTOGRAPHS = ("sparse/0", "sparse")
"""Where a model is looked for of which a file is missing."""

UNREAD_POSES = (
    *("*.nvm", "bundle*.out", "sfm_data.json", "*.sfm", "cameras.json", "*.psx", "*.rcproj"),
    *("*.rsproj", "reconstruction.json", "opensfm/reconstruction.json", "pose/*.txt"),
    *("camera/*.json", "cams/*_cam.txt", "traj.txt", "poses.txt", "poses.npy", "*.pose.txt"),
    "predictions.npz",
)
"""Files of poses that are not read: of VisualSFM, Bundler, OpenMVG, Meshroom, 3DGS, Metashape,
RealityCapture, RealityScan, OpenSfM, NSVF, Nerfies, MVSNet, Replica, KITTI, 7-Scenes and VGGT."""

TEXTS = (".csv", ".txt", ".xmp", ".xml", ".json")
PLACES_OF_TEXTS = (".", "images", "params", "1_initial/params")
POSES_IN_TEXT = re.compile(
    rb"omega\W+phi\W+kappa|heading\W+pitch\W+roll|yaw\W+pitch\W+roll|xcr:(rotation|position)|"
    rb"<BlocksExchange|qx\W+qy\W+qz\W+qw|cameraPoseARFrame|\"camtoworld\"",
    re.IGNORECASE,
)
"""Texts in which poses are recognised by what they begin with, of Metashape, RealityCapture, Pix4D,
for exchange between programs of ContextCapture, and of TUM, Stray Scanner, 3D Scanner App and
SDFStudio."""
LOOKED_AT = 4096
"""Bytes at the beginning of a text."""
MOST_TEXTS = 4096
"""At a place, that are looked at."""

NEEDED = 3
"""Photographs, at least, whose poses can be estimated."""

DEEPEST = 3
MOST = 200
"""How deep in a folder without photographs scenes are looked for, and in how many folders."""


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
    return [path for place in places for path in _with_endings(place, UNREAD_ENDINGS)]


def is_unposed(path: Path) -> bool:
    """Whether a path leads to what poses can be estimated of: photographs without any, a video.

    Poses that can be read are not skipped unasked: other files of frames, a COLMAP model in any
    folder within, a scene whose images/ the folder is.
    """
    if path.is_dir():
        posed = holds_scene(path) or _lacking(path, BESIDE_PHOTOGRAPHS) is not None
        if posed or len(photographs_in(path)) < NEEDED:
            return False
        return _poses_nearby(path) is None and all(
            find_model(inner) is None for inner in _entries(path) if inner.is_dir()
        )
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
        return _scenes(folder, scenes)
    nearby = _poses_nearby(folder)
    if nearby is not None:
        return nearby
    photographs = photographs_in(folder)
    scenes = [] if photographs else _scenes_below(folder)
    if scenes:
        return _scenes(folder, scenes)
    unread = unread_photographs(folder)
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
        return _unposed(folder, photographs, unread)
    half = _half_a_model(folder)
    if half:
        return half
    videos = _with_endings(folder, VIDEOS)
    if videos:
        first = shlex.quote(str(videos[0]))
        poses = _unread_poses(folder)
        if poses:
            return f"{poses}, or estimate others by {pose_command(first)}"
        return f"it holds the video {videos[0].name}; make a scene of it by {pose_command(first)}"
    if unread:
        return f"it holds {len(unread)} photographs as {_kind(unread[0])}; convert them to JPEG"
    spheres = _with_endings(folder, SPHERES)
    if spheres:
        n = len(spheres)
        return (
            f"it holds {n} recording{'s' * (n > 1)} of a 360-degree camera (first: "
            f"{printable(spheres[0].name)}); export flat photographs or videos with its program"
        )
    counts = {path: len(photographs_in(path)) for path in inner if not is_written(path)}
    deeper = {path: n for path, n in counts.items() if n}
    if deeper:
        largest = max(deeper, key=lambda path: deeper[path])
        command = pose_command(shlex.quote(str(largest)))
        poses, name = _unread_poses(folder), largest.name
        if poses:
            return f"{poses}, or estimate others by {command}"
        if len(deeper) > 1:
            return (
                f"{len(deeper)} of its folders hold {sum(deeper.values())} photographs without "
                f"poses; copy them into one folder, or estimate those of {name} alone by {command}"
            )
        return (
            f"its folder {name} holds {deeper[largest]} photographs without poses; estimate them "
            f"by {command}"
        )
    poses = _unread_poses(folder)
    if poses:
        return poses
    if not _entries(folder):
        return "it is empty"
    return "it holds neither poses nor photographs nor a video"


def _scenes(folder: Path, scenes: list[Path]) -> str:
    """What to say of folders that hold a scene each."""
    use = f"use {_quoted(scenes[0])}"
    name = printable(scenes[0].relative_to(folder).as_posix())
    if len(scenes) == 1:
        return f"its folder {name} holds one; {use}"
    return f"{len(scenes)} of its folders hold one each (first: {name}); {use}"


def _scenes_below(folder: Path) -> list[Path]:
    """Folders that hold scenes, not as deep in a folder as others; none where it has too many."""
    places = [folder]
    for _ in range(DEEPEST):
        places = [inner for place in places for inner in _folders(place) if not is_written(inner)]
        if len(places) > MOST:
            break
        scenes = [path for path in places if holds_scene(path)]
        if scenes:
            return scenes
    return []


def _poses_nearby(folder: Path) -> str | None:
    """What to say of poses that can be read, where the folder that was named leads to none."""
    others = [*other_transforms(folder), *_scenes_as_npz(folder)]
    if others:
        named = ", ".join(printable(path.name) for path in others[:3])
        return f"it holds {named}{', ...' if others[3:] else ''}; use {_quoted(others[0])}"
    for place in _entries(folder):
        models = [path for path in _folders(place) if model_kind(path) is not None]
        if models and not holds_scene(place):
            name = printable(models[0].relative_to(folder).as_posix())
            return f"its COLMAP model is in {name}; use {_quoted(models[0])}"
    above = folder.absolute().parent
    if ANY_PHOTOGRAPHS.fullmatch(folder.name) and holds_scene(above):
        return (
            f"it is a folder of the scene {printable(above.name)}; use {_quoted(above)}, or "
            f"estimate other poses by {pose_command(_quoted(folder))}"
        )
    return None


def _scenes_as_npz(folder: Path) -> list[Path]:
    return [path for path in _with_endings(folder, (".npz",)) if is_scene_file(path)]


def _unposed(folder: Path, photographs: list[Path], unread: list[Path]) -> str:
    """What to say of photographs without poses."""
    n = len(photographs)
    more = without_masks(_with_endings(folder / "images", ENDINGS))
    inside = photographs[0].parent != folder / "images" and len(more) > n
    said = f"it holds {n} photographs without poses"
    if inside:
        said += f", and {len(more)} in images"
    if unread:
        said += f", and {len(unread)} as {_kind(unread[0])}, to be converted to JPEG"
    command = pose_command(_quoted(folder / "images" if inside else folder))
    poses = _unread_poses(folder)
    if poses:
        return f"{poses}, or estimate others by {command}"
    return f"{said}; estimate {'those in images' if inside else 'them'} by {command}"


def _unread_poses(folder: Path) -> str:
    """What to say of poses in forms that are not read; empty: there are none."""
    found: list[Path] = []
    with suppress(OSError, InputError):
        for pattern in UNREAD_POSES:
            found += sorted(folder.glob(pattern))[:1]
        for place in PLACES_OF_TEXTS:
            for ending in TEXTS:
                texts = _with_endings(folder / place, (ending,))[:MOST_TEXTS]
                with_poses = (t for t in texts if POSES_IN_TEXT.search(beginning(t, LOOKED_AT)))
                found += islice(with_poses, 1)
    if not found:
        return ""
    named = ", ".join(printable(path.relative_to(folder).as_posix()) for path in found[:3])
    return (
        f"it holds poses in a form that is not read ({named}); export them for COLMAP, as "
        "Metashape's XML, or as RealityCapture's internal and external camera parameters"
    )


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
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries)  # paths take ten times as long to sort
    except OSError as error:
        raise InputError(
            f"{folder}: the folder cannot be read ({error.strerror}); give access to it."
        ) from None
    return [folder / name for name in names if not name.startswith(".")]


def _folders(place: Path) -> list[Path]:
    return [path for path in _entries(place) if path.is_dir()] if _readable(place) else []


def _quoted(path: Path) -> str:
    return printable(shlex.quote(str(path)))


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
