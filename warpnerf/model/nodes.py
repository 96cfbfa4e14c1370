"""Where scene and grid meet: node coordinates of points, in warped space too, and values there.

Node coordinates count voxel edges from the grid's lower corner. Folding and its inverse are those
of ``warpnerf_kernels.space.contraction``, and grids in a frustum have its coordinates.
"""

from __future__ import annotations

import numpy as np

from warpnerf.model.grid import VoxelGrid


def nodes_of(grid: VoxelGrid, points: np.ndarray) -> np.ndarray:
    """Node coordinates of points.

    Args:
        grid: The grid.
        points: [n, 3] scene units.

    Returns:
        [n, 3] float64; outside of [0, size - 1] where the grid does not reach.
    """
    q = _normalised(grid, points)
    norm = _norm(grid, q)
    outside = norm > 1.0
    q[outside] *= ((1.0 + grid.border - grid.border / norm[outside]) / norm[outside])[:, None]
    middle = 0.5 * (np.array(grid.size) - 1)
    return q * (middle / (1.0 + grid.border)) + middle


def points_of(grid: VoxelGrid, nodes: np.ndarray) -> np.ndarray:
    """The points at node coordinates, the inverse of ``nodes_of``.

    Args:
        grid: The grid.
        nodes: [n, 3] node coordinates.

    Returns:
        [n, 3] float64 scene units; infinite at the outer faces of folded space, not finite far
        beyond a frustum.
    """
    middle = 0.5 * (np.array(grid.size) - 1)
    c = (np.asarray(nodes, np.float64) - middle) * ((1.0 + grid.border) / middle)
    norm = _norm(grid, c)
    outside = norm > 1.0
    left = np.maximum(1.0 + grid.border - norm[outside], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = grid.border / left / norm[outside]
        stretched = c[outside] * factor[:, None]
    c[outside] = np.where(c[outside] == 0.0, 0.0, stretched)
    places = 0.5 * (grid.box_min + grid.box_max) + 0.5 * c * (grid.box_max - grid.box_min)
    return places if grid.frustum is None else grid.frustum.to_scene(places)


def voxel_edges(grid: VoxelGrid, points: np.ndarray) -> np.ndarray:
    """How long a voxel's edge is at points, about: in warped space it grows with the distance.

    In a frustum that is an edge across; those along the depth are longer far away.

    Args:
        grid: The grid.
        points: [n, 3] scene units.

    Returns:
        [n] scene units.
    """
    if grid.frustum is not None:
        depth = np.maximum(grid.frustum.depths(points), grid.frustum.near)
        return float(grid.voxel_size.mean()) * depth
    return float(grid.voxel_size.mean()) * np.maximum(1.0, _norm(grid, _normalised(grid, points)))


def values_at(values: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Trilinear interpolation.

    Args:
        values: [X, Y, Z] at nodes.
        nodes: [n, 3] node coordinates; beyond the grid, the nearest value on its faces.

    Returns:
        [n] float64.
    """
    last = np.array(values.shape) - 1
    u = np.clip(nodes, 0.0, last)
    lowest = np.minimum(u.astype(np.int64), last - 1)
    fraction = u - lowest
    flat = np.ravel_multi_index(tuple(lowest.T), values.shape)
    strides = (values.shape[1] * values.shape[2], values.shape[2], 1)
    out = np.zeros(len(u))
    for corner in range(8):
        share, step = np.ones(len(u)), 0
        for axis in range(3):
            up = corner >> axis & 1
            share *= fraction[:, axis] if up else 1.0 - fraction[:, axis]
            step += up * strides[axis]
        out += share * values.reshape(-1)[flat + step]
    return out


def _normalised(grid: VoxelGrid, points: np.ndarray) -> np.ndarray:
    """With the box at [-1, 1]^3."""
    half = 0.5 * (grid.box_max - grid.box_min)
    if grid.frustum is not None:
        points = np.nan_to_num(grid.frustum.to_ndc(points), nan=-1e6)  # behind it: outside
    return (np.asarray(points, np.float64) - 0.5 * (grid.box_min + grid.box_max)) / half


def _norm(grid: VoxelGrid, q: np.ndarray) -> np.ndarray:
    """The norm that space is folded by, [n]; 0 where it is not."""
    if not grid.folded:
        return np.zeros(len(q))
    if grid.contraction == "l2":
        return np.linalg.norm(q, axis=1)
    return np.abs(q).max(axis=1, initial=0.0)
