"""Near-clip loss: pushes raw densities near a camera down, as DVGOv2 does; to compare with.

    L = sum of raw densities over samples with t < distance

so each of them has the slope 1, whatever it weighs. The distance scaling applies to it as to all
that reaches a sample.
"""

from typing import Any

import warp as wp

from ...base.parts import RayLoss, RayLossVectors
from ...base.simd import VECTORS
from ...base.types import real
from ..ray_loss import no_adj_weight, no_bound, no_weighted

wp.set_module_options({"enable_backward": False})


@wp.struct
class NearClipParams:
    """How much it counts, and how far."""

    factor: real
    distance: real  # scene units from the camera


@wp.struct
class NearClipSum:
    """Over the samples so far."""

    raw_density: real  # of those that are near


@wp.func
def add_near(
    params: NearClipParams, state: NearClipSum, weight: real, t: real, dt: real, raw_density: real
) -> NearClipSum:
    """One more sample."""
    out = NearClipSum()
    out.raw_density = state.raw_density
    if t < params.distance:
        out.raw_density += raw_density
    return out


@wp.func
def adj_add_near(params: NearClipParams, t: real) -> real:
    """Slope of the loss by the raw density of a sample."""
    if t < params.distance:
        return params.factor
    return real(0.0)


@wp.func
def value(params: NearClipParams, state: NearClipSum, transmittance: real) -> real:
    """L."""
    return params.factor * state.raw_density


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec near = load_int(pack.active) & (load(pack.t) < params.distance);
pack.near_clip = before.raw_density + sum(near ? load(pack.raw.data[0]) : splat(0.0f));
"""
)
def sum_up(params: NearClipParams, before: NearClipSum, packs: wp.array(dtype=Any), slot: int):
    """add_near for the samples of a pack; the sum is left in the pack."""
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec near = load_int(pack.active) & (load(pack.t) < params.distance);
const vec slope = near ? splat(params.factor * adj_value) : splat(0.0f);
store(pack.adj_density, load(pack.adj_density) + slope);
"""
)
def adj_sum_up(
    params: NearClipParams, adj_value: wp.float32, packs: wp.array(dtype=Any), slot: int
):
    """adj_add_near for the samples of a pack."""
    ...


@wp.func
def add_pack(
    params: NearClipParams, state: NearClipSum, packs: wp.array(dtype=Any), slot: int
) -> NearClipSum:
    """add_near for the samples of a pack."""
    sum_up(params, state, packs, slot)
    out = NearClipSum()
    out.raw_density = packs[slot].near_clip
    return out


@wp.func
def adj_add_pack(
    params: NearClipParams,
    total: NearClipSum,
    before: NearClipSum,
    adj_value: wp.float32,
    packs: wp.array(dtype=Any),
    slot: int,
) -> NearClipSum:
    """adj_add_near for the samples of a pack, which needs no sums."""
    adj_sum_up(params, adj_value, packs, slot)
    return before


NEAR_CLIP = RayLoss(
    Params=NearClipParams,
    State=NearClipSum,
    add=add_near,
    value=value,
    weighted=no_weighted,
    adj_weight=no_adj_weight,
    bound=no_bound,
    adj_density=adj_add_near,
    vectors=RayLossVectors(add_pack, adj_add_pack, (("near_clip", wp.float32),)),
)
