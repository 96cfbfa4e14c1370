"""transforms.json as instant-ngp and nerfstudio write it.

``transform_matrix`` is camera to world in OpenGL axes, as everywhere in this project; distances are
used as the file has them. ``aabb_scale``, ``scale`` and ``offset`` place the scene in instant-ngp's
own unit cube, which does not change the picture. ``applied_transform`` tells where the poses came
from: it turns the points of a COLMAP model with the cameras that it was applied to.
``applied_scale`` says how many of the file's units a metre is, and so what depth files mean.
"""

from __future__ import annotations

import math
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.lens import Lens, LensFields, read_lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.extent.points import Points, usable
from warpnerf.scenes.files import (
    REDUCED,
    MovedFiles,
    plain_name,
    printable,
    read_json,
)
from warpnerf.scenes.formats import left_over
from warpnerf.scenes.formats.assemble import Reading, assemble
from warpnerf.scenes.formats.colmap import points_beside
from warpnerf.scenes.formats.colmap_models import find_model, size_of
from warpnerf.scenes.formats.found_photographs import without_ending
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.formats.frame_images import elsewhere_warnings, find_images
from warpnerf.scenes.formats.ply import read_ply
from warpnerf.scenes.formats.split_lists import read_split_lists
from warpnerf.scenes.formats.unnamed_photographs import same_names_beside, unnamed_photographs
from warpnerf.scenes.images.depths import DEFAULT_UNIT, DepthFile
from warpnerf.scenes.images.masks import Mask
from warpnerf.scenes.scene import Scene

IGNORED = {
    "white_transparent": "white stays opaque",
    "black_transparent": "black stays opaque",
    "mask_color": "that colour stays opaque",
    "rolling_shutter": "each image is taken at one instant",
}
"""Keys that would change the picture, and what happens without them."""
OF_FRAMES = ("mask_path", "depth_file_path", "depth_path")
"""Keys of frames that name files besides the photograph."""


class PictureKeys(LensFields):
    """A lens, and the keys that are named in a warning because they are not used."""

    white_transparent: object = None
    black_transparent: object = None
    mask_color: object = None
    rolling_shutter: object = None


class FrameEntry(PictureKeys, kw_only=True):
    """One posed image."""

    file_path: str
    transform_matrix: list[list[float]]
    mask_path: str | None = None
    depth_file_path: str | None = None
    depth_path: str | None = None
    """As instant-ngp calls it."""


class TransformsFile(PictureKeys, kw_only=True):
    """The whole file; other keys are allowed and not read."""

    frames: list[FrameEntry]
    ply_file_path: str | None = None
    applied_transform: object = None
    mask_path: str | None = None
    depth_unit_scale_factor: float = DEFAULT_UNIT
    applied_scale: float = 1.0
    integer_depth_scale: float | None = None
    """Of instant-ngp's depth_path: scene units in one of its units."""
    enable_depth_loading: object = True
    """Of instant-ngp: whether it reads depth_path."""
    train_filenames: list[str] | None = None
    val_filenames: list[str] | None = None
    test_filenames: list[str] | None = None


def load_transforms(file: Path, reading: Reading) -> Scene:
    """Load a scene from a transforms.json.

    The split is the file's ``{train,val,test}_filenames``, else that of lists beside it, else every
    8th image is for testing; none is where the file lists all for training, and for testing all or
    none. Box and content distance are those of the points of a COLMAP model in
    the folder whose cameras are the same, or that ``ply_file_path`` names, or of the only .ply in
    the folder, where there are such.

    Args:
        file: The file; image paths in it are relative to its folder and stay inside it.
        reading: How photographs are to be read.

    Raises:
        InputError: Something in the file or its images is wrong; the message names it.
    """
    folder = file.parent
    data, frames, warnings = read_frames(file)
    few, many = _unnamed(file, frames)
    warnings += many
    names = {frame.name: frame.name for frame in frames}
    names |= {frame.called: frame.name for frame in frames if frame.called}
    splits: dict[str, set[str]] = {}
    for split in ("train", "val", "test"):
        listed = getattr(data, f"{split}_filenames") or []
        members, absent = _listed_names(folder, file, split, listed, names)
        if listed and not members:
            raise InputError(
                f"{file}: $.{split}_filenames: names no image that is among the frames (first: "
                f"{listed[0]}); correct the list or remove it."
            )
        if absent:
            warnings.append(
                f"{file.name}: not among the frames: {len(absent)} of {len(listed)} "
                f"{split}_filenames (first: {absent[0]})"
            )
        splits[split] = members
    listed_in: list[str] = []
    if reading.withhold is None and not any(splits.values()):
        called = {frame.called or frame.name: frame.name for frame in frames}
        members_of, listed_in, lost = read_split_lists(folder, called, called)
        splits = {split: {called[name] for name in of} for split, of in members_of.items()}
        warnings += lost
    trained = splits.get("train", set())
    if trained == set(names.values()) and all(of in (set(), trained) for of in splits.values()):
        reading = replace(reading, withhold=reading.withhold or "all")
    points, why_not = _points(file, data, frames)
    if why_not:
        warnings.append(why_not)
    if points is None:
        points = left_over.only_ply(folder)
    scene = assemble(
        folder=folder,
        file=file,
        frames=frames,
        splits=splits,
        warnings=warnings,
        reading=reading,
        points=points,
    )
    tried = left_over.tried_points(points, scene)
    return replace(scene, notes=(*few, *listed_in, *tried, *scene.notes))


def _unnamed(file: Path, frames: Sequence[Frame]) -> tuple[list[str], list[str]]:
    """Notes and warnings of photographs that the file does not name."""
    folder = file.parent
    photographs = [frame.path for frame in frames]
    others = [of.path for frame in frames for of in (frame.mask, frame.depth) if of is not None]
    root = folder / os.path.commonpath([path.relative_to(folder).parent for path in photographs])
    few, many = unnamed_photographs(root, {*photographs, *others}, printable(file.name))
    model = find_model(folder) if few or many else None
    n = None if model is None else size_of(model)
    if model is not None and n is not None and n > len(frames):
        advice = f"; name {printable(str(model))} to read the COLMAP model, which has {n}"
        few, many = ([said + advice for said in part] for part in (few, many))
    return [*few, *same_names_beside(folder, photographs, printable(file.name))], many


def _points(file: Path, data: TransformsFile, frames: Sequence[Frame]) -> tuple[Points | None, str]:
    """The points of a COLMAP model with the same cameras, else those that the file names.

    The model comes first because its points have tracks: which photograph sees which.

    Returns:
        The points, or None; and a warning if there are some that are not used.
    """
    ply_file_path = data.ply_file_path
    beside, why_not = points_beside(file.parent, frames, _applied(data))
    if ply_file_path is None or (beside is not None and beside.tracks is not None):
        return beside, why_not
    path = MovedFiles(file.parent, alone=True).find(ply_file_path, field=f"{file}: $.ply_file_path")
    if path is None:
        return None, f"{file.name}: ply_file_path {printable(ply_file_path)} is not there"
    positions = read_ply(path)
    positions = positions[usable(positions)]
    return Points(positions=positions, tracks=None, source=ply_file_path), ""


def _applied(data: TransformsFile) -> np.ndarray | None:
    """The applied transform, [3, 4], where it is one."""
    try:
        matrix = msgspec.convert(data.applied_transform, list[list[float]])
        return check_pose(matrix, field="applied_transform")
    except (msgspec.ValidationError, InputError):
        return None


def read_frames(
    file: Path, required: bool = True, taken: Collection[Path] = ()
) -> tuple[TransformsFile, list[Frame], list[str]]:
    """Read a file of frames and check everything but the images' pixels.

    Args:
        file: To read.
        required: Whether one of its images at least must be there.
        taken: Images of other files, which are this one's only where it gives their very paths.

    Returns:
        The file's content, the frames whose images are there, and warnings of the others.

    Raises:
        InputError: As ``load_transforms``.
    """
    data = read_json(file, TransformsFile)
    found, warnings, moved = find_images(
        file.parent, file, [entry.file_path for entry in data.frames], required, taken
    )
    unit = data.depth_unit_scale_factor * data.applied_scale
    unit_of_ngp = unit if data.integer_depth_scale is None else data.integer_depth_scale
    if not (unit > 0.0 and math.isfinite(unit)):
        raise InputError(
            f"{file}: $.depth_unit_scale_factor: {data.depth_unit_scale_factor:g} with an "
            f"applied_scale of {data.applied_scale:g} is no unit of depth; give numbers above 0."
        )
    ngp_depth = data.enable_depth_loading is not False and any(e.depth_path for e in data.frames)
    if ngp_depth and not unit_of_ngp > 0.0:
        raise InputError(
            f"{file}: $.integer_depth_scale: {unit_of_ngp:g} is no unit of depth; give a number "
            "above 0."
        )
    frames = []
    named = {key: _Named(file, key, found.values()) for key in OF_FRAMES}
    for index, path in found.items():
        entry = data.frames[index]
        place = f"$.frames[{index}]"
        mask = named["mask_path"].find(place, entry.mask_path)
        if mask is None and not entry.mask_path:
            mask = named["mask_path"].find("$", data.mask_path)
        depth = named["depth_file_path"].find(place, entry.depth_file_path)
        depth_unit = unit
        if ngp_depth and not entry.depth_file_path:
            depth = named["depth_path"].find(place, entry.depth_path)
            depth_unit = unit_of_ngp
        lens = read_lens(file, [(place, entry), ("$", data)])
        if index in moved:
            _require_size(file, place, lens, path)
        frames.append(
            Frame(
                name=path.relative_to(file.parent).as_posix(),
                path=path,
                c2w=check_pose(entry.transform_matrix, field=f"{file}: {place}.transform_matrix"),
                lens=lens,
                mask=None if mask is None else Mask(mask),
                depth=None if depth is None else DepthFile(depth, depth_unit),
                called=entry.file_path if index in moved else "",
                elsewhere=moved.get(index, False),
            )
        )
    warnings += elsewhere_warnings(file, frames)
    for key, of_key in named.items():
        if of_key.lost:
            warnings.append(
                f"{file.name}: the {key} of {len(of_key.lost)} of {len(data.frames)} frames leads "
                f"to no file (first: {of_key.lost[0]})"
            )
    for key, consequence in IGNORED.items():
        if any(_is_set(getattr(level, key)) for level in (data, *data.frames)):
            warnings.append(f"{file.name}: {key} is not used: {consequence}")
    return data, frames, warnings


def _is_set(value: object) -> bool:
    """Whether a value of a key that is not used means something: not of zeros only."""
    return any(map(_is_set, value)) if isinstance(value, list) else bool(value)


def _require_size(file: Path, place: str, lens: Lens, path: Path) -> None:
    """Refuse a lens in pixels of images that are there reduced only, where it has no size."""
    reduced = next((p.name for p in path.parents if REDUCED.fullmatch(p.name)), None)
    if reduced and not lens.values.keys() >= {"w", "h"} and lens.values.keys() & {"fl_x", "fl_y"}:
        raise InputError(
            f"{file}: {place}: its image is only in {reduced}, and without w and h its lens in "
            "pixels cannot be scaled to that; add the w and h of the original images."
        )


class _Named:
    """Files that a key of frames names."""

    def __init__(self, file: Path, key: str, photographs: Iterable[Path]) -> None:
        self._field, self._key = f"{file}: ", key
        self._files = MovedFiles(file.parent, taken=set(photographs))
        self.lost: list[str] = []
        """Those that are not there, as the file has them."""

    def find(self, place: str, text: str | None) -> Path | None:
        """That of a place in the file, if it names one that is there."""
        if not text:
            return None
        path = self._files.find(text, field=f"{self._field}{place}.{self._key}")
        if path is None:
            self.lost.append(text)
        return path


def _listed_names(
    folder: Path, file: Path, split: str, listed: Sequence[str], names: Mapping[str, str]
) -> tuple[set[str], list[str]]:
    """Sort a list of file names into those of frames, by frame name, and the others.

    Args:
        folder: The scene's.
        file: That holds the list, for messages.
        split: Whose list it is.
        listed: The list.
        names: Of frames, by these and by what the file calls them.
    """
    members: set[str] = set()
    absent: list[str] = []
    ends, moved = _ends(names), MovedFiles(folder)
    for index, text in enumerate(listed):
        name = names.get(text)
        if name is None:
            called = ends.get(plain_name(text), set())
            name = min(called) if len(called) == 1 else None
        if name is None:
            path = moved.find(text, field=f"{file}: $.{split}_filenames[{index}]")
            name = names.get(path.relative_to(folder).as_posix()) if path else None
        if name is None:
            absent.append(text)
        else:
            members.add(name)
    return members, absent


def _ends(names: Mapping[str, str]) -> dict[str, set[str]]:
    """The frames whose names end so, with and without the ending of a photograph."""
    ends: dict[str, set[str]] = {}
    for called, name in names.items():
        parts = plain_name(called).split("/")
        for start in range(len(parts)):
            end = "/".join(parts[start:])
            for text in {end, without_ending(end)}:
                ends.setdefault(text, set()).add(name)
    return ends
