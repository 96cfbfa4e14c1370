"""Depth files beside photographs: how far surfaces are, measured along the optical axis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.arrays import read_npy
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.images import read_values
from warpnerf.scenes.undistort import axis_cosines

DEFAULT_UNIT = 1e-3
"""Metres in one of a depth file's units: millimetres, as nerfstudio has it."""


@dataclass(frozen=True)
class DepthFile:
    """A depth file that was found, not read yet."""

    path: Path
    """An image of one channel, or .npy."""
    unit: float
    """What one of its units is, scene units."""


def read_depth(file: DepthFile, camera: Camera) -> np.ndarray:
    """The distance to what each pixel of a camera sees.

    Files may be of another size than photographs, as those of lidars are; each pixel takes the
    nearest value. What is 0, below, or not finite, is not known.

    Args:
        file: Depths along the optical axis.
        camera: Of the photograph, with the pixels that the result shall have.

    Returns:
        [H, W] float32, along each pixel's ray, scene units; NaN where it is not known.

    Raises:
        InputError: The file cannot be read, or is of another shape than the photograph.
    """
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
    row = ((np.arange(camera.height) + 0.5) * rows / camera.height).astype(int)
    column = ((np.arange(camera.width) + 0.5) * columns / camera.width).astype(int)
    along = values[row[:, None], column].astype(np.float64) * file.unit
    cosine = axis_cosines(camera)
    known = np.isfinite(along) & (along > 0.0) & (cosine > 0.0)
    distance = np.divide(along, cosine, out=np.full(along.shape, np.nan), where=known)
    return distance.astype(np.float32)
