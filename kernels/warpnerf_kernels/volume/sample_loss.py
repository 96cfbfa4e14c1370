"""Loss of the colours of single samples, held against the pixel of their ray.

    L = factor sum_i w_i |c_i - target|^2,    weights w_i taken as constants

Source: Sun, Sun & Chen 2022 (DVGO). It reaches colours only. Samples that have no colour, because
they weigh too little, do not count.
"""

import warp as wp

from ..base.types import real, vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class ColourSums:
    """Over the samples with a colour; with the ray's own sum of colours, all that L needs."""

    weight: real
    square: real  # of weight times |c|^2


@wp.func
def sample_loss(factor: real, sums: ColourSums, rgb: vec3, target_rgb: vec3) -> real:
    """L, with rgb the sum of weight times colour. Rounding does not make it negative."""
    crossed = real(2.0) * wp.dot(rgb, target_rgb)
    total = sums.square - crossed + sums.weight * wp.length_sq(target_rgb)
    return factor * wp.max(total, real(0.0))


@wp.func
def adj_sample_loss(slope: real, rgb: vec3, target_rgb: vec3) -> vec3:
    """dL/dc of a sample over its weight; slope is twice the factor, times what flows back to L."""
    return slope * (rgb - target_rgb)
