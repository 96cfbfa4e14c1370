"""Total variation of the grid, and its adjoint.

TV(x) = sum_c weight_c sum_{neighbouring nodes a, b} huber(x_a,c - x_b,c),
huber(d) = d^2 / 2 for |d| <= 1, |d| - 1/2 beyond: an edge costs its height, not its square.

On the CPU the adjoint is worked out for all channels of a tile at once, in Clang's vector types;
on CUDA, and at the grid's faces, node by node.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.tiles import (
    AHEAD,
    GROUP,
    TILE,
    but_first,
    first_of,
    prefetch,
    tile_of,
    tiles_ahead,
    touched_tiles,
)
from ..base.types import gradient_type, real, vector
from ..fields.interp import flat_index

wp.set_module_options({"enable_backward": False})

RUN = 16
"""Nodes in a row that share a strength: a whole number of tiles."""


@wp.func
def huber(difference: real) -> real:
    """d^2 / 2 near zero, linear from 1 on."""
    d = wp.abs(difference)
    if d <= real(1.0):
        return real(0.5) * d * d
    return d - real(0.5)


@wp.func
def adj_huber(difference: Any):
    """h'(d), for each channel."""
    slope = difference - difference
    for c in range(len(difference)):
        slope[c] = wp.clamp(difference[c], real(-1.0), real(1.0))
    return slope


@wp.func
def pair_variation(weight: Any, a: Any, b: Any) -> real:
    """sum_c weight_c huber(a_c - b_c)."""
    total = real(0.0)
    for c in range(len(weight)):
        total += weight[c] * huber(a[c] - b[c])
    return total


@wp.func
def node_variation(values: wp.array(dtype=Any), size: wp.vec3i, weight: Any, n: int) -> real:
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
def adj_node_variation(
    values: wp.array(dtype=Any), size: wp.vec3i, weight: Any, n: int, j: int, k: int
):
    """d TV / d x at node n = (i, j, k): of all its pairs, towards larger and smaller indices."""
    stride_y = size[2]
    stride_x = size[1] * size[2]
    value = values[n]
    total = value - value
    if n >= stride_x:
        total += adj_huber(value - values[n - stride_x])
    if n < values.shape[0] - stride_x:  # their sum might be beyond int
        total += adj_huber(value - values[n + stride_x])
    if j > 0:
        total += adj_huber(value - values[n - stride_y])
    if j + 1 < size[1]:
        total += adj_huber(value - values[n + stride_y])
    if k > 0:
        total += adj_huber(value - values[n - 1])
    if k + 1 < size[2]:
        total += adj_huber(value - values[n + 1])
    return wp.cw_mul(weight, total)


TILE_VARIATION = (
    f"constexpr int TILE = {TILE};"
    + r"""
#if defined(__CUDA_ARCH__)
return false;
#else
typedef __typeof__(values.data->c[0] + 0) scalar;
constexpr int FLOATS = sizeof(*values.data) / sizeof(scalar);  // of a node
constexpr int AT_ONCE = FLOATS < 16 ? 16 : FLOATS;  // whole nodes
typedef scalar numbers __attribute__((ext_vector_type(AT_ONCE)));
auto load = [&](const scalar* from) -> numbers {
    numbers x;
    memcpy(&x, from, sizeof(x));
    return x;
};
const size_t stride_y = FLOATS * (size_t)size.c[2], stride_x = stride_y * size.c[1];
numbers weights;
for (int n = 0; n < AT_ONCE; ++n) weights[n] = strength * weight.c[n % FLOATS];
const numbers one = 1;
for (int begin = 0; begin < FLOATS * TILE; begin += AT_ONCE) {
    const scalar* here = (const scalar*)(values.data + node) + begin;
    const numbers value = load(here);
    auto pull = [&](const scalar* other) -> numbers {
        return __builtin_elementwise_max(__builtin_elementwise_min(value - load(other), one), -one);
    };
    numbers total = pull(here - stride_x) + pull(here + stride_x);
    total = total + pull(here - stride_y) + pull(here + stride_y);
    total = total + pull(here - FLOATS) + pull(here + FLOATS);
    scalar* adj = (scalar*)(gradient.values.data + node) + begin;
    const numbers before = load(adj);
    auto seen = before != 0;  // and then a node's other channels, too
    for (int n = 0; n < AT_ONCE; n += FLOATS) {
        bool any = false;
        for (int c = 0; c < FLOATS; ++c) any |= seen[n + c] != 0;
        for (int c = 0; c < FLOATS; ++c) seen[n + c] = any ? -1 : 0;
    }
    const numbers after = seen ? before + weights * total : before;
    memcpy(adj, &after, sizeof(after));
}
return true;
#endif
"""
)


@cache
def tile_variation(n_floats: int) -> wp.Function:
    """adj_node_variation for a tile at once, where all nodes around are in the grid."""
    Node, Gradient = vector(n_floats), gradient_type(n_floats)

    @wp.func_native(TILE_VARIATION)
    def add_tile_variation(
        values: wp.array(dtype=Node),
        size: wp.vec3i,
        weight: Node,
        strength: real,
        node: int,
        gradient: Gradient,
    ) -> bool:
        """Add to a tile, from its first node, where gradient is not 0.

        Only a CPU does so, in Clang's vector types; returns whether it is done.
        """
        ...

    return add_tile_variation


@cache
def total_variation_forward_kernel(n_floats: int) -> wp.Kernel:
    """Each node's share of TV(x). Training does not ask for it; the adjoint is held against it."""
    Node = vector(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def total_variation_forward(
        first: int,
        values: wp.array(dtype=Node),  # [X * Y * Z]
        size: wp.vec3i,
        weight: Node,  # per channel
        out_variation: wp.array(
            dtype=real
        ),  # [X * Y * Z] of each node's pairs towards larger indices
    ):
        """Each node's share of TV(x); their sum is TV(x)."""
        n = first + wp.tid()
        out_variation[n] = node_variation(values, size, weight, n)

    return total_variation_forward


@cache
def total_variation_backward_kernel(n_floats: int) -> wp.Kernel:
    """d TV / d x at the nodes that already have a gradient."""
    Node, Gradient = vector(n_floats), gradient_type(n_floats)
    add_tile_variation = tile_variation(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def total_variation_backward(
        first: int,
        span: int,  # nodes per thread
        values: wp.array(dtype=Node),  # [X * Y * Z]
        size: wp.vec3i,
        weight: Node,  # per channel
        strength: wp.array(dtype=real),  # [ceil(X * Y * Z / RUN)] of nodes in a row, times weight
        gradient: Gradient,  # added to where not 0
    ):
        """d TV / d x at the nodes that already have a gradient; unseen ones stay as they are."""
        n_nodes = values.shape[0]
        start = (first + wp.tid()) * span
        end = start + wp.min(span, n_nodes - start)
        last = tile_of(end - 1) + 1
        stride_y = size[2]
        stride_x = size[1] * size[2]
        for group in range(tile_of(start), last, wp.static(GROUP)):
            # In turns, as in adam_step.
            ahead = tiles_ahead(gradient.touched, group, last)
            tiles = touched_tiles(gradient.touched, group, last)
            while tiles != wp.uint64(0) or ahead != wp.uint64(0):
                if ahead != wp.uint64(0):
                    node = (group + wp.static(AHEAD) + first_of(ahead)) * wp.static(TILE)
                    prefetch(gradient.values, node)
                    prefetch(values, node)
                    prefetch(values, node - stride_y)
                    prefetch(values, node + stride_y)
                    prefetch(values, node - stride_x)
                    prefetch(values, node + stride_x)
                    ahead = but_first(ahead)
                if tiles == wp.uint64(0):
                    continue
                node = (group + first_of(tiles)) * wp.static(TILE)
                first_node = wp.max(start, node)
                end_node = wp.min(end, node + wp.static(TILE))
                j = (first_node // size[2]) % size[1]
                k = first_node % size[2]
                inside = end_node - first_node == wp.static(TILE)
                inside = inside and node >= stride_x and node < n_nodes - stride_x
                inside = inside and j > 0 and j + 1 < size[1]
                inside = inside and k > 0 and k + wp.static(TILE) < size[2]
                here = strength[node // wp.static(RUN)]
                if inside and add_tile_variation(values, size, weight, here, node, gradient):
                    end_node = first_node
                weights = here * weight
                for n in range(first_node, end_node):
                    adj = gradient.values[n]
                    if not (adj == Node()):
                        more = adj_node_variation(values, size, weights, n, j, k)
                        gradient.values[n] = adj + more
                    k += 1  # on to the next node, without dividing for each
                    if k == size[2]:
                        k = 0
                        j += 1
                        if j == size[1]:
                            j = 0
                tiles = but_first(tiles)

    return total_variation_backward
