"""Where the light of a ray is absorbed: in front of the true surface, at it, or behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warpnerf.rendering.composite import AnyField
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.scene import Scene, View, require_split

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

    over pixels whose true depth is known. A step that a limit cuts counts with its share.

    Args:
        field: A trained field.
        scene: Photographs with true depths.
        split: Which of them.

    Returns:
        Means over rays; None where no depth is known, and in normalised device coordinates, whose
        rays are not cut at distances.
    """
    if field.in_ndc:
        return None
    views = [scene.views[index] for index in require_split(scene, split)]
    rays = [found for found in (_rays(field, view) for view in views) if found is not None]
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
    whole = field.up_to(math.inf)  # all matter that is there
    near, far = (share * depths.astype(np.float64) for share in (FRONT, BEHIND))
    front, behind, end = (
        _transmittance(whole, origins, directions, limits)
        for limits in (near, far, np.full(len(depths), np.inf))
    )
    return np.stack([1.0 - front, front - behind, behind - end, end], axis=1)


def _transmittance(
    field: AnyField, origins: np.ndarray, directions: np.ndarray, limits: np.ndarray
) -> np.ndarray:
    """Light that passes each ray up to a distance of its own, [n] float64."""
    ends = np.stack([np.zeros(len(limits)), limits], axis=1)
    return 1.0 - field.render_between(origins, directions, ends).opacity.astype(np.float64)


def _rays(field: AnyField, view: View) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Origins, directions and true depths of some of a view's pixels whose depth is known."""
    if view.depth is None:
        return None
    known = np.isfinite(view.depth) & (view.depth > 0.0)
    if view.mask is not None:
        known &= view.mask
    gap = view.camera.block_for(MAX_RAYS)
    chosen = np.zeros_like(known)
    chosen[gap // 2 :: gap, gap // 2 :: gap] = True
    pixels = np.flatnonzero(known & chosen)
    if len(pixels) == 0:
        return None
    origins, directions = (rays.numpy() for rays in camera_rays(view.camera, field.workers))
    origins = np.broadcast_to(origins, directions.shape)
    return origins[pixels], directions[pixels], view.depth.ravel()[pixels]
