"""What lies in a scene's folder and is not read: masks, depth maps, points.

No file of the scene names it, so it may have been meant to be used, or not.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path, PurePath

from warpnerf.checks import InputError
from warpnerf.scenes.extent.points import Points, usable
from warpnerf.scenes.files import DEPTHS, MASKS, printable, resolve_inside
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.formats.ply import read_ply
from warpnerf.scenes.images.masks import IN_FOLDERS, SUFFIXES, has_mask_of
from warpnerf.scenes.scene import Scene

MASK_ENDINGS = (*IN_FOLDERS, ".npy", ".gif")
DEPTH_ENDINGS = (*SUFFIXES, ".npy", ".tif", ".tiff", ".exr", ".pfm")
CLOUD_ENDINGS = (".ply", ".pcd", ".las", ".laz", ".e57", ".xyz", ".pts", ".ptx")
"""Of masks, of depth maps, and of clouds of points."""

MAX_PLY_BYTES = 2**28
"""Of points that no file names: larger ones would slow down the reading of a scene."""


def unused_masks(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """Warnings of folders of masks that no frame has a mask of.

    Args:
        folder: The scene's.
        frames: Of the scene, as its files say.
    """
    masks = [frame.mask.path for frame in frames if frame.mask is not None]
    names = [frame.name for frame in frames]
    warnings = []
    for place in _unused(folder, frames, MASKS, masks, MASK_ENDINGS):
        shown = printable(shlex.quote(str(place)))
        if has_mask_of(place, names):
            way_out = f"--masks {shown} ignores what is black there"
        else:
            name = PurePath(names[0])
            way_out = (
                "none of its images is named after a photograph; name them as "
                f"{printable(name.name)}.png or {printable(name.stem)}.png"
            )
        warnings.append(f"{shown} is not used, as no frame has a mask of it: {way_out}")
    return warnings


def unused_depths(folder: Path, frames: Sequence[Frame]) -> list[str]:
    """Notes of folders of depth maps that no frame has one of.

    Args:
        folder: The scene's.
        frames: Of the scene.
    """
    maps = [frame.depth.path for frame in frames if frame.depth is not None]
    return [
        f"the depth maps in {printable(place.relative_to(folder).as_posix())} are not read: "
        "depth_file_path of a frame in transforms.json names one, to compare with"
        for place in _unused(folder, frames, DEPTHS, maps, DEPTH_ENDINGS)
    ]


def only_ply(folder: Path) -> Points | None:
    """The points of the only PLY file in a scene's folder, to be tried where a scene names none.

    Args:
        folder: The scene's.

    Returns:
        The points, not checked; None where there is no such file, or it cannot be read.
    """
    files = [path for path in _clouds(folder) if path.suffix.lower() == ".ply"]
    if len(files) != 1 or files[0].stat().st_size > MAX_PLY_BYTES:
        return None
    name = files[0].name
    try:
        positions = read_ply(resolve_inside(folder, name, field=name))
    except InputError:
        return None
    positions = positions[usable(positions)]
    return Points(positions=positions, tracks=None, source=printable(name), tried=True)


def tried_points(points: Points | None, scene: Scene) -> list[str]:
    """A note of points that were only tried: whether the scene has them."""
    if points is None or not points.tried:
        return []
    said = f"the points of {points.source}, the only .ply in the folder, are tried"
    unfit = "" if scene.points is not None else ", and not used: they are not what the cameras see"
    return [said + unfit]


def unused_points(folder: Path) -> list[str]:
    """A note of clouds of points in the folder of a scene without points, or in one within it."""
    clouds = [cloud for place in (folder, *folders_in(folder)) for cloud in _clouds(place)]
    names = [printable(cloud.relative_to(folder).as_posix()) for cloud in clouds]
    if not names:
        return []
    return [
        f"not used as points: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}; beside a "
        "transforms.json or the cameras of a photogrammetric program a single .ply is, of at most "
        f"{MAX_PLY_BYTES >> 20} MiB"
    ]


def _clouds(folder: Path) -> list[Path]:
    return [path for path in files_in(folder) if path.suffix.lower() in CLOUD_ENDINGS]


def _unused(
    folder: Path,
    frames: Sequence[Frame],
    named: re.Pattern[str],
    used: Sequence[Path],
    endings: tuple[str, ...],
) -> list[Path]:
    """Folders of a scene of such a name that hold such files, and none that is used."""
    parents = {frame.path.parent for frame in frames}
    inside = {
        place
        for parent in {*parents, *(path.parent for path in used)}
        for place in (parent, *parent.parents)
    }
    places = {folder}
    for parent in parents:
        while folder in parent.parents:
            places.add(parent)
            parent = parent.parent
    return [
        path
        for place in sorted(places)
        for path in _entries(place)
        if named.fullmatch(path.name)
        and path not in inside
        and path.is_dir()
        and any(
            entry.name.lower().endswith(endings)
            for inner in (path, *folders_in(path))
            for entry in _files(inner)
        )
    ]


def files_in(folder: Path) -> list[Path]:
    """The files of a folder, by name, but hidden ones; none where it cannot be read."""
    return [folder / name for name in sorted(entry.name for entry in _files(folder))]


def folders_in(folder: Path) -> list[Path]:
    """The folders of a folder, by name, but hidden ones; none where it cannot be read."""
    return [path for path in _entries(folder) if path.is_dir()]


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """As ``files_in``, in any order; only links cost a look at the disk each."""
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            regular = entry.is_file(follow_symlinks=False) or os.path.isfile(entry)  # noqa: PTH113
            if regular and not entry.name.startswith("."):
                yield entry


def _entries(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            names = sorted(entry.name for entry in entries)  # paths take ten times as long to sort
    except OSError:
        return []
    return [folder / name for name in names if not name.startswith(".")]
