"""Total variation of the grid, and its adjoint.

TV(x) = sum_c weight_c sum_{neighbouring nodes a, b} huber(x_a,c - x_b,c),
huber(d) = d^2 / 2 for |d| <= 1, |d| - 1/2 beyond: an edge costs its height, not its square.

On the CPU the adjoint is worked out for all channels of a tile at once, in Clang's vector types;
on CUDA, and at the grid's faces, node by node.
"""

import warp as wp

from .interp import flat_index
from .tiles import (
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
def adj_huber(difference: vec4) -> vec4:
    """h'(d), for each channel."""
    return wp.max(wp.min(difference, vec4(real(1.0))), vec4(real(-1.0)))


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
def adj_node_variation(
    values: wp.array(dtype=vec4), size: wp.vec3i, weight: vec4, n: int, j: int, k: int
) -> vec4:
    """d TV / d x at node n = (i, j, k): of all its pairs, towards larger and smaller indices."""
    stride_y = size[2]
    stride_x = size[1] * size[2]
    value = values[n]
    total = vec4()
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


def _exchanged(distance: int) -> str:
    """The channels of a tile, each in the place of the one 1 or 2 away within its node."""
    return ", ".join(str(channel ^ distance) for channel in range(4 * TILE))


@wp.func_native(
    f"constexpr int CHANNELS = {4 * TILE};"
    + r"""
#if defined(__CUDA_ARCH__)
return false;
#else
typedef __typeof__(values.data->c[0] + 0) scalar;
typedef scalar numbers __attribute__((ext_vector_type(CHANNELS)));
auto load = [&](const auto* from) -> numbers {
    numbers x;
    memcpy(&x, from, sizeof(x));
    return x;
};
const int stride_y = size.c[2], stride_x = size.c[1] * size.c[2];
const auto* here = values.data + node;
const numbers value = load(here), one = 1;
auto pull = [&](const auto* other) -> numbers {
    return __builtin_elementwise_max(__builtin_elementwise_min(value - load(other), one), -one);
};
numbers total = pull(here - stride_x) + pull(here + stride_x);
total = total + pull(here - stride_y) + pull(here + stride_y);
total = total + pull(here - 1) + pull(here + 1);
numbers weights;
for (int n = 0; n < CHANNELS; ++n) weights[n] = weight.c[n % 4];
auto* adj = gradient.values.data + node;
const numbers before = load(adj);
auto seen = before != 0;  // and then a node's other channels, too
seen |= __builtin_shufflevector(seen, seen, OTHER_OF_PAIR);
seen |= __builtin_shufflevector(seen, seen, OTHER_PAIR);
const numbers after = seen ? before + weights * total : before;
memcpy(adj, &after, sizeof(after));
return true;
#endif
""".replace("OTHER_OF_PAIR", _exchanged(1)).replace("OTHER_PAIR", _exchanged(2))
)
def add_tile_variation(
    values: wp.array(dtype=vec4), size: wp.vec3i, weight: vec4, node: int, gradient: Gradient
) -> bool:
    """Add adj_node_variation to a tile, from its first node, where gradient is not 0.

    All nodes around must be in the grid. Only a CPU does so, in Clang's vector types; returns
    whether it is done.
    """
    ...


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
    n_nodes = values.shape[0]
    start = (first + wp.tid()) * span
    end = start + wp.min(span, n_nodes - start)
    last = tile_of(end - 1) + 1
    stride_y = size[2]
    stride_x = size[1] * size[2]
    for group in range(tile_of(start), last, wp.static(GROUP)):
        tiles = tiles_ahead(gradient.touched, group, last)
        while tiles != wp.uint64(0):
            node = (group + wp.static(AHEAD) + first_of(tiles)) * wp.static(TILE)
            prefetch(gradient.values, node)
            prefetch(values, node)
            prefetch(values, node - stride_y)
            prefetch(values, node + stride_y)
            prefetch(values, node - stride_x)
            prefetch(values, node + stride_x)
            tiles = but_first(tiles)
        tiles = touched_tiles(gradient.touched, group, last)
        while tiles != wp.uint64(0):
            node = (group + first_of(tiles)) * wp.static(TILE)
            first_node = wp.max(start, node)
            end_node = wp.min(end, node + wp.static(TILE))
            j = (first_node // size[2]) % size[1]
            k = first_node % size[2]
            inside = end_node - first_node == wp.static(TILE)
            inside = inside and node >= stride_x and node < n_nodes - stride_x
            inside = inside and j > 0 and j + 1 < size[1]
            inside = inside and k > 0 and k + wp.static(TILE) < size[2]
            if inside and add_tile_variation(values, size, weight, node, gradient):
                end_node = first_node
            for n in range(first_node, end_node):
                adj = gradient.values[n]
                if not (adj == vec4()):
                    gradient.values[n] = adj + adj_node_variation(values, size, weight, n, j, k)
                k += 1  # on to the next node, without dividing for each
                if k == size[2]:
                    k = 0
                    j += 1
                    if j == size[1]:
                        j = 0
            tiles = but_first(tiles)
