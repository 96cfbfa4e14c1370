"""Record3D's export: metadata.json with a lens and poses of frames, which are rgbd/N.jpg.

``K`` holds the lens by columns, for images of ``w`` by ``h``; ``perFrameIntrinsicCoeffs`` that of
each frame, fx, fy, cx, cy. Poses are ARKit's: quaternion x, y, z, w and position, camera to world
in OpenGL axes, y up, metres.
"""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import MAX_JSON_BYTES, read_json
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.found_photographs import (
    Entry,
    Photographs,
    PosedCamera,
    scene_of,
)
from warpnerf.scenes.scene import Scene

NAMES = ("metadata.json", "metadata")
"""Of the file: as exported, and as it lies in an unpacked .r3d."""
FOLDERS = ("rgbd", "rgb")
"""Of the photographs."""
DEPTHS = (".depth", ".exr")


class Metadata(msgspec.Struct, rename={"per_frame": "perFrameIntrinsicCoeffs"}):
    """The file; other keys are allowed and not read."""

    K: list[float]
    poses: list[list[float]]
    w: int
    h: int
    per_frame: list[list[float]] | None = None


def find_record3d(folder: Path) -> Path | None:
    """The file of an export; None where there is none."""
    if not any((folder / name).is_dir() for name in FOLDERS):
        return None
    for name in NAMES:
        try:
            if (folder / name).is_file():
                with (folder / name).open("rb") as file:
                    text = file.read(MAX_JSON_BYTES)
                if b'"poses"' in text and b'"K"' in text:
                    return folder / name
        except OSError:
            continue
    return None


def load_record3d(file: Path, reading: Reading) -> Scene:
    """Load a scene from Record3D's export.

    Args:
        file: Its metadata.
        reading: How photographs are read.

    Returns:
        The scene, in metres, y up.

    Raises:
        InputError: The file is damaged, or no photograph is there.
    """
    folder = file.parent
    data = read_json(file, Metadata)
    for name, value in (("w", data.w), ("h", data.h)):
        if value < 1:
            raise InputError(f"{file}: $.{name}: {value} is no size in pixels; export it again.")
    if not data.poses:
        raise InputError(f"{file}: $.poses: is empty; export the capture again.")
    per_frame = data.per_frame or []
    if per_frame and len(per_frame) != len(data.poses):
        raise InputError(
            f"{file}: $.perFrameIntrinsicCoeffs: is for {len(per_frame)} frames, but there are "
            f"{len(data.poses)} poses; export the capture again."
        )
    shared = None if per_frame else _shared_lens(file, data.K)
    images = next(folder / name for name in FOLDERS if (folder / name).is_dir())
    photographs = Photographs(folder, among=images)

    def entry(number: int) -> Entry:
        place = f"{file}: $.poses[{number}]"

        def read(path: Path) -> PosedCamera:
            if shared is not None:
                values, key = shared, "K"
            else:
                key = f"perFrameIntrinsicCoeffs[{number}]"
                values = _lens(file, key, per_frame[number])
            values = {**values, "w": data.w, "h": data.h}
            fields = {name: f"$.{name if name in ('w', 'h') else key}" for name in values}
            return PosedCamera(
                c2w=_pose(place, data.poses[number]),
                lens=Lens(file=file, values=values, fields=fields),
            )

        return Entry(name=f"{images.name}/{number}", place=place, read=read)

    entries = [entry(number) for number in range(len(data.poses))]
    return scene_of(file, entries, photographs, reading, lambda: (_depth_note(folder), ()))


def _shared_lens(file: Path, k: list[float]) -> dict[str, float]:
    """The lens of K, by columns as Record3D writes it, or by rows as others do."""
    if len(k) != 9:
        raise InputError(f"{file}: $.K: holds {len(k)} numbers, not 9; export the capture again.")
    by_rows = (k[6], k[7]) == (0.0, 0.0) and (k[2], k[5]) != (0.0, 0.0)
    centre = (k[2], k[5]) if by_rows else (k[6], k[7])
    return _lens(file, "K", [k[0], k[4], *centre])


def _lens(file: Path, key: str, coefficients: list[float]) -> dict[str, float]:
    if len(coefficients) != 4:
        raise InputError(
            f"{file}: $.{key}: holds {len(coefficients)} numbers, not fx, fy, cx, cy; export the "
            "capture again."
        )
    if min(coefficients[:2]) <= 0.0:
        raise InputError(f"{file}: $.{key}: its focal lengths must be above 0; export it again.")
    return dict(zip(("fl_x", "fl_y", "cx", "cy"), coefficients, strict=True))


def _pose(place: str, pose: list[float]) -> np.ndarray:
    """Camera to world, [3, 4], of a quaternion x, y, z, w and a position."""
    if len(pose) != 7:
        raise InputError(
            f"{place}: holds {len(pose)} numbers, not a quaternion x, y, z, w and a position; "
            "export the capture again."
        )
    x, y, z, w = pose[:4]
    length = math.hypot(x, y, z, w)
    if not (math.isfinite(length) and length > 1e-6):
        raise InputError(f"{place}: its quaternion {pose[:4]} is none; export the capture again.")
    x, y, z, w = (value / length for value in (x, y, z, w))
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rows = [[*row, at] for row, at in zip(rotation, pose[4:], strict=True)]
    return check_pose(rows, field=place)


def _depth_note(folder: Path) -> list[str]:
    """That depth files are there and are not read."""
    for name in (*FOLDERS, "depth"):
        if (folder / name).is_dir():
            n = sum(path.suffix in DEPTHS for path in (folder / name).iterdir())
            if n:
                return [f"{n} depth files in {name} are not read: of Record3D's own format, or EXR"]
    return []
