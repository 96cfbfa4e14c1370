"""Where scene and grid meet: node coordinates of points, in warped space too, and values there.

Node coordinates count voxel edges from the grid's lower corner.
"""

from __future__ import annotations

import numpy as np

from warpnerf.fields.lattice import Lattice

ROUNDING = 1e-6
"""Of a box's longest edge, that a corner on its face may lie outside."""


def nodes_of(lattice: Lattice, points: np.ndarray) -> np.ndarray:
    """Node coordinates of points.

    Args:
        lattice: Where nodes lie.
        points: [n, 3] scene units.

    Returns:
        [n, 3] float64; outside of [0, size - 1] where the grid does not reach.
    """
    c = lattice.kind.contracted(lattice, points)
    middle = 0.5 * (np.array(lattice.size) - 1)
    return c * (middle / (1.0 + lattice.border)) + middle


def points_of(lattice: Lattice, nodes: np.ndarray) -> np.ndarray:
    """The points at node coordinates, the inverse of ``nodes_of``.

    Args:
        lattice: Where nodes lie.
        nodes: [n, 3] node coordinates.

    Returns:
        [n, 3] float64 scene units; infinite at the outer faces of contracted space, not finite far
        beyond a frustum.
    """
    middle = 0.5 * (np.array(lattice.size) - 1)
    c = (np.asarray(nodes, np.float64) - middle) * ((1.0 + lattice.border) / middle)
    return lattice.kind.expanded(lattice, c)


def middles_of_runs(lattice: Lattice, length: int, runs: np.ndarray) -> np.ndarray:
    """The points at the middle nodes of runs: nodes that follow each other, first along z.

    Args:
        lattice: Where nodes lie.
        length: Nodes of a run; the last may have fewer, and its last node for the middle one.
        runs: [n] which ones, from 0 on.

    Returns:
        [n, 3] as of ``points_of``.
    """
    middles = np.minimum(runs * length + length // 2, np.prod(lattice.size) - 1)
    return points_of(lattice, np.stack(np.unravel_index(middles, lattice.size), axis=1))


def cells_within(lattice: Lattice, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Which cells of free space lie in a box of the scene with all corners.

    Args:
        lattice: That they belong to.
        low: [3] lower corner, scene units.
        high: [3] upper corner.

    Returns:
        [MX, MY, MZ] bool.
    """
    size = lattice.cells
    last = np.array(lattice.size) - 1
    ends = [np.arange(n + 1) / n * end for n, end in zip(size, last, strict=True)]
    corners = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1)
    points = points_of(lattice, corners.reshape(-1, 3)).reshape(corners.shape)
    slack = ROUNDING * float((lattice.box_max - lattice.box_min).max())
    inside = ((low - slack <= points) & (points <= high + slack)).all(axis=-1)
    for axis, n in enumerate(size):
        inside = np.take(inside, np.arange(n), axis) & np.take(inside, np.arange(1, n + 1), axis)
    return np.asarray(inside)


def nodes_of_cells(lattice: Lattice, cells: np.ndarray) -> np.ndarray:
    """Which nodes samples in cells of free space read: those in the cells and on their faces.

    Args:
        lattice: That they belong to.
        cells: [MX, MY, MZ] bool, of any size: a single one is all of the lattice.

    Returns:
        [X, Y, Z] bool.
    """
    nodes = np.asarray(cells, bool)
    for axis, n in enumerate(lattice.size):
        last, m, before = n - 1, nodes.shape[axis], np.moveaxis(nodes, axis, 0)
        after = np.zeros((n, *before.shape[1:]), bool)
        for i in range(m):
            after[i * last // m : -(-(i + 1) * last // m) + 1] |= before[i]
        nodes = np.moveaxis(after, 0, axis)
    return nodes


def voxel_edges(lattice: Lattice, points: np.ndarray) -> np.ndarray:
    """How long a voxel's edge is at points, about: in warped space it grows with the distance.

    In a frustum that is an edge across; those along the depth are longer far away.

    Args:
        lattice: Where nodes lie.
        points: [n, 3] scene units.

    Returns:
        [n] scene units.
    """
    return float(lattice.voxel_size.mean()) * lattice.kind.widening(lattice, points)


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
