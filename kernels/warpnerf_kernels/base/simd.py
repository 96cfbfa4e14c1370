"""SIMD: vectors of sixteen lanes and functions on them, in C++ for Clang."""

import warp as wp

from ..base.tiles import TILE

LANES = 16
"""Steps in a pack, and numbers in a vector: as many as the widest processors compute at once. On
others a vector is two or four of theirs, which do not wait for each other."""

lanes = wp.types.vector(LANES, wp.float32)
lanes_int = wp.types.vector(LANES, wp.int32)


def _shifted(n: int) -> str:
    """The lanes of a vector, n places up, and in the first n the first lane of another vector."""
    return ", ".join(str(LANES if lane < n else lane - n) for lane in range(LANES))


VECTORS = (
    f"constexpr int LANES = {LANES}, TILE = {TILE};\n"
    + "".join(
        f"#define SHIFT_LANES_{n}(x, below) __builtin_shufflevector(x, below, {_shifted(n)})\n"
        for n in (1, 2, 4, 8)
    )
    + r"""
// Sixteen lanes; eight numbers: half the lanes, or two nodes; four: the channels of a node.
typedef float vec __attribute__((ext_vector_type(LANES)));
typedef int ivec __attribute__((ext_vector_type(LANES)));
typedef float float8 __attribute__((ext_vector_type(8)));
typedef float float4 __attribute__((ext_vector_type(4)));
// The same where they lie in memory.
typedef float vec_at __attribute__((ext_vector_type(LANES), aligned(4), may_alias));
typedef int ivec_at __attribute__((ext_vector_type(LANES), aligned(4), may_alias));

auto load = [&](const auto& x) -> vec { return *(const vec_at*)&x; };
auto load_int = [&](const auto& x) -> ivec { return *(const ivec_at*)&x; };
auto store = [&](auto& x, vec v) { *(vec_at*)&x = v; };
auto store_int = [&](auto& x, ivec v) { *(ivec_at*)&x = v; };

auto splat = [&](float x) -> vec { return vec(x); };
auto min = [&](auto a, auto b) { return __builtin_elementwise_min(a, b); };
auto max = [&](auto a, auto b) { return __builtin_elementwise_max(a, b); };
auto abs = [&](vec x) -> vec { return __builtin_elementwise_abs(x); };
auto truncate = [&](vec x) -> ivec { return __builtin_convertvector(x, ivec); };
auto to_float = [&](ivec x) -> vec { return __builtin_convertvector(x, vec); };
auto clamp = [&](ivec x, int size) -> ivec { return min(max(x, ivec(0)), ivec(size - 1)); };
auto fma = [&](auto a, auto b, auto c) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
    return __builtin_elementwise_fma(a, b, c);
#else
    return a * b + c;
#endif
};

// exp(x) = 2^n exp(r), r = x - n log 2 in two parts, |r| <= log(2) / 2.
// The polynomial is (exp(r) - 1 - r) / r^2 at five Chebyshev points; relative error 7e-8.
auto exponential = [&](vec x) -> vec {
    x = x < -87.0f ? splat(-87.0f) : x;  // not by min and max, which would hide a NaN
    x = x > 88.0f ? splat(88.0f) : x;
    vec n = __builtin_elementwise_rint(x * 1.44269504f);
    vec r = fma(n, splat(2.12194440e-4f), fma(n, splat(-0.693359375f), x));
    vec p = fma(splat(1.39261840e-3f), r, splat(8.36317893e-3f));
    p = fma(p, r, splat(4.16665561e-2f));
    p = fma(p, r, splat(1.66665763e-1f));
    p = fma(p, r, splat(0.5f));
    p = fma(p, r * r, r) + 1.0f;
    return __builtin_bit_cast(vec, __builtin_bit_cast(ivec, p) + (truncate(n) << 23));
};
// log(1 + y) = 2 artanh(z), z = y / (2 + y), for y in [0, 1]; precise for small y as well.
// The polynomial is 2 artanh(z) / z at five Chebyshev points of z^2; relative error 1e-7.
auto log1p = [&](vec y) -> vec {
    vec z = y / (2.0f + y);
    vec z2 = z * z;
    vec p = fma(splat(0.281577796f), z2, splat(0.279651582f));
    p = fma(p, z2, splat(0.400245965f));
    p = fma(p, z2, splat(0.666663229f));
    return z * fma(p, z2, splat(2.0f));
};
auto sigmoid = [&](vec x) -> vec { return 1.0f / (1.0f + exponential(-x)); };

auto sum = [&](vec x) -> float {
    float8 g = x.lo + x.hi;
    float4 h = g.lo + g.hi;
    return (h[0] + h[2]) + (h[1] + h[3]);
};
auto bits = [&](ivec x) -> unsigned {  // bit n: lane n is not 0
    typedef bool flags __attribute__((ext_vector_type(LANES)));
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(x, flags));
};
auto each = [&](unsigned lanes, auto visit) {  // the lanes whose bits are set
    for (; lanes; lanes &= lanes - 1) visit(__builtin_ctz(lanes));
};
// Writes first + lane for each lane whose bit is set, one after the other; out needs room for
// sixteen. Returns how many there are.
auto list_lanes = [&](unsigned lanes, int first, int* out) -> int {
#ifdef __AVX512F__
    const ivec numbers = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    *(ivec_at*)out = __builtin_ia32_compresssi512_mask(first + numbers, ivec(0), lanes);
#else
    int n = 0;
    each(lanes, [&](int lane) { out[n++] = first + lane; });
#endif
    return __builtin_popcount(lanes);
};
auto count = [&](ivec x) -> int { return -__builtin_reduce_add(x); };
// In lane i the sum, or product, of lanes 0 to i.
auto running_sum = [&](vec x) -> vec {
    vec zero = splat(0.0f);
    x += SHIFT_LANES_1(x, zero);
    x += SHIFT_LANES_2(x, zero);
    x += SHIFT_LANES_4(x, zero);
    return x + SHIFT_LANES_8(x, zero);
};
auto running_product = [&](vec x) -> vec {
    vec one = splat(1.0f);
    x *= SHIFT_LANES_1(x, one);
    x *= SHIFT_LANES_2(x, one);
    x *= SHIFT_LANES_4(x, one);
    return x * SHIFT_LANES_8(x, one);
};
// Eight float4 as four float8, one a channel (a transpose), and back.
auto float4_to_float8 = [&](const float4* q, float8& a, float8& b, float8& c, float8& d) {
    float8 q04 = __builtin_shufflevector(q[0], q[4], 0, 1, 2, 3, 4, 5, 6, 7);
    float8 q15 = __builtin_shufflevector(q[1], q[5], 0, 1, 2, 3, 4, 5, 6, 7);
    float8 q26 = __builtin_shufflevector(q[2], q[6], 0, 1, 2, 3, 4, 5, 6, 7);
    float8 q37 = __builtin_shufflevector(q[3], q[7], 0, 1, 2, 3, 4, 5, 6, 7);
    float8 ab0145 = __builtin_shufflevector(q04, q15, 0, 8, 1, 9, 4, 12, 5, 13);
    float8 ab2367 = __builtin_shufflevector(q26, q37, 0, 8, 1, 9, 4, 12, 5, 13);
    float8 cd0145 = __builtin_shufflevector(q04, q15, 2, 10, 3, 11, 6, 14, 7, 15);
    float8 cd2367 = __builtin_shufflevector(q26, q37, 2, 10, 3, 11, 6, 14, 7, 15);
    a = __builtin_shufflevector(ab0145, ab2367, 0, 1, 8, 9, 4, 5, 12, 13);
    b = __builtin_shufflevector(ab0145, ab2367, 2, 3, 10, 11, 6, 7, 14, 15);
    c = __builtin_shufflevector(cd0145, cd2367, 0, 1, 8, 9, 4, 5, 12, 13);
    d = __builtin_shufflevector(cd0145, cd2367, 2, 3, 10, 11, 6, 7, 14, 15);
};
auto float8_to_float4 = [&](float8 a, float8 b, float8 c, float8 d, float4* q) {
    float8 ab0145 = __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13);
    float8 ab2367 = __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15);
    float8 cd0145 = __builtin_shufflevector(c, d, 0, 8, 1, 9, 4, 12, 5, 13);
    float8 cd2367 = __builtin_shufflevector(c, d, 2, 10, 3, 11, 6, 14, 7, 15);
    float8 q04 = __builtin_shufflevector(ab0145, cd0145, 0, 1, 8, 9, 4, 5, 12, 13);
    float8 q15 = __builtin_shufflevector(ab0145, cd0145, 2, 3, 10, 11, 6, 7, 14, 15);
    float8 q26 = __builtin_shufflevector(ab2367, cd2367, 0, 1, 8, 9, 4, 5, 12, 13);
    float8 q37 = __builtin_shufflevector(ab2367, cd2367, 2, 3, 10, 11, 6, 7, 14, 15);
    q[0] = q04.lo; q[1] = q15.lo; q[2] = q26.lo; q[3] = q37.lo;
    q[4] = q04.hi; q[5] = q15.hi; q[6] = q26.hi; q[7] = q37.hi;
};
// Sixteen float4 as four vectors, one a channel (a transpose), and back.
auto float4_to_lanes = [&](const float4* q, vec& a, vec& b, vec& c, vec& d) {
    float8 low[4], high[4];
    float4_to_float8(q, low[0], low[1], low[2], low[3]);
    float4_to_float8(q + 8, high[0], high[1], high[2], high[3]);
    auto joined = [&](int channel) -> vec {
        vec both;
        both.lo = low[channel];
        both.hi = high[channel];
        return both;
    };
    a = joined(0);
    b = joined(1);
    c = joined(2);
    d = joined(3);
};
auto lanes_to_float4 = [&](vec a, vec b, vec c, vec d, float4* q) {
    float8_to_float4(a.lo, b.lo, c.lo, d.lo, q);
    float8_to_float4(a.hi, b.hi, c.hi, d.hi, q + 8);
};
// Shares of the four columns of nodes around samples, by x and y; together 1.
auto split = [&](vec fraction_x, vec fraction_y, auto& shares) {
    vec rest_x = 1.0f - fraction_x, rest_y = 1.0f - fraction_y;
    store(shares[0], rest_x * rest_y);
    store(shares[1], rest_x * fraction_y);
    store(shares[2], fraction_x * rest_y);
    store(shares[3], fraction_x * fraction_y);
};
"""
)
"""What a native function in vector form begins with. vec and ivec hold a number for each of sixteen
steps, float8 for eight of them, float4 four numbers of a node; names with _at are the same where
they lie in memory."""
