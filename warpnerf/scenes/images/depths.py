"""Depth files beside photographs: how far surfaces are, measured along the optical axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import axis_cosines
from warpnerf.scenes.files import UNREAD_ENDINGS
from warpnerf.scenes.images.arrays import read_npy
from warpnerf.scenes.images.images import read_values

DEFAULT_UNIT = 1e-3
"""Metres in one of a depth file's units: millimetres, as nerfstudio has it."""

UNREAD_DEPTHS = (".pfm", ".npz", ".depth")
"""Endings of depth maps that are not read, besides those of photographs."""


@dataclass(frozen=True)
class DepthFile:
    """A depth file that was found, not read yet."""

    path: Path
    """An image of one channel, or .npy."""
    unit: float
    """What one of its units is, scene units."""


@dataclass(frozen=True, eq=False)
class Depth:
    """Depth as a file has it, for the pixels of a camera."""

    values: np.ndarray
    """[h, w] along the optical axis; of another size than the photograph if it is a lidar's."""
    unit: float
    """What one of its units is, scene units."""
    camera: Camera
    """Of the photograph, reduced as it is."""
    share: tuple[float, float] = (1.0, 1.0)
    """Of the file's rows and columns, what the camera sees: less than 1 where reducing the
    photograph leaves out pixels at the bottom or right that fill no block."""

    @property
    def shape(self) -> tuple[int, int]:
        """H, W of the photograph."""
        return self.camera.height, self.camera.width

    def read(self) -> np.ndarray:
        """The distance to what each pixel sees: the nearest value, along the pixel's ray.

        Returns:
            [H, W] float32, scene units; NaN where it is not known: where the file has 0, less, or
            what is not finite, and behind a fisheye's plane.
        """
        along = _nearest(self.values, self.shape, self.share).astype(np.float64) * self.unit
        cosine = axis_cosines(self.camera)
        known = np.isfinite(along) & (along > 0.0) & (cosine > 0.0)
        distance = np.divide(along, cosine, out=np.full(along.shape, np.nan), where=known)
        return distance.astype(np.float32)


def _nearest(values: np.ndarray, shape: tuple[int, int], share: tuple[float, float]) -> np.ndarray:
    """The values nearest to the pixels of an image of a share of the view, but another size."""
    row, column = (
        ((np.arange(size) + 0.5) * (given * seen) / size).astype(int)
        for size, given, seen in zip(shape, values.shape, share, strict=True)
    )
    return np.asarray(values[row[:, None], column])


def readable_depth(
    file: DepthFile | None, camera: Camera, downscale: int
) -> tuple[Depth | None, str]:
    """What ``read_depth`` reads, where there is a file; or None and why it cannot be read: training
    does without."""
    try:
        return None if file is None else read_depth(file, camera, downscale), ""
    except InputError as error:
        return None, str(error)


def unread_depths(reasons: Sequence[str]) -> list[str]:
    """A warning of depth maps that cannot be read.

    Args:
        reasons: Of each image: why; "" where its depth was read, or none is named.
    """
    found = [reason for reason in reasons if reason]
    if not found:
        return []
    return [
        f"depth of {len(found)} of {len(reasons)} images cannot be read, and is not used (first: "
        f"{found[0].removesuffix('.')})"
    ]


def read_depth(file: DepthFile, camera: Camera, downscale: int = 1) -> Depth:
    """Read a depth file; of one that is larger than the photograph only what that needs is kept.

    Args:
        file: Depths along the optical axis.
        camera: Of the photograph, with its pixels as they are in its file.
        downscale: Edge of the blocks of pixels that become one.

    Raises:
        InputError: The file cannot be read, or is of another shape than the photograph.
    """
    if file.path.suffix.lower() in (*UNREAD_ENDINGS, *UNREAD_DEPTHS):
        raise InputError(
            f"{file.path}: depth is read from images of one channel, usually of 16 bits, and from "
            ".npy; convert it to one of these, or remove what names it."
        )
    values = read_npy(file.path) if file.path.suffix == ".npy" else read_values(file.path)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2 or min(values.shape) == 0:
        raise InputError(
            f"{file.path}: has the shape {list(values.shape)}; depth is one number for each pixel."
        )
    rows, columns = values.shape
    if abs(columns * camera.height - rows * camera.width) > max(camera.height, camera.width):
        raise InputError(
            f"{file.path}: has {columns}x{rows} pixels, which is another shape than the "
            f"{camera.width}x{camera.height} of its photograph; give depth of the whole photograph."
        )
    reduced = camera if downscale == 1 else camera.downscaled(downscale)
    shape = reduced.height, reduced.width
    share = shape[0] * downscale / camera.height, shape[1] * downscale / camera.width
    if rows * columns > shape[0] * shape[1]:
        return Depth(_nearest(values, shape, share), file.unit, reduced)
    return Depth(values, file.unit, reduced, share)
