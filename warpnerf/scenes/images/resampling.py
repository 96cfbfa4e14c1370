"""Undistortion of photographs: pixels moved from a lens that kernels do not have to one they have.

The two lenses are nearly the same, so that pixels move little and smoothly: by how much is computed
at knots, and is bilinear in between.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.foreign import ForeignLens, ImagePlane
from warpnerf.scenes.cameras.undistort import LENS, directions, posed

N_KNOTS = 65
"""Along each side of the image."""
BAND = 2**16
"""Pixels, about, that are moved at a time."""
FAR = 1e6
"""Pixels that something is moved by for which the photograph shows nothing."""


@dataclass(frozen=True, eq=False)
class Resampling:
    """From photographs of one lens to those of another."""

    lens: ForeignLens
    """That took the photographs."""
    plane: ImagePlane
    """Of the photographs."""
    camera: Camera
    """With the lens that they are to have, of the same size; its pose does not matter."""

    def image(self, pixels: np.ndarray) -> np.ndarray:
        """A photograph as the other lens sees it, by Catmull-Rom interpolation.

        Args:
            pixels: [H, W, 3 or 4] uint8, straight alpha.

        Returns:
            The same shape; beyond the photograph's edges, its edges.
        """
        height, width, channels = pixels.shape
        # A plane for each channel: gathering single numbers is six times as fast as rows of three.
        planes = np.ascontiguousarray(pixels.reshape(-1, channels).T)
        if channels == 4:  # colours count by their alpha
            planes = planes.astype(np.float32)
            planes[:3] *= planes[3] / 255.0
        result = np.empty_like(pixels)
        for rows in _bands(height, width):
            u, v = self._positions(rows)
            across, along = _taps(u, width), _taps(v, height)
            total = np.zeros((channels, *u.shape), np.float32)
            for row, down in along:
                for column, right in across:
                    place, weight = row * width + column, down * right
                    for channel in range(channels):
                        total[channel] += weight * planes[channel][place]
            if channels == 4:
                total[:3] *= 255.0 / np.maximum(total[3], 1.0)
            result[rows] = np.clip(np.rint(total), 0.0, 255.0).transpose(1, 2, 0)
        return result

    def mask(self, counts: np.ndarray | None) -> np.ndarray:
        """A mask as the other lens sees it: the nearest pixels.

        Args:
            counts: Which pixels count, [H, W] bool; None: all.

        Returns:
            [H, W] bool; false where the photograph shows nothing.
        """
        height, width = self.plane.height, self.plane.width
        result = np.empty((height, width), bool)
        for rows in _bands(height, width):
            u, v = self._positions(rows)
            inside = (u >= 0.0) & (u < width) & (v >= 0.0) & (v < height)
            if counts is not None:
                row = np.clip(v, 0, height - 1).astype(int)
                inside &= counts[row, np.clip(u, 0, width - 1).astype(int)]
            result[rows] = inside
        return result

    def _positions(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Where in the photograph rows of pixels are, (u, v), pixels from its edges."""
        values = tuple(getattr(self.camera, name) for name in LENS)
        moved = _moved(self.lens, self.plane, values)
        along = np.arange(rows.start, rows.stop) + 0.5
        at = along * ((N_KNOTS - 1) / self.plane.height)
        above = np.minimum(at.astype(int), N_KNOTS - 2)
        share = (at - above)[:, None].astype(np.float32)
        across = np.arange(self.plane.width) + 0.5
        u, v = (1.0 - share) * moved[:, above] + share * moved[:, above + 1]
        return across + u, along[:, None] + v


@functools.lru_cache(maxsize=16)
def _moved(lens: ForeignLens, plane: ImagePlane, values: tuple[Any, ...]) -> np.ndarray:
    """By how much pixels of rows of knots are moved, (u, v) [2, N_KNOTS, W] pixels.

    The lens that they are moved to is given by a camera's fields ``LENS``.
    """
    u, v = np.linspace(0.0, plane.width, N_KNOTS), np.linspace(0.0, plane.height, N_KNOTS)
    knots = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
    rays = directions(posed(values), knots) * [1.0, -1.0, -1.0]
    moved = plane.pixels(lens.project(rays)) - knots
    moved = np.nan_to_num(moved, nan=FAR, posinf=FAR, neginf=-FAR)
    at = (np.arange(plane.width) + 0.5) * ((N_KNOTS - 1) / plane.width)
    rows = moved.reshape(N_KNOTS, N_KNOTS, 2).transpose(2, 0, 1)
    shares = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(N_KNOTS)))
    return np.asarray(rows @ shares.T, np.float32)


def _bands(height: int, width: int) -> list[slice]:
    edge = max(1, BAND // width)
    return [slice(row, min(row + edge, height)) for row in range(0, height, edge)]


def _taps(at: np.ndarray, size: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The four pixels around positions, within an edge, and their Catmull-Rom weights."""
    at = np.clip(at - 0.5, 0.0, size - 1.0)
    first = np.floor(at)
    t = (at - first).astype(np.float32)
    weights = (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    )
    start = first.astype(np.int64)
    return [(np.clip(start + k - 1, 0, size - 1), weight) for k, weight in enumerate(weights)]
