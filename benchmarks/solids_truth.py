"""Distances to the surfaces of solids: the truth that meshes are compared with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.scenes.builtin.solids import Ball, Box, Cylinder


def distances_to(points: np.ndarray, solids: Sequence[Box]) -> tuple[np.ndarray, np.ndarray]:
    """How far points are from the nearest surface.

    Args:
        points: [n, 3] scene units.
        solids: Boxes, balls and upright cylinders.

    Returns:
        [n] scene units, and the index of the solid whose surface that is, [n].
    """
    nearest, which = np.full(len(points), np.inf), np.zeros(len(points), int)
    for index, solid in enumerate(solids):
        distance = np.abs(_signed(points, solid))
        closer = distance < nearest
        nearest[closer], which[closer] = distance[closer], index
    return nearest, which


def _signed(points: np.ndarray, solid: Box) -> np.ndarray:
    """The distance of points [n, 3] to the surface of a solid, negative inside, [n]."""
    low, high = np.array(solid.lo), np.array(solid.hi)
    away, half = points - 0.5 * (low + high), 0.5 * (high - low)
    if isinstance(solid, Ball):
        return np.linalg.norm(away, axis=1) - half[0]
    if isinstance(solid, Cylinder):
        across = np.linalg.norm(away[:, :2], axis=1) - half[0]
        outside = np.stack([across, np.abs(away[:, 2]) - half[2]], axis=1)
    else:
        outside = np.abs(away) - half
    signed = np.linalg.norm(np.maximum(outside, 0.0), axis=1)
    return signed + np.minimum(outside.max(axis=1), 0.0)
