"""Points of a scene's surfaces, as structure from motion finds them, and who sees which."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from warpnerf.scenes.camera import Camera
from warpnerf.scenes.poses import MAX_COORDINATE

MAX_PROJECTED = 20_000
"""Points without tracks that are looked for in each photograph; of more every n-th is taken."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Points that a capture brings."""

    positions: np.ndarray
    """[n, 3] float64, scene units; finite."""
    tracks: Mapping[str, np.ndarray] | None
    """Indices of the points that were matched in a photograph, by the photograph's name; None: not
    known."""
    source: str
    """The file, relative to the scene's folder."""

    def seen_by(self, name: str, camera: Camera) -> np.ndarray:
        """The points that a camera sees.

        Without tracks those that fall into its picture, whether something is before them or not.

        Args:
            name: Of its photograph.
            camera: The camera; its distortion is left out of account.

        Returns:
            [n, 3] scene units, all in front of the camera.
        """
        if self.tracks is not None:
            points = self.positions[self.tracks.get(name, np.empty(0, np.int64))]
            return points[(points - camera.position) @ camera.forward > 0.0]
        points = self.positions[:: -(-len(self.positions) // MAX_PROJECTED) or 1]
        x, y, z = ((points - camera.position) @ camera.c2w[:, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.cx - camera.fx * x / z, camera.cy + camera.fy * y / z
        inside = (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        return points[inside & (z < 0.0)]


def usable(positions: np.ndarray) -> np.ndarray:
    """Which of positions [n, 3] are finite and of a size that a scene can have, [n] bool."""
    return (np.abs(positions) <= MAX_COORDINATE).all(axis=1)
