"""Scenes in one .npz file: images, poses and one focal length, as of the tiny NeRF of the paper.

``images`` is [n, H, W, 3 or 4], in [0, 1] or uint8; ``poses`` [n, 4, 4] or [n, 3, 4], camera to
world in OpenGL axes; ``focal`` one number, pixels. Nothing in the file is unpickled.
"""

from __future__ import annotations

import lzma
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from warpnerf.checks import InputError
from warpnerf.runtime.memory import usable_memory
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import printable, require_regular_file
from warpnerf.scenes.formats.assemble import Reading, assemble
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.images.arrays import Header, read_header, read_numbers
from warpnerf.scenes.images.images import MAX_PIXELS
from warpnerf.scenes.scene import Scene

ROUNDING = 1e-3
"""How far images may be out of [0, 1]."""

_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, OSError, EOFError, ValueError),
    RuntimeError,  # of unknown compressions and of encrypted archives
)

READ = ("images", "poses", "focal")
"""Arrays of a scene."""
SHOWN = 8
"""Names of other arrays, at most, in a message."""

MAX_SMALL = 2**26
"""Bytes of all poses, at most."""


def load_npz(file: Path, reading: Reading) -> Scene:
    """Load a scene from an .npz file. Every 8th image is for testing.

    Args:
        file: With images, poses and focal; other arrays are not read.
        reading: How photographs are to be read, which are called 000, 001, ...

    Returns:
        The scene; distances are those of the poses.

    Raises:
        InputError: The file is damaged, or an array is missing or of another kind.
    """
    require_regular_file(file)
    with _told(file), zipfile.ZipFile(file) as archive:
        poses = _small(archive, file, "poses")
        focal = _small(archive, file, "focal")
        if focal.size != 1 or not np.isfinite(focal).all() or not focal.item() > 0.0:
            raise InputError(f"{file}: focal: must be one number above 0, pixels.")
        if poses.ndim != 3 or poses.shape[1:] not in ((4, 4), (3, 4)) or len(poses) == 0:
            raise InputError(
                f"{file}: poses: must be [n, 4, 4] or [n, 3, 4], not {list(poses.shape)}."
            )
        images = _images(archive, file, len(poses))
        unread = sorted({name.removesuffix(".npy") for name in archive.namelist()} - {*READ})
    warnings = []
    if unread:
        shown = ", ".join(printable(name[:40]) for name in unread[:SHOWN])
        warnings.append(
            f"{file.name}: arrays that are not read: {shown}{', ...' if unread[SHOWN:] else ''}; "
            "save a transforms.json, if the lens, the split, masks or depth are among them"
        )
    lens = Lens(file=file, values={"fl_x": float(focal.item())}, fields={"fl_x": "focal"})
    digits = max(3, len(str(len(poses) - 1)))
    frames = [
        Frame(
            name=f"{number:0{digits}}",
            path=file,
            c2w=check_pose(pose.tolist(), field=f"{file}: poses[{number}]"),
            lens=lens,
            image=image,
        )
        for number, (pose, image) in enumerate(zip(poses, images, strict=True))
    ]
    return assemble(
        folder=file.with_suffix(""),
        file=file,
        frames=frames,
        splits={},
        warnings=warnings,
        reading=reading,
    )


def single_npz(folder: Path) -> Path | None:
    """The .npz file of a folder, if there is one and no other."""
    try:
        found = sorted(folder.glob("*.npz"))
    except OSError:
        return None
    return found[0] if len(found) == 1 else None


def is_scene_file(file: Path) -> bool:
    """Whether an .npz file holds images and poses."""
    try:
        with zipfile.ZipFile(file) as archive:
            return {"images.npy", "poses.npy"} <= set(archive.namelist())
    except _DAMAGE:
        return False


@contextmanager
def _told(file: Path) -> Iterator[None]:
    """What is wrong with an archive, in one way."""
    try:
        yield
    except InputError:
        raise
    except _DAMAGE as error:
        text = printable(str(error).partition("\n")[0][:100]) or type(error).__name__
        raise InputError(f"{file}: is no whole .npz file ({text}); save it again.") from None


def _open(archive: zipfile.ZipFile, file: Path, name: str) -> tuple[IO[bytes], Header, int]:
    """An array of an archive: at its first number, its header, and how many bytes it may have."""
    try:
        info = archive.getinfo(f"{name}.npy")
    except KeyError:
        if re.search(r"(world_mat|camera_mat|scale_mat)_\d+\.npy", "\n".join(archive.namelist())):
            raise InputError(
                f"{file}: holds projection matrices (world_mat_0, ...), as of IDR and NeuS, which "
                "are not read; convert them to a transforms.json, or estimate poses again."
            ) from None
        there = printable(", ".join(sorted(archive.namelist()))[:100]) or "nothing"
        raise InputError(
            f"{file}: holds no {name}, but {there}; a scene has images, poses and focal."
        ) from None
    stream = archive.open(info)
    return stream, read_header(stream, f"{file}: {name}"), info.file_size


def _small(archive: zipfile.ZipFile, file: Path, name: str) -> np.ndarray:
    stream, header, available = _open(archive, file, name)
    if header.size > MAX_SMALL:
        raise InputError(f"{file}: {name}: has the shape {list(header.shape)}, which is too large.")
    return read_numbers(stream, header, available, f"{file}: {name}")


def _images(archive: zipfile.ZipFile, file: Path, n: int) -> list[np.ndarray]:
    """All images as uint8, read one by one."""
    stream, header, available = _open(archive, file, "images")
    shape = header.shape
    if len(shape) != 4 or shape[0] != n or shape[3] not in (3, 4) or min(shape) < 1:
        raise InputError(f"{file}: images: must be [{n}, H, W, 3 or 4], not {list(shape)}.")
    if header.fortran or (header.dtype.kind != "f" and header.dtype != np.uint8):
        order = " in Fortran's order" if header.fortran else ""
        raise InputError(
            f"{file}: images: are {header.dtype}{order}; save floats in [0, 1] or uint8."
        )
    usable = usable_memory()
    pixels = shape[0] * shape[1] * shape[2] * shape[3]
    if shape[1] * shape[2] > MAX_PIXELS or (usable is not None and pixels > usable):
        raise InputError(
            f"{file}: images: {list(shape)} need {pixels / 2**30:.1f} GiB, more than there is "
            "memory; save smaller ones."
        )
    one = Header(shape[1:], header.dtype, fortran=False)
    read: list[np.ndarray] = []
    for number in range(n):
        what = f"{file}: images[{number}]"
        values = read_numbers(stream, one, available - number * one.size, what)
        read.append(values if header.dtype == np.uint8 else _to_bytes(values, what))
    return read


def _to_bytes(values: np.ndarray, what: str) -> np.ndarray:
    if not (values.min() >= -ROUNDING and values.max() <= 1.0 + ROUNDING):  # also where it is NaN
        raise InputError(f"{what}: has values outside of [0, 1]; save floats in [0, 1] or uint8.")
    return np.round(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
