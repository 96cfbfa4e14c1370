"""Free space: which cells of the grid's domain hold nothing that could be seen."""

from functools import cache

import warp as wp

from ..base.activation import softplus
from ..base.types import Box, Density, real, vec3
from ..fields.dense import grid_type
from ..sampling.steps import March, step_edge
from ..space.contraction import norm_of

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(8)  # distances are counted up to here, cells


@wp.func
def first_node(cell: int, n_cells: int, n_nodes: int) -> int:
    """Lowest node, on one axis, that a cell's samples or their neighbours' can touch."""
    return wp.max(0, (cell * (n_nodes - 1)) // n_cells - 1)


@wp.func
def last_node(cell: int, n_cells: int, n_nodes: int) -> int:
    """Highest such node."""
    return wp.min(n_nodes - 1, ((cell + 1) * (n_nodes - 1) + n_cells - 1) // n_cells + 1)


@wp.func
def longest_step(box: Box, march: March, c: vec3, contraction: int) -> real:
    """How long steps can be where contracted coordinates are no larger than c, on each axis.

    A point n boxes out is at most n times as far from a camera as equal steps reach: these go to
    the farthest corner of the box.
    """
    norm = norm_of(c, contraction)
    if norm <= real(1.0) or march.growth == real(0.0):
        return march.step
    t = march.far
    if norm < real(1.0) + box.border:
        n = box.border / (real(1.0) + box.border - norm)
        t = wp.min(t, n * step_edge(march, march.n_linear))
    return wp.max(march.step, march.growth * t)


@cache
def find_highest_kernel(n_floats: int) -> wp.Kernel:
    """The highest raw density in and next to a cell, in one of its columns of nodes along z."""
    Grid = grid_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def find_highest(
        first: int,
        span: int,  # cells per thread, in one row along z
        grid: Grid,
        n_cells: int,  # MZ, along z
        out_highest: wp.array(dtype=real),  # [X * Y * MZ]
    ):
        """The highest raw density in and next to a cell, in one of its columns of nodes along z.

        What is not a number counts as dense: it must be seen to be noticed.
        """
        start = (first + wp.tid()) * span
        column = (start // n_cells) * grid.size[2]
        cell = start % n_cells
        for n in range(start, start + span):
            highest = real(-1.0e30)
            for k in range(
                first_node(cell, n_cells, grid.size[2]), last_node(cell, n_cells, grid.size[2]) + 1
            ):
                raw = grid.values[column + k][0]  # compared with itself, as isnan is a slow call
                highest = wp.max(highest, wp.where(raw == raw, raw, real(1.0e30)))
            out_highest[n] = highest
            cell += 1

    return find_highest


@wp.kernel
def join_highest(
    first: int,
    span: int,  # cells per thread, in one row along z
    n_nodes: int,  # along the axis
    n_cells: int,  # along the axis
    stride: int,  # along the axis, a multiple of span
    highest: wp.array(dtype=real),  # [... * n_nodes * stride]
    out_highest: wp.array(dtype=real),  # [... * n_cells * stride]
):
    """Of what was found for nodes along one axis, the highest in and next to a cell."""
    start = (first + wp.tid()) * span
    cell = (start // stride) % n_cells
    low = first_node(cell, n_cells, n_nodes)
    high = last_node(cell, n_cells, n_nodes)
    begin = start // (n_cells * stride) * n_nodes * stride + start % stride
    for n in range(span):
        raw = real(-1.0e30)
        for node in range(low, high + 1):
            raw = wp.max(raw, highest[begin + node * stride + n])
        out_highest[start + n] = raw


@wp.kernel
def mark_occupied(
    first: int,
    span: int,  # cells per thread, in one row along z
    box: Box,
    density: Density,
    highest: wp.array(dtype=real),  # [MX * MY * MZ] by find_highest, and join_highest twice
    size: wp.vec3i,  # cells
    march: March,
    contraction: int,
    alpha_min: real,  # what counts as visible
    out_distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ] 0 where occupied, else FAR + 1
):
    """A cell is occupied if any node in it or next to it would give a step this much alpha."""
    start = (first + wp.tid()) * span
    row = start // size[2]
    half = vec3(real(size[0]), real(size[1]), real(size[2])) / real(2.0)
    cell = vec3(real(row // size[1]), real(row % size[1]), real(start % size[2]))
    for n in range(start, start + span):
        middle = cell + vec3(real(0.5)) - half
        outermost = vec3(
            (wp.abs(middle[0]) + real(0.5)) / half[0],
            (wp.abs(middle[1]) + real(0.5)) / half[1],
            (wp.abs(middle[2]) + real(0.5)) / half[2],
        )
        step = longest_step(box, march, (real(1.0) + box.border) * outermost, contraction)
        sigma = density.scale * softplus(highest[n] + density.shift)
        if real(1.0) - wp.exp(-step * sigma) <= alpha_min:
            out_distance[n] = wp.uint8(FAR + 1)
        else:
            out_distance[n] = wp.uint8(0)
        cell[2] += real(1.0)


@wp.kernel
def spread_distance(
    first: int,
    span: int,  # cells per thread, in one row along z
    size: wp.vec3i,  # cells
    axis: int,
    distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ]
    out_distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ]
):
    """One axis of the chessboard distance to the nearest occupied cell, up to FAR + 1.

    max(|dx|, |dy|, |dz|) separates: d'(p) = min over s of max(|s|, d(p + s along the axis)).
    """
    start = (first + wp.tid()) * span
    stride = int(1)
    if axis == 0:
        stride = size[1] * size[2]
    if axis == 1:
        stride = size[2]
    position = (start // stride) % size[axis]
    for n in range(start, start + span):
        best = int(distance[n])
        s = int(1)
        while s < best and s <= FAR:
            if position >= s:
                best = wp.min(best, wp.max(s, int(distance[n - s * stride])))
            if position + s < size[axis]:
                best = wp.min(best, wp.max(s, int(distance[n + s * stride])))
            s += 1
        out_distance[n] = wp.uint8(best)
        if axis == 2:
            position += 1
