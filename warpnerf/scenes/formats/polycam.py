"""Polycam's raw data: keyframes with a file of JSON for the camera of each.

keyframes/cameras/N.json belongs to keyframes/images/N.jpg and keyframes/depth/N.png; where Polycam
has optimised them, they are in corrected_cameras and corrected_images. Poses are ARKit's: camera to
world in OpenGL axes, y up, metres. Depth is in millimetres.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import beginning, exists, read_json
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.found_photographs import (
    Entry,
    Photographs,
    PosedCamera,
    scene_of,
)
from warpnerf.scenes.formats.unnamed_photographs import UNPOSED
from warpnerf.scenes.images.depths import DepthFile
from warpnerf.scenes.images.images import image_size
from warpnerf.scenes.scene import Scene

FOLDERS = ("corrected_cameras", "cameras")
"""Of cameras, the better ones first."""
IMAGES = {"corrected_cameras": ("corrected_images", "images"), "cameras": ("images",)}
"""Of the photographs that belong to them."""
MILLIMETRE = 1e-3
LOOKED_AT = 65536
"""Bytes at the beginning of a camera's file by which it is recognised."""


class CameraFile(msgspec.Struct):
    """The camera of a keyframe; other keys are allowed and not read."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float


def find_polycam(folder: Path) -> Path | None:
    """Where the cameras of an export are; None where there is none."""
    for place in (folder / "keyframes", folder):
        for name in FOLDERS:
            if any((place / images).is_dir() for images in IMAGES[name]) and _is_polycam(
                place / name
            ):
                return place / name
    return None


def _is_polycam(cameras: Path) -> bool:
    """Whether a folder's first file of JSON has a camera's keys."""
    try:
        first = min((path for path in cameras.iterdir() if path.suffix == ".json"), default=None)
    except OSError:
        return False
    return first is not None and b'"t_00"' in beginning(first, LOOKED_AT)


def load_polycam(cameras: Path, reading: Reading) -> Scene:
    """Load a scene from Polycam's raw data.

    Args:
        cameras: The folder of cameras that ``find_polycam`` finds.
        reading: How photographs are read.

    Returns:
        The scene, in metres, y up.

    Raises:
        InputError: A camera's file is damaged, or no photograph is there.
    """
    keyframes = cameras.parent
    folder = keyframes.parent if keyframes.name == "keyframes" else keyframes
    images = next(keyframes / name for name in IMAGES[cameras.name] if (keyframes / name).is_dir())
    photographs = Photographs(folder, among=images)
    other_depth: list[str] = []

    def entry(file: Path) -> Entry:
        def read(path: Path) -> PosedCamera:
            camera, shape = read_json(file, CameraFile), image_size(path)
            pose = [[getattr(camera, f"t_{i}{j}") for j in range(4)] for i in range(3)]
            values = _lens(file, camera)
            depth = keyframes / "depth" / f"{file.stem}.png"
            fits = exists(depth) and _same_shape(image_size(depth), shape)
            if exists(depth) and not fits:
                other_depth.append(depth.name)
            return PosedCamera(
                c2w=check_pose(pose, field=f"{file}: t_00 to t_23"),
                lens=Lens(file=file, values=values, fields={name: KEYS[name] for name in values}),
                depth=DepthFile(depth, MILLIMETRE) if fits else None,
            )

        return Entry(name=file.stem, place=f"{file}", read=read)

    def say() -> tuple[list[str], list[str]]:
        notes, warnings = _uncorrected(cameras, images, len(files))
        if other_depth:
            warnings.append(
                f"keyframes/depth: left out {len(other_depth)} depth maps of another shape than "
                f"their photographs (first: {other_depth[0]})"
            )
        return notes, warnings

    files = _files(cameras)
    return scene_of(cameras, [entry(file) for file in files], photographs, reading, say)


def _files(cameras: Path) -> list[Path]:
    return sorted(path for path in cameras.iterdir() if path.suffix == ".json")


def _uncorrected(cameras: Path, images: Path, n: int) -> tuple[list[str], list[str]]:
    """Notes and warnings of corrected cameras, n, that other keyframes or photographs lack."""
    notes, every = [], cameras.with_name(FOLDERS[-1])
    if cameras.name != every.name and images.name == IMAGES[every.name][0]:
        notes.append(
            f"{cameras.name} are used with {images.name}, as there are no {IMAGES[cameras.name][0]}"
        )
    whole = len(_files(every)) if every.is_dir() else 0
    if n >= whole:
        return notes, []
    said = (
        f"{cameras.name} has {n} of the {whole} keyframes of {every.name}, which are read where "
        f"{cameras.name} is not in the folder"
    )
    return (notes, [said]) if whole - n > UNPOSED * whole else ([*notes, said], [])


KEYS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
"""Of a camera's file, by the names of a lens."""


def _lens(file: Path, camera: CameraFile) -> dict[str, float]:
    """Focal lengths and principal point, and the size of images that they are for."""
    for key in ("fx", "fy", "width", "height"):
        value = getattr(camera, key)
        if value <= 0.0 or (key in ("width", "height") and not value.is_integer()):
            raise InputError(
                f"{file}: $.{key}: {value:g} is no {'size' if key[0] in 'wh' else 'focal length'} "
                "in pixels; export the capture again."
            )
    return {name: getattr(camera, key) for name, key in KEYS.items()}


def _same_shape(one: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes are of one shape, as a depth map's and its photograph's have to be."""
    return abs(one[0] * other[1] - one[1] * other[0]) <= max(other)
