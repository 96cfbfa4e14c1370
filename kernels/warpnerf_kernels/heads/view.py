"""Positional encoding of the direction of view, for an MLP."""

from functools import cache

import warp as wp

from ..base.loops import runtime
from ..base.types import real, vec3, vector

wp.set_module_options({"enable_backward": False})


def n_encoded(n_frequencies: int) -> int:
    """How many numbers ``encoding`` has."""
    return 3 + 6 * n_frequencies


@cache
def encoding(n_frequencies: int) -> wp.Function:
    """d, and sin(2^k d), cos(2^k d) for k below n_frequencies, of a unit vector d.

    Source: Mildenhall et al. 2020, section 5.1; without pi, and with d itself, as in DVGO.
    """
    Encoded = vector(n_encoded(n_frequencies))

    @wp.func
    def encode(direction: vec3) -> Encoded:
        out = Encoded()
        n_axes, n_doublings = runtime(3), runtime(n_frequencies)
        for axis in range(n_axes):
            out[axis] = direction[axis]
            frequency = real(1.0)
            for k in range(n_doublings):
                out[3 + 6 * k + axis] = wp.sin(frequency * direction[axis])
                out[6 + 6 * k + axis] = wp.cos(frequency * direction[axis])
                frequency *= real(2.0)
        return out

    return encode


ENCODE = r"""
// The numbers of an encoded direction, sixteen angles at a time. With n the nearest multiple of
// pi / 2, r = x - n pi / 2 in three parts; sine and cosine of r, |r| <= pi / 4, by their series.
auto encode_direction = [&](const auto& direction, int n_frequencies, float* out) {
    for (int axis = 0; axis < 3; ++axis) out[axis] = direction.c[axis];
    const int n_angles = 3 * n_frequencies;
    for (int begin = 0; begin < n_angles; begin += LANES) {
        vec x = splat(0.0f);
        for (int n = 0; n < LANES && begin + n < n_angles; ++n) {
            x[n] = direction.c[(begin + n) % 3] * (float)(1 << (begin + n) / 3);
        }
        const vec n = __builtin_elementwise_rint(x * 0.636619772f);
        vec r = fma(n, splat(-1.5703125f), x);
        r = fma(n, splat(-4.83751297e-4f), r);
        r = fma(n, splat(-7.54978942e-8f), r);
        const vec r2 = r * r;
        vec s = fma(splat(-1.95152959e-4f), r2, splat(8.33216087e-3f));
        s = fma(fma(s, r2, splat(-1.66666546e-1f)), r2 * r, r);
        vec c = fma(splat(2.44331571e-5f), r2, splat(-1.38873162e-3f));
        c = fma(fma(c, r2, splat(4.16666457e-2f)), r2 * r2, fma(splat(-0.5f), r2, splat(1.0f)));
        const ivec quarter = truncate(n);
        const ivec swapped = (quarter & 1) != 0;
        const vec sine = swapped ? c : s, cosine = swapped ? s : c;
        const vec signed_sine = (quarter & 2) != 0 ? -sine : sine;
        const vec signed_cosine = ((quarter + 1) & 2) != 0 ? -cosine : cosine;
        for (int m = 0; m < LANES && begin + m < n_angles; ++m) {
            const int k = (begin + m) / 3, axis = (begin + m) % 3;
            out[3 + 6 * k + axis] = signed_sine[m];
            out[6 + 6 * k + axis] = signed_cosine[m];
        }
    }
};
"""
"""The vector form of ``encoding``, for a ray: encode_direction(direction, n_frequencies, out)."""
