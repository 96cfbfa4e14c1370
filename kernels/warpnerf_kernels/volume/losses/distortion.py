"""Distortion loss: weights of a ray that lie apart cost, so that its density concentrates.

    L = sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 h_i,    s = t / (unit + t)

h is a step's length in s. Source: Barron et al. 2022 (mip-NeRF 360), eq. 15, with sums over the
samples before as in Sun et al. 2022 (DVGOv2), so that memory does not grow with the samples.
"""

from typing import Any

import warp as wp

from ...base.parts import RayLoss, RayLossVectors
from ...base.simd import VECTORS
from ...base.types import real

wp.set_module_options({"enable_backward": False})


@wp.struct
class DistortionParams:
    """How much it counts, and the distance that is half of all."""

    factor: real
    unit: real  # > 0, scene units: where s is 1/2


@wp.struct
class DistortionSums:
    """Over the samples so far."""

    loss: real  # without the factor
    weight: real  # W, sum of weights
    moment: real  # M, sum of weight times s


@wp.func
def squeezed(unit: real, t: real) -> real:
    """s, in [0, 1)."""
    return t / (unit + t)


@wp.func
def squeezed_length(unit: real, t: real, dt: real) -> real:
    """h: a step of length dt around t, in s. Not by a difference, which would lose digits."""
    begin = wp.max(t - real(0.5) * dt, real(0.0))
    end = t + real(0.5) * dt
    return unit * (end - begin) / ((unit + begin) * (unit + end))


@wp.func
def add_distortion(
    params: DistortionParams,
    state: DistortionSums,
    weight: real,
    t: real,
    dt: real,
    raw_density: real,
) -> DistortionSums:
    """One more sample: w^2 h / 3 + 2 w (s W - M)."""
    s = squeezed(params.unit, t)
    spread = weight * squeezed_length(params.unit, t, dt) / real(3.0)
    apart = real(2.0) * (s * state.weight - state.moment)
    out = DistortionSums()
    out.loss = state.loss + weight * (spread + apart)
    out.weight = state.weight + weight
    out.moment = state.moment + weight * s
    return out


@wp.func
def adj_add_distortion(
    params: DistortionParams,
    total: DistortionSums,
    before: DistortionSums,
    weight: real,
    t: real,
    dt: real,
) -> real:
    """dL/dw = 2 [s (2 W + w - W_all) - (2 M + w s - M_all)] + 2/3 w h."""
    s = squeezed(params.unit, t)
    nearer = real(2.0) * before.weight + weight - total.weight
    moments = real(2.0) * before.moment + weight * s - total.moment
    spread = weight * squeezed_length(params.unit, t, dt) / real(3.0)
    return real(2.0) * params.factor * (s * nearer - moments + spread)


@wp.func
def value(params: DistortionParams, state: DistortionSums, transmittance: real) -> real:
    """L."""
    return params.factor * state.loss


@wp.func
def weighted(params: DistortionParams, state: DistortionSums) -> real:
    """2 L, as it is of degree two in the weights."""
    return real(2.0) * params.factor * state.loss


@wp.func
def bound(params: DistortionParams, total: DistortionSums, t_end: real) -> real:
    """Neither s nor h exceeds 1, nor does the sum of weights."""
    return real(8.0) / real(3.0) * params.factor


OF_PACK = (
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const vec zero = splat(0.0f), weight = load(pack.weight), t = load(pack.t);
const vec half = 0.5f * load(pack.length), end = t + half;
const vec begin = t > half ? t - half : zero;
const vec s = t / (params.unit + t);
const vec h = params.unit * (end - begin) / ((params.unit + begin) * (params.unit + end));
const vec spread = (1.0f / 3.0f) * (weight * h), moment = weight * s;
const vec weights = running_sum(weight), moments = running_sum(moment);
const vec W = before.weight + SHIFT_LANES_1(weights, zero);
const vec M = before.moment + SHIFT_LANES_1(moments, zero);
pack.distortion.c[1] = before.weight + weights[LANES - 1];
pack.distortion.c[2] = before.moment + moments[LANES - 1];
"""
)


@wp.func_native(
    OF_PACK + "pack.distortion.c[0] = before.loss + sum(weight * (spread + 2.0f * (s * W - M)));\n"
)
def sum_up(params: DistortionParams, before: DistortionSums, packs: wp.array(dtype=Any), slot: int):
    """add_distortion for the samples of a pack; the sums are left in the pack."""
    ...


@wp.func_native(
    OF_PACK
    + r"""
const vec nearer = 2.0f * W + weight - total.weight, far = 2.0f * M + moment - total.moment;
const vec slope = (2.0f * params.factor * adj_value) * (s * nearer - far + spread);
store(pack.adj_weight, load(pack.adj_weight) + slope);
pack.distortion.c[0] = before.loss;
"""
)
def adj_sum_up(
    params: DistortionParams,
    total: DistortionSums,
    before: DistortionSums,
    adj_value: wp.float32,
    packs: wp.array(dtype=Any),
    slot: int,
):
    """adj_add_distortion for the samples of a pack, and the sums W and M as sum_up leaves them."""
    ...


@wp.func
def sums_of(packs: wp.array(dtype=Any), slot: int) -> DistortionSums:
    """What was left in the pack."""
    out = DistortionSums()
    out.loss = packs[slot].distortion[0]
    out.weight = packs[slot].distortion[1]
    out.moment = packs[slot].distortion[2]
    return out


@wp.func
def add_pack(
    params: DistortionParams, state: DistortionSums, packs: wp.array(dtype=Any), slot: int
) -> DistortionSums:
    """add_distortion for the samples of a pack."""
    sum_up(params, state, packs, slot)
    return sums_of(packs, slot)


@wp.func
def adj_add_pack(
    params: DistortionParams,
    total: DistortionSums,
    before: DistortionSums,
    adj_value: wp.float32,
    packs: wp.array(dtype=Any),
    slot: int,
) -> DistortionSums:
    """adj_add_distortion for the samples of a pack."""
    adj_sum_up(params, total, before, adj_value, packs, slot)
    return sums_of(packs, slot)


DISTORTION = RayLoss(
    Params=DistortionParams,
    State=DistortionSums,
    add=add_distortion,
    value=value,
    weighted=weighted,
    adj_weight=adj_add_distortion,
    bound=bound,
    vectors=RayLossVectors(
        add_pack, adj_add_pack, (("distortion", wp.types.vector(3, wp.float32)),)
    ),
)
