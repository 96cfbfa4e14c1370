"""Trilinear interpolation at points of one's choice, and its transpose: for checking the two."""

import warp as wp

from .interp import adj_gather, flat_index, gather, lowest_node
from .types import Gradient, real, vec3, vec4


@wp.func
def fraction_of(u: vec3, node: wp.vec3i) -> vec3:
    """Where a point lies between its lowest node and the next, [0, 1]."""
    return u - vec3(real(node[0]), real(node[1]), real(node[2]))


@wp.kernel(enable_backward=False)
def gather_forward(
    first: int,
    values: wp.array(dtype=vec4),  # [X * Y * Z]
    size: wp.vec3i,
    points: wp.array(dtype=vec3),  # [n] grid coordinates
    out: wp.array(dtype=vec4),  # [n]
):
    """Read a grid at points."""
    i = first + wp.tid()
    node = lowest_node(points[i], size)
    base = flat_index(node[0], node[1], node[2], size)
    out[i] = gather(values, size, base, fraction_of(points[i], node))


@wp.kernel(enable_backward=False)
def gather_backward(
    first: int,
    size: wp.vec3i,
    points: wp.array(dtype=vec3),  # [n] grid coordinates
    adj_out: wp.array(dtype=vec4),  # [n]
    gradient: Gradient,  # added to
):
    """Transpose of gather_forward."""
    i = first + wp.tid()
    node = lowest_node(points[i], size)
    base = flat_index(node[0], node[1], node[2], size)
    adj_gather(size, base, fraction_of(points[i], node), adj_out[i], gradient)
