"""Density bound of a dense grid in each cell of the occupancy grid, whose cells are its own."""

from functools import cache

import warp as wp

from ..base.types import real
from .dense import grid_type

wp.set_module_options({"enable_backward": False})


@wp.func
def first_node(cell: int, n_cells: int, n_nodes: int, margin: int) -> int:
    """Lowest node, on one axis, that a cell's samples can touch, or so many before it."""
    return wp.max(0, (cell * (n_nodes - 1)) // n_cells - margin)


@wp.func
def last_node(cell: int, n_cells: int, n_nodes: int, margin: int) -> int:
    """Highest such node."""
    return wp.min(n_nodes - 1, ((cell + 1) * (n_nodes - 1) + n_cells - 1) // n_cells + margin)


@cache
def find_highest_kernel(n_floats: int) -> wp.Kernel:
    """The highest raw density in a cell and the margin around, in a column of nodes along z."""
    Grid = grid_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def find_highest(
        # launch
        first: int,
        span: int,  # cells per thread, in one row along z
        # scene
        grid: Grid,
        # choices
        n_cells: int,  # MZ, along z
        margin: int,  # nodes beyond those of a cell that count as well
        # out
        out_highest: wp.array(dtype=real),  # [X * Y * MZ]
    ):
        """The highest raw density in a cell and the margin around, in a column of nodes along z.

        What is not a number counts as dense: it must be seen to be noticed.
        """
        start = (first + wp.tid()) * span
        column = (start // n_cells) * grid.size[2]
        cell = start % n_cells
        for n in range(start, start + span):
            highest = real(-1.0e30)
            low = first_node(cell, n_cells, grid.size[2], margin)
            high = last_node(cell, n_cells, grid.size[2], margin)
            for k in range(low, high + 1):
                raw = grid.values[column + k][0]  # compared with itself, as isnan is a slow call
                highest = wp.max(highest, wp.where(raw == raw, raw, real(1.0e30)))
            out_highest[n] = highest
            cell += 1

    return find_highest


@wp.kernel
def join_highest(
    # launch
    first: int,
    span: int,  # cells per thread, in one row along z
    # scene
    highest: wp.array(dtype=real),  # [... * n_nodes * stride]
    # choices
    n_nodes: int,  # along the axis
    n_cells: int,  # along the axis
    stride: int,  # along the axis, a multiple of span
    margin: int,  # nodes beyond those of a cell that count as well
    # out
    out_highest: wp.array(dtype=real),  # [... * n_cells * stride]
):
    """Of what was found for nodes along one axis, the highest in a cell and the margin around."""
    start = (first + wp.tid()) * span
    cell = (start // stride) % n_cells
    low = first_node(cell, n_cells, n_nodes, margin)
    high = last_node(cell, n_cells, n_nodes, margin)
    begin = start // (n_cells * stride) * n_nodes * stride + start % stride
    for n in range(span):
        raw = real(-1.0e30)
        for node in range(low, high + 1):
            raw = wp.max(raw, highest[begin + node * stride + n])
        out_highest[start + n] = raw
