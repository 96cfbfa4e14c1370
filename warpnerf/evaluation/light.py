"""Where the light of a ray is absorbed: in front of the true surface, at it, or behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.evaluation.sight import goes_by_points, true_depths
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.scene import Scene, View, require_split

if TYPE_CHECKING:
    from warpnerf.rendering.composite import AnyField

FRONT, BEHIND = 0.8, 1.25
"""In true depths: what is nearer is in front of the surface, what is farther behind it."""

MAX_RAYS = 512
"""Of a view, about; pixels of larger ones are looked at in even gaps."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """Where light is absorbed, mean shares over rays; the four sum to 1."""

    front: float
    """Nearer than FRONT true depths: what hangs before the surface."""
    hit: float
    """From there to BEHIND true depths: the surface."""
    behind: float
    """Farther away."""
    transmitted: float
    """Absorbed nowhere: what the background fills."""
    rays: int
    """How many were looked along."""


def measure_light(field: AnyField, scene: Scene, split: str) -> Light | None:
    """Measure where the light of a split's rays is absorbed.

    With T(t) the light that passes up to distance t and d a ray's true depth

        front = 1 - T(0.8 d),  hit = T(0.8 d) - T(1.25 d),
        behind = T(1.25 d) - T(inf),  transmitted = T(inf)

    over pixels whose true depth is known. A step of the ray that an end cuts counts on both sides.

    Args:
        field: A trained field.
        scene: Photographs with ``true_depths``.
        split: Which of them.

    Returns:
        Means over rays; None where no depth is known, and in normalised device coordinates, whose
        rays are not cut at distances.
    """
    if field.in_ndc:
        return None
    views = [scene.views[index] for index in require_split(scene, split)]
    rays = [found for view in views if (found := _rays(field, scene, view)) is not None]
    if not rays:
        return None
    origins, directions, depths = (np.concatenate(parts) for parts in zip(*rays, strict=True))
    front, hit, behind, transmitted = absorbed(field, origins, directions, depths).mean(axis=0)
    return Light(
        front=float(front),
        hit=float(hit),
        behind=float(behind),
        transmitted=float(transmitted),
        rays=len(depths),
    )


def absorbed(
    field: AnyField, origins: np.ndarray, directions: np.ndarray, depths: np.ndarray
) -> np.ndarray:
    """Shares of light that are absorbed in front, at the surface, behind, and nowhere.

    Args:
        field: What absorbs it.
        origins: [n, 3] scene units.
        directions: [n, 3] unit vectors.
        depths: [n] true distances, above 0, scene units.

    Returns:
        [n, 4] float64; each row sums to 1.
    """
    whole = field.up_to(math.inf)  # marched: also densities that hardly any light reaches
    limits = np.outer(depths.astype(np.float64), (0.0, FRONT, BEHIND, math.inf))
    light, shares = np.ones(len(depths)), []
    for ends in (limits[:, :2], limits[:, 1:3], limits[:, 2:]):
        opacity = whole.render_between(origins, directions, ends).opacity.astype(np.float64)
        shares.append(light * opacity)
        light = light * (1.0 - opacity)
    return np.stack([*shares, light], axis=1)


def _rays(
    field: AnyField, scene: Scene, view: View
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Origins, directions and true depths of some of a view's pixels whose depth is known."""
    depths = true_depths(scene, view)
    if depths is None:
        return None
    chosen = np.isfinite(depths)
    if goes_by_points(scene):
        pixels = np.flatnonzero(chosen)
        pixels = pixels[:: max(1, -(-len(pixels) // MAX_RAYS))]
    else:
        gap = view.camera.block_for(MAX_RAYS)
        lattice = np.zeros_like(chosen)
        lattice[gap // 2 :: gap, gap // 2 :: gap] = True
        pixels = np.flatnonzero(chosen & lattice)
    if len(pixels) == 0:
        return None
    origins, directions = (rays.numpy() for rays in camera_rays(view.camera, field.workers))
    origins = np.broadcast_to(origins, directions.shape)
    return origins[pixels], directions[pixels], depths.ravel()[pixels]
