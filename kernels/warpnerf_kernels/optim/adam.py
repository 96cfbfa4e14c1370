"""Adam over the grid (Kingma & Ba 2015, algorithm 1), lazy: entries without a gradient stay.

It waits for memory, so both moments of an entry share 32 bits: in the upper 16 the mean as a
bfloat16 (sign, 8 bits of exponent, 7 of fraction), in the lower 16 the square, which has no sign (8
and 8). What does not fit is rounded up or down at random, with odds that keep the average right:
rounded to the nearest, an average that moves by less than half of its last bit would stand still.

On the CPU all channels of a tile are worked on at once, in Clang's vector types. float32 only.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.tiles import TILE, prefetch, tile_loop, tile_of
from ..base.types import gradient_type, real, vec3, vector
from ..fields.interp import place_along, place_in

wp.set_module_options({"enable_backward": False})


@cache
def moments_type(n_floats: int) -> type:
    """The moments of a node, both of a float in each number."""
    return wp.types.vector(n_floats, wp.uint32)


@wp.struct
class Adam:
    """The numbers of an update that are the same for all entries."""

    beta1: real
    beta2: real
    epsilon: real
    correction1: real  # 1 / (1 - beta1^update)
    correction2: real  # 1 / (1 - beta2^update)


PRELUDE = r"""
#if defined(__CUDA_ARCH__)
constexpr int AT_ONCE = 1;
typedef float number;
typedef unsigned bits;
#else
constexpr int AT_ONCE = CHANNELS;
typedef float number __attribute__((ext_vector_type(AT_ONCE), aligned(4), may_alias));
typedef unsigned bits __attribute__((ext_vector_type(AT_ONCE), aligned(4), may_alias));
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
auto nearest = [&](number mean, number square) -> bits {
    return join(mean, square, 0u * as_bits(mean) + 0x80004000u);
};
"""
"""What the native functions begin with; on the CPU they work on so many CHANNELS at once."""


@wp.func_native(
    f"constexpr int CHANNELS = {4 * TILE}, TILE = {TILE};"
    + PRELUDE
    + r"""
#if defined(__CUDA_ARCH__)
auto root = [](number x) -> number { return sqrtf(x); };
auto is_zero = [](number x) -> bool { return x == 0.0f; };
#else
auto root = [](number x) -> number { return __builtin_elementwise_sqrt(x); };
auto is_zero = [&](number x) -> bool { return __builtin_reduce_or(as_bits(x)) == 0; };
#endif
static_assert(sizeof(values.data->c[0]) == sizeof(float), "moments are cut out of float32");
constexpr int FLOATS = sizeof(*values.data) / sizeof(float);  // of a node
for (int c = 0; c < FLOATS * TILE && c < FLOATS * count; c += AT_ONCE) {
    const int n_here = FLOATS * count - c;  // a tile may be cut short, by the end of the grid
    auto load = [&](auto* from) {
        number x{};
        if (n_here >= AT_ONCE) memcpy(&x, (const float*)(from + node) + c, sizeof(x));
        else memcpy(&x, (const float*)(from + node) + c, sizeof(float) * n_here);
        return x;
    };
    auto store = [&](auto* to, number x) {
        if (n_here >= AT_ONCE) memcpy((float*)(to + node) + c, &x, sizeof(x));
        else memcpy((float*)(to + node) + c, &x, sizeof(float) * n_here);
    };
    const number g = load(gradient.values.data);
    if (is_zero(g)) continue;
    const number value = load(values.data);
    const bits old = as_bits(load(moments.data));
    number rate, fall;
    for (int n = 0; n < AT_ONCE; ++n) ((float*)&rate)[n] = learning_rate.c[(c + n) % FLOATS];
    for (int n = 0; n < AT_ONCE; ++n) ((float*)&fall)[n] = (c + n) % FLOATS ? 0.0f : decay;
    const number m = adam.beta1 * mean_of(old) + (1.0f - adam.beta1) * g;
    const number v = adam.beta2 * square_of(old) + (1.0f - adam.beta2) * (g * g);
    const number root_v = root(adam.correction2 * v);
    const number moved = value - rate * (adam.correction1 * m) / (root_v + adam.epsilon) - fall;
    const bits noise = (as_bits(g) + update * 0x9e3779b9u) * 0x9e3779b9u;  // 2^32 / golden ratio
    const bits joined = join(m, v, noise);
    store(values.data, g != 0.0f ? moved : value);
    store(moments.data, as_number(g != 0.0f ? joined : old));
    store(gradient.values.data, number{});
}
"""
)
def update_nodes(
    node: int,
    count: int,  # up to TILE
    update: wp.uint32,
    learning_rate: Any,
    decay: real,  # of the first number of each
    adam: Adam,
    gradient: Any,
    values: wp.array(dtype=Any),
    moments: wp.array(dtype=Any),
):
    """adam_step for some nodes, from the given one on.

    Gradient and update together decide how moments are rounded.
    """
    ...


@cache
def adam_kernel(n_floats: int, decays: bool) -> wp.Kernel:
    """Adam over a field whose nodes hold so many floats, and the first of which decays or not."""
    Node, Moments, Gradient = vector(n_floats), moments_type(n_floats), gradient_type(n_floats)

    @wp.struct
    class Entries:
        update: wp.uint32
        learning_rate: Node
        decay: wp.array(dtype=real)
        adam: Adam
        gradient: Gradient
        values: wp.array(dtype=Node)
        moments: wp.array(dtype=Moments)

    @wp.func
    def prefetch_tile(on: Entries, node: int):
        prefetch(on.gradient.values, node)
        prefetch(on.values, node)
        prefetch(on.moments, node)
        if wp.static(decays):
            prefetch(on.decay, tile_of(node))

    @wp.func
    def work(on: Entries, node: int, begin: int, end: int):
        decay = real(0.0)
        if wp.static(decays):
            decay = on.learning_rate[0] * on.decay[tile_of(node)]
        update_nodes(
            begin,
            end - begin,
            on.update,
            on.learning_rate,
            decay,
            on.adam,
            on.gradient,
            on.values,
            on.moments,
        )

    over_tiles = tile_loop(prefetch_tile, work)

    @wp.kernel(module="unique", enable_backward=False)
    def adam_step(
        # launch
        first: int,
        span: int,  # nodes per thread
        # choices
        update: wp.uint32,  # counts from 1
        learning_rate: Node,  # per channel
        decay: wp.array(dtype=real),  # [n_tiles] of the first number, in learning rates; or [0]
        adam: Adam,
        # out
        gradient: Gradient,  # zeroed
        values: wp.array(dtype=Node),  # [n_nodes] updated
        moments: wp.array(dtype=Moments),  # [n_nodes] updated
    ):
        """One update. An entry whose gradient is exactly zero keeps its value and its moments."""
        n_nodes = values.shape[0]
        start = (first + wp.tid()) * span
        on = Entries()
        on.update = update
        on.learning_rate = learning_rate
        on.decay = decay
        on.adam = adam
        on.gradient = gradient
        on.values = values
        on.moments = moments
        # start + span might be beyond int
        over_tiles(on, gradient.touched, start, start + wp.min(span, n_nodes - start))

    return adam_step


@wp.func_native(
    "constexpr int FLOATS = sizeof(*moments.data) / sizeof(unsigned);"
    "constexpr int CHANNELS = FLOATS < 4 ? 1 : 4;"
    + PRELUDE
    + r"""
const int stride_y = size.c[2], stride_x = stride_y * size.c[1];
for (int c = 0; c < FLOATS; c += AT_ONCE) {
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
    *(bits*)&out_moments.data[n].c[c] = nearest(mean, square);
}
"""
)
def gather_moments(
    moments: wp.array(dtype=Any),
    size: wp.vec3i,
    base: int,  # flat index of the lowest node
    fraction: vec3,
    out_moments: wp.array(dtype=Any),
    n: int,
):
    """interp.gather for moments, rounded to the nearest."""
    ...


@cache
def resample_moments_kernel(n_floats: int) -> wp.Kernel:
    """dense.resample_kernel for moments."""
    Moments = moments_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def resample_moments(
        # launch
        first: int,
        # scene
        moments: wp.array(dtype=Moments),  # [X * Y * Z]
        size: wp.vec3i,
        # choices
        scale: vec3,
        offset: vec3,
        # out
        out_size: wp.vec3i,
        out_moments: wp.array(dtype=Moments),  # [X' * Y' * Z']
    ):
        n = first + wp.tid()
        base, fraction = place_in(size, scale, offset, n, out_size)
        gather_moments(moments, size, base, fraction, out_moments, n)

    return resample_moments


@wp.func_native(
    "constexpr int CHANNELS = 4;"
    + PRELUDE
    + r"""
constexpr int FLOATS = sizeof(*moments.data) / sizeof(unsigned);
for (int c = 0; c < FLOATS; c += AT_ONCE) {
    const bits a = *(const bits*)&moments.data[low].c[c];
    const bits b = *(const bits*)&moments.data[high].c[c];
    const number mean = (1.0f - share) * mean_of(a) + share * mean_of(b);
    const number square = (1.0f - share) * square_of(a) + share * square_of(b);
    *(bits*)&out_moments.data[n].c[c] = nearest(mean, square);
}
"""
)
def blend_moments(
    moments: wp.array(dtype=Any),
    low: int,
    high: int,
    share: real,  # of the entry `high`
    out_moments: wp.array(dtype=Any),
    n: int,
):
    """Moments between those of two entries, rounded to the nearest."""
    ...


@cache
def resample_moments_along_kernel(n_floats: int) -> wp.Kernel:
    """factors.resample_kernel for moments."""
    Moments = moments_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def resample_moments_along(
        # launch
        first: int,
        # scene
        moments: wp.array(dtype=Moments),  # [outer * size * inner]
        # choices
        size: int,  # of the axis
        inner: int,  # how far neighbours along the axis lie apart
        scale: real,  # u on the old axis = u on the new one * scale + offset
        offset: real,
        # out
        out_size: int,  # of the axis
        out_moments: wp.array(dtype=Moments),  # [outer * out_size * inner]
    ):
        n = first + wp.tid()
        low, share = place_along(size, inner, scale, offset, out_size, n)
        blend_moments(moments, low, low + inner, share, out_moments, n)

    return resample_moments_along


@wp.kernel(enable_backward=False)
def adam_weights(
    # launch
    first: int,
    # choices
    learning_rate: real,
    adam: Adam,
    # out
    gradient: wp.array2d(dtype=real),  # [n_workers, n_weights] of each worker, zeroed
    values: wp.array(dtype=real),  # [n_weights] updated
    means: wp.array(dtype=real),  # [n_weights] updated
    squares: wp.array(dtype=real),  # [n_weights] updated
):
    """One update of weights that all rays share, from the sum of the workers' gradients in order.

    An entry whose gradient is exactly zero is left alone, as a node's is.
    """
    n = first + wp.tid()
    total = real(0.0)
    for worker in range(gradient.shape[0]):
        total += gradient[worker, n]
        gradient[worker, n] = real(0.0)
    if total != real(0.0):
        mean = adam.beta1 * means[n] + (real(1.0) - adam.beta1) * total
        square = adam.beta2 * squares[n] + (real(1.0) - adam.beta2) * (total * total)
        means[n] = mean
        squares[n] = square
        root = wp.sqrt(adam.correction2 * square)
        values[n] -= learning_rate * (adam.correction1 * mean) / (root + adam.epsilon)
