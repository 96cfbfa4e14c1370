"""Per-sample colour loss: the colour of each sample is compared with the pixel of its ray.

    L = factor sum_i w_i |c_i - target|^2,    weights w_i taken as constants

Source: Sun, Sun & Chen 2022 (DVGO).
"""

from typing import Any

import warp as wp

from ...base.parts import SampleLoss, SampleLossVectors
from ...base.simd import VECTORS
from ...base.types import real, vec3

wp.set_module_options({"enable_backward": False})


@wp.struct
class ColourParams:
    """How much it counts."""

    factor: real


@wp.struct
class ColourSums:
    """Over the samples so far; with the ray's own sum of colours, all that L needs."""

    weight: real
    square: real  # of weight times |c|^2


@wp.func
def add_colour(
    params: ColourParams, state: ColourSums, weight: real, rgb: vec3, target_rgb: vec3
) -> ColourSums:
    """One more sample."""
    out = ColourSums()
    out.weight = state.weight + weight
    out.square = state.square + weight * wp.length_sq(rgb)
    return out


@wp.func
def adj_add_colour(params: ColourParams, rgb: vec3, target_rgb: vec3, adj_value: real) -> vec3:
    """Slope of the loss by a sample's colour, over its weight."""
    slope = real(2.0) * params.factor * adj_value
    return slope * (rgb - target_rgb)


@wp.func
def value(params: ColourParams, state: ColourSums, rgb: vec3, target_rgb: vec3) -> real:
    """L, with rgb the sum of weight times colour. Rounding does not make it negative."""
    crossed = real(2.0) * wp.dot(rgb, target_rgb)
    total = state.square - crossed + state.weight * wp.length_sq(target_rgb)
    return params.factor * wp.max(total, real(0.0))


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const vec weight = load(pack.colour_weight);
vec square = splat(0.0f);
for (int c = 0; c < 3; ++c) {
    square = fma(load(pack.channel.data[c]), load(pack.channel.data[c]), square);
}
pack.sample_colour.c[0] = sum(weight);
pack.sample_colour.c[1] = sum(weight * square);
"""
)
def sum_up(packs: wp.array(dtype=Any), slot: int):
    """add_colour for the samples of a pack, from zeros; the sums are left in the pack."""
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const float slope = 2.0f * params.factor * adj_value;
for (int c = 0; c < 3; ++c) {
    const vec off = load(pack.channel.data[c]) - target_rgb.c[c];
    store(pack.adj_channel.data[c], load(pack.adj_channel.data[c]) + slope * off);
}
"""
)
def adj_sum_up(
    params: ColourParams,
    adj_value: wp.float32,
    target_rgb: Any,
    packs: wp.array(dtype=Any),
    slot: int,
):
    """adj_add_colour for the samples of a pack."""
    ...


@wp.func
def add_pack(
    params: ColourParams,
    state: ColourSums,
    target_rgb: vec3,
    packs: wp.array(dtype=Any),
    slot: int,
) -> ColourSums:
    """add_colour for the samples of a pack."""
    sum_up(packs, slot)
    out = ColourSums()
    out.weight = state.weight + packs[slot].sample_colour[0]
    out.square = state.square + packs[slot].sample_colour[1]
    return out


SAMPLE_COLOUR = SampleLoss(
    Params=ColourParams,
    State=ColourSums,
    add=add_colour,
    value=value,
    adj_channels=adj_add_colour,
    vectors=SampleLossVectors(
        add_pack, adj_sum_up, (("sample_colour", wp.types.vector(2, wp.float32)),)
    ),
)
