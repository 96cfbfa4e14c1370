"""Reading a dense grid at points of one's choice, and its transpose: for checking the two."""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.types import gradient_type, vec3, vector
from ..fields.dense import adj_read, grid_type, read


@cache
def probe(n_floats: int) -> SimpleNamespace:
    """The kernels read_forward and read_backward, for nodes of so many floats."""
    Grid, Node, Gradient = grid_type(n_floats), vector(n_floats), gradient_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def read_forward(
        first: int,
        grid: Grid,
        points: wp.array(dtype=vec3),  # [n] folded coordinates
        out: wp.array(dtype=Node),  # [n]
    ):
        i = first + wp.tid()
        out[i] = read(grid, points[i])

    @wp.kernel(module="unique", enable_backward=False)
    def read_backward(
        first: int,
        grid: Grid,
        points: wp.array(dtype=vec3),  # [n] folded coordinates
        adj_out: wp.array(dtype=Node),  # [n]
        gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        adj_read(grid, points[i], adj_out[i], gradient)

    return SimpleNamespace(read_forward=read_forward, read_backward=read_backward)
