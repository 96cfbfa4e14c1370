"""Floaters, measured against a truth that is known: density where there can be none.

``first_hit`` stands for that truth, as ``Scene.first_hit``.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.rendering.composite import AnyField
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import FirstHit

N_DIRECTIONS = 2000
"""Rays around a camera."""


def clearance(camera: Camera, first_hit: FirstHit) -> float:
    """The distance from a camera to the nearest surface in any direction, scene units."""
    directions = directions_around(N_DIRECTIONS)
    return float(first_hit(np.broadcast_to(camera.position, directions.shape), directions).min())


def near_density(field: AnyField, cameras: Sequence[Camera], first_hit: FirstHit) -> float:
    """Mean optical depth from a camera to its clearance, in all directions; its true value is 0.

    Args:
        field: What to measure.
        cameras: Around which; the training cameras, where floaters are.
        first_hit: See the module.
    """
    directions = directions_around(N_DIRECTIONS)
    depths = []
    for camera in cameras:
        origins = np.broadcast_to(camera.position, directions.shape)
        close_by = field.up_to(clearance(camera, first_hit))
        seen = close_by.render_rays(origins, directions)
        depths.append(float(-np.log(np.maximum(1.0 - seen.opacity, 1e-6)).mean()))
    return float(np.mean(depths))


def directions_around(n: int) -> np.ndarray:
    """Evenly spread unit vectors, [n, 3]: Fibonacci's spiral."""
    k = np.arange(n) + 0.5
    z = 1.0 - 2.0 * k / n
    angle = np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
