"""Total variation of the grid, and its adjoint.

TV(x) = sum_c weight_c sum_{neighbouring nodes a, b} huber(x_a,c - x_b,c),
huber(d) = d^2 / 2 for |d| <= 1, |d| - 1/2 beyond: an edge costs its height, not its square.

On the CPU the adjoint is computed for all channels of a tile at once, in Clang's vector types;
on CUDA, and at the grid's faces, node by node.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.tiles import TILE, prefetch, tile_loop
from ..base.types import gradient_type, real, vector
from ..fields.interp import flat_index

wp.set_module_options({"enable_backward": False})

TV_BLOCK = 16
"""Nodes of a block, in a row, that share a weight of the total variation: whole tiles."""


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
    """Each node's share of TV(x). Training does not need it; the adjoint is checked against it."""
    Node = vector(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def total_variation_forward(
        # launch
        first: int,
        # scene
        values: wp.array(dtype=Node),  # [X * Y * Z]
        size: wp.vec3i,
        # choices
        weight: Node,  # per channel
        # out
        out_variation: wp.array(dtype=real),  # [X * Y * Z] of pairs towards larger indices
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

    @wp.struct
    class Entries:
        values: wp.array(dtype=Node)
        size: wp.vec3i
        weight: Node
        strength: wp.array(dtype=real)
        gradient: Gradient

    @wp.func
    def prefetch_tile(on: Entries, node: int):
        stride_y = on.size[2]
        stride_x = on.size[1] * on.size[2]
        prefetch(on.gradient.values, node)
        prefetch(on.values, node)
        prefetch(on.values, node - stride_y)
        prefetch(on.values, node + stride_y)
        prefetch(on.values, node - stride_x)
        prefetch(on.values, node + stride_x)

    @wp.func
    def work(on: Entries, node: int, begin: int, end: int):
        size = on.size
        stride_x = size[1] * size[2]
        j = (begin // size[2]) % size[1]
        k = begin % size[2]
        inside = end - begin == wp.static(TILE)
        inside = inside and node >= stride_x and node < on.values.shape[0] - stride_x
        inside = inside and j > 0 and j + 1 < size[1]
        inside = inside and k > 0 and k + wp.static(TILE) < size[2]
        here = on.strength[node // wp.static(TV_BLOCK)]
        last = end
        if inside and add_tile_variation(on.values, size, on.weight, here, node, on.gradient):
            last = begin
        weights = here * on.weight
        for n in range(begin, last):
            adj = on.gradient.values[n]
            if not (adj == Node()):
                more = adj_node_variation(on.values, size, weights, n, j, k)
                on.gradient.values[n] = adj + more
            k += 1  # on to the next node, without dividing for each
            if k == size[2]:
                k = 0
                j += 1
                if j == size[1]:
                    j = 0

    over_tiles = tile_loop(prefetch_tile, work)

    @wp.kernel(module="unique", enable_backward=False)
    def total_variation_backward(
        # launch
        first: int,
        span: int,  # nodes per thread
        # scene
        values: wp.array(dtype=Node),  # [X * Y * Z]
        size: wp.vec3i,
        # choices
        weight: Node,  # per channel
        strength: wp.array(dtype=real),  # [ceil(n_nodes / TV_BLOCK)] times weight
        # out
        gradient: Gradient,  # added to where not 0
    ):
        """d TV / d x at the nodes that already have a gradient; unseen ones stay as they are."""
        start = (first + wp.tid()) * span
        on = Entries()
        on.values = values
        on.size = size
        on.weight = weight
        on.strength = strength
        on.gradient = gradient
        over_tiles(on, gradient.touched, start, start + wp.min(span, values.shape[0] - start))

    return total_variation_backward
