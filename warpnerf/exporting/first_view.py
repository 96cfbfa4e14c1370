"""View selection: the training camera that sees most of the scene, from which a page begins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.media.camera_path import path_lens
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.camera import Camera

LOOK_SIZE = 48
"""Pixels along the longer side of a small rendering."""

MAX_LOOKS = 60
"""Cameras that are tried, evenly spread over all."""

CELL = 0.02
"""Edge of the cells of which each has a point that is looked for, in sizes of what is seen."""

BEHIND = 1.05
"""Distance of a point by the depth in front of it, up to which it is not hidden."""

OPAQUE = 0.5
"""Opacity of a pixel that shows a surface."""


def widest_view(field: Field, cameras: Sequence[Camera]) -> Camera:
    """Select the camera that sees the most of the surfaces that all cameras together see.

    Surfaces hide what lies behind them. So it does not stand inside a wall or behind a floater, of
    which it would see little more than what is in front of it.

    Args:
        field: What is looked at.
        cameras: At least one.

    Returns:
        The one of them; the first where several see as much, or none sees anything.
    """
    chosen = np.unique(np.linspace(0, len(cameras) - 1, MAX_LOOKS).astype(int))
    looks, depths, points = [], [], []
    for camera in (cameras[index] for index in chosen):
        share = LOOK_SIZE / max(camera.width, camera.height)
        size = (max(1, round(share * camera.width)), max(1, round(share * camera.height)))
        look = path_lens([camera], size)
        seen = field.render(look)
        solid = seen.opacity > OPAQUE
        depth = np.where(solid, seen.depth / np.maximum(seen.opacity, OPAQUE), np.inf)
        u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
        ways = np.stack(
            [(u - look.cx) / look.fx, (look.cy - v) / look.fy, -np.ones_like(u)], axis=-1
        )
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        there = look.position + depth[solid][:, None] * (ways[solid] @ look.c2w[:, :3].T)
        looks.append(look)
        depths.append(depth)
        points.append(there)
    apart = _spread_out(np.concatenate(points))
    counts = [_n_seen(look, depth, apart) for look, depth in zip(looks, depths, strict=True)]
    return cameras[int(chosen[int(np.argmax(counts))])]


def _spread_out(points: np.ndarray) -> np.ndarray:
    """One of the points [n, 3] in each cell, so that near surfaces count by their size."""
    if not len(points):
        return points
    low, high = np.percentile(points, [5.0, 95.0], axis=0)
    cell = max(CELL * float(np.linalg.norm(high - low)), 1e-9)
    cells = np.floor(np.clip((points - low) / cell, -1e6, 1e6)).astype(np.int64)
    return np.asarray(points[np.unique(cells, axis=0, return_index=True)[1]])


def _n_seen(look: Camera, depth: np.ndarray, points: np.ndarray) -> int:
    """How many of some points [n, 3] lie in a picture, and before its depth [H, W]."""
    away = points - look.position
    local = away @ look.c2w[:, :3]
    ahead = local[:, 2] < 0.0
    away, local = away[ahead], local[ahead]
    u = np.floor(look.cx - look.fx * local[:, 0] / local[:, 2]).astype(int)
    v = np.floor(look.cy + look.fy * local[:, 1] / local[:, 2]).astype(int)
    inside = (u >= 0) & (u < look.width) & (v >= 0) & (v < look.height)
    before = depth[v[inside], u[inside]]
    return int((np.linalg.norm(away[inside], axis=1) <= BEHIND * before).sum())
