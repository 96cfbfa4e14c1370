"""The optimiser step. Kingma & Ba 2015, algorithm 1; entries without a gradient are left alone.

The step waits for memory, so both moments of an entry share 32 bits: in the upper 16 the mean as a
bfloat16 (sign, 8 bits of exponent, 7 of fraction), in the lower 16 the square, which has no sign (8
and 8). What does not fit is rounded up or down at random, with odds that keep the average right:
rounded to the nearest, an average that moves by less than half of its last bit would stand still.

On the CPU a node's four channels are worked on at once, in Clang's vector types. float32 only.
"""

import warp as wp

from .interp import place_in
from .tiles import TILE, next_tile, prefetch, tile_of
from .types import Gradient, vec3, vec4

wp.set_module_options({"enable_backward": False})

uint4 = wp.types.vector(4, wp.uint32)
"""The moments of a node, a channel in each."""

WORDS = r"""
#if defined(__CUDA_ARCH__)
constexpr int AT_ONCE = 1;
typedef float number;
typedef unsigned bits;
auto root = [](number x) -> number { return sqrtf(x); };
#else
constexpr int AT_ONCE = 4;
typedef float number __attribute__((ext_vector_type(4), aligned(4), may_alias));
typedef unsigned bits __attribute__((ext_vector_type(4), aligned(4), may_alias));
auto root = [](number x) -> number { return __builtin_elementwise_sqrt(x); };
#endif
auto as_bits = [](number x) -> bits { bits y; memcpy(&y, &x, sizeof(y)); return y; };
auto as_number = [](bits x) -> number { number y; memcpy(&y, &x, sizeof(y)); return y; };
auto mean_of = [&](bits moments) -> number { return as_number(moments & 0xffff0000u); };
auto square_of = [&](bits moments) -> number { return as_number((moments << 16) >> 1); };
// Rounded up if the 16, or 15, bits that are cut off and as many of `noise` carry over.
auto join = [&](number mean, number square, bits noise) -> bits {
    return ((as_bits(mean) + (noise >> 16)) & 0xffff0000u) |
        ((as_bits(square) + (noise & 0x7fffu)) >> 15);
};
"""
"""What the native functions begin with; they work on AT_ONCE channels at once."""


@wp.func_native(
    WORDS
    + r"""
static_assert(sizeof(values.data->c[0]) == sizeof(float), "moments are cut out of float32");
for (int c = 0; c < 4; c += AT_ONCE) {
    number& adj_at = *(number*)&gradient.values.data[node].c[c];
    number& value_at = *(number*)&values.data[node].c[c];
    bits& moments_at = *(bits*)&moments.data[node].c[c];
    const number rate = *(const number*)&learning_rate.c[c];
    const number g = adj_at, value = value_at;
    const bits old = moments_at;
    const number m = beta1 * mean_of(old) + (1.0f - beta1) * g;
    const number v = beta2 * square_of(old) + (1.0f - beta2) * (g * g);
    const number moved = value - rate * (correction1 * m) / (root(correction2 * v) + epsilon);
    const bits noise = (as_bits(g) + step * 0x9e3779b9u) * 0x9e3779b9u;  // 2^32 / golden ratio
    const bits joined = join(m, v, noise);
    value_at = g != 0.0f ? moved : value;
    moments_at = g != 0.0f ? joined : old;
    adj_at = 0.0f;
}
"""
)
def step_node(
    node: int,
    step: wp.uint32,
    learning_rate: vec4,
    beta1: float,
    beta2: float,
    epsilon: float,
    correction1: float,
    correction2: float,
    gradient: Gradient,
    values: wp.array(dtype=vec4),
    moments: wp.array(dtype=uint4),
):
    """adam_step for a node. Gradient and step together decide how its moments are rounded."""
    ...


@wp.kernel
def adam_step(
    first: int,
    span: int,  # nodes per thread
    step: wp.uint32,  # counts from 1
    learning_rate: vec4,  # per channel
    beta1: float,
    beta2: float,
    epsilon: float,
    correction1: float,  # 1 / (1 - beta1^step)
    correction2: float,  # 1 / (1 - beta2^step)
    gradient: Gradient,  # zeroed
    values: wp.array(dtype=vec4),  # [n_nodes] updated
    moments: wp.array(dtype=uint4),  # [n_nodes] updated
):
    """One step. An entry whose gradient is exactly zero keeps its value and its moments."""
    n_nodes = values.shape[0]
    start = (first + wp.tid()) * span
    end = start + wp.min(span, n_nodes - start)  # start + span might be beyond int
    later_end = end + wp.min(span, n_nodes - end)
    last = tile_of(end - 1) + 1
    later_last = tile_of(later_end - 1) + 1
    tile = next_tile(gradient.touched, last, later_last)
    while tile < later_last:  # what the next thread will need: a CPU runs them one by one
        node = tile * wp.static(TILE)
        prefetch(gradient.values, node)
        prefetch(values, node)
        prefetch(moments, node)
        tile = next_tile(gradient.touched, tile + 1, later_last)
    tile = next_tile(gradient.touched, tile_of(start), last)
    while tile < last:
        node = tile * wp.static(TILE)
        for i in range(wp.max(start, node), wp.min(end, node + wp.static(TILE))):
            if not (gradient.values[i] == vec4()):
                step_node(
                    i,
                    step,
                    learning_rate,
                    beta1,
                    beta2,
                    epsilon,
                    correction1,
                    correction2,
                    gradient,
                    values,
                    moments,
                )
        tile = next_tile(gradient.touched, tile + 1, last)


@wp.func_native(
    WORDS
    + r"""
const int stride_y = size.c[2], stride_x = stride_y * size.c[1];
for (int c = 0; c < 4; c += AT_ONCE) {
    number mean = 0.0f, square = 0.0f;
    for (int corner = 0; corner < 8; ++corner) {
        const bool x = corner & 4, y = corner & 2, z = corner & 1;
        const float share = (x ? fraction.c[0] : 1.0f - fraction.c[0]) *
            (y ? fraction.c[1] : 1.0f - fraction.c[1]) * (z ? fraction.c[2] : 1.0f - fraction.c[2]);
        const int node = base + x * stride_x + y * stride_y + z;
        const bits old = *(const bits*)&moments.data[node].c[c];
        mean += share * mean_of(old);
        square += share * square_of(old);
    }
    const bits half = 0u * as_bits(mean) + 0x80004000u;
    *(bits*)&out_moments.data[n].c[c] = join(mean, square, half);
}
"""
)
def gather_moments(
    moments: wp.array(dtype=uint4),
    size: wp.vec3i,
    base: int,  # flat index of the lowest node
    fraction: vec3,
    out_moments: wp.array(dtype=uint4),
    n: int,
):
    """interp.gather for moments, rounded to the nearest."""
    ...


@wp.kernel
def resample_moments(
    first: int,
    moments: wp.array(dtype=uint4),  # [X * Y * Z]
    size: wp.vec3i,
    scale: vec3,
    offset: vec3,
    out_size: wp.vec3i,
    out_moments: wp.array(dtype=uint4),  # [X' * Y' * Z']
):
    """interp.resample for moments."""
    n = first + wp.tid()
    base, fraction = place_in(size, scale, offset, n, out_size)
    gather_moments(moments, size, base, fraction, out_moments, n)
