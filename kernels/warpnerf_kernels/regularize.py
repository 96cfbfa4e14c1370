"""Total variation of the grid, and its adjoint.

TV(x) = sum_c weight_c sum_{neighbouring nodes a, b} huber(x_a,c - x_b,c),
huber(d) = d^2 / 2 for |d| <= 1, |d| - 1/2 beyond: an edge costs its height, not its square.
"""

import warp as wp

from .interp import flat_index
from .tiles import TILE, next_tile, prefetch, tile_of
from .types import Gradient, real, vec4

wp.set_module_options({"enable_backward": False})


@wp.func
def huber(difference: real) -> real:
    """d^2 / 2 near zero, linear from 1 on."""
    d = wp.abs(difference)
    if d <= real(1.0):
        return real(0.5) * d * d
    return d - real(0.5)


@wp.func
def adj_huber(difference: real, adj_y: real) -> real:
    """Adjoint of huber."""
    return wp.clamp(difference, real(-1.0), real(1.0)) * adj_y


@wp.func
def pair_variation(weight: vec4, a: vec4, b: vec4) -> real:
    """sum_c weight_c huber(a_c - b_c)."""
    d = a - b
    return (
        weight[0] * huber(d[0])
        + weight[1] * huber(d[1])
        + weight[2] * huber(d[2])
        + weight[3] * huber(d[3])
    )


@wp.func
def adj_pair_variation(weight: vec4, a: vec4, b: vec4) -> vec4:
    """Adjoint of pair_variation with respect to a."""
    d = a - b
    return vec4(
        adj_huber(d[0], weight[0]),
        adj_huber(d[1], weight[1]),
        adj_huber(d[2], weight[2]),
        adj_huber(d[3], weight[3]),
    )


@wp.func
def node_variation(values: wp.array(dtype=vec4), size: wp.vec3i, weight: vec4, n: int) -> real:
    """TV of a node's pairs towards larger indices."""
    k = n % size[2]
    j = (n // size[2]) % size[1]
    i = n // (size[2] * size[1])
    total = real(0.0)
    if i + 1 < size[0]:
        total += pair_variation(weight, values[n], values[flat_index(i + 1, j, k, size)])
    if j + 1 < size[1]:
        total += pair_variation(weight, values[n], values[flat_index(i, j + 1, k, size)])
    if k + 1 < size[2]:
        total += pair_variation(weight, values[n], values[n + 1])
    return total


@wp.func
def adj_node_variation(values: wp.array(dtype=vec4), size: wp.vec3i, weight: vec4, n: int) -> vec4:
    """d TV / d x at a node: of all its pairs, towards larger and smaller indices."""
    k = n % size[2]
    j = (n // size[2]) % size[1]
    i = n // (size[2] * size[1])
    value = values[n]
    total = vec4()
    if i > 0:
        total += adj_pair_variation(weight, value, values[flat_index(i - 1, j, k, size)])
    if i + 1 < size[0]:
        total += adj_pair_variation(weight, value, values[flat_index(i + 1, j, k, size)])
    if j > 0:
        total += adj_pair_variation(weight, value, values[flat_index(i, j - 1, k, size)])
    if j + 1 < size[1]:
        total += adj_pair_variation(weight, value, values[flat_index(i, j + 1, k, size)])
    if k > 0:
        total += adj_pair_variation(weight, value, values[n - 1])
    if k + 1 < size[2]:
        total += adj_pair_variation(weight, value, values[n + 1])
    return total


@wp.kernel
def total_variation_forward(
    first: int,
    values: wp.array(dtype=vec4),  # [X * Y * Z]
    size: wp.vec3i,
    weight: vec4,  # per channel
    out_variation: wp.array(dtype=real),  # [X * Y * Z] of each node's pairs towards larger indices
):
    """Each node's share of TV(x); their sum is TV(x)."""
    n = first + wp.tid()
    out_variation[n] = node_variation(values, size, weight, n)


@wp.kernel
def total_variation_backward(
    first: int,
    span: int,  # nodes per thread
    values: wp.array(dtype=vec4),  # [X * Y * Z]
    size: wp.vec3i,
    weight: vec4,  # per channel
    gradient: Gradient,  # added to where not 0
):
    """d TV / d x at the nodes that already have a gradient; unseen ones stay as they are."""
    start = (first + wp.tid()) * span
    end = wp.min(start + span, values.shape[0])
    last = tile_of(end - 1) + 1
    stride_y = size[2]
    stride_x = size[1] * size[2]
    tile = next_tile(gradient.touched, tile_of(start), last)
    while tile < last:
        node = tile * wp.static(TILE)
        prefetch(gradient.values, node)
        prefetch(values, node)
        prefetch(values, node - stride_y)
        prefetch(values, node + stride_y)
        prefetch(values, node - stride_x)
        prefetch(values, node + stride_x)
        tile = next_tile(gradient.touched, tile + 1, last)
    tile = next_tile(gradient.touched, tile_of(start), last)
    while tile < last:
        node = tile * wp.static(TILE)
        for n in range(wp.max(start, node), wp.min(end, node + wp.static(TILE))):
            if not (gradient.values[n] == vec4()):
                gradient.values[n] += adj_node_variation(values, size, weight, n)
        tile = next_tile(gradient.touched, tile + 1, last)
