"""Entropy loss on the remaining light: a ray should end at something opaque, or meet nothing.

    L = -(p log p + (1 - p) log(1 - p)),    p = T_end, clamped to [1e-6, 1 - 1e-6]

Source: Sun, Sun & Chen 2022 (DVGO). p is the transmittance itself, not 1 less a sum of weights,
which in float32 would be noise where little light is left.
"""

import warp as wp

from ...base.parts import RayLoss
from ...base.types import Nothing, real
from ..ray_loss import OF_LIGHT_ONLY, add_nothing, no_adj_weight, no_bound, no_weighted

wp.set_module_options({"enable_backward": False})

LEAST, MOST = 1e-6, 1.0 - 1e-6


@wp.struct
class EntropyParams:
    """How much it counts."""

    factor: real


@wp.func
def entropy(params: EntropyParams, state: Nothing, transmittance: real) -> real:
    """L."""
    p = wp.clamp(transmittance, real(LEAST), real(MOST))
    return -params.factor * (p * wp.log(p) + (real(1.0) - p) * wp.log(real(1.0) - p))


@wp.func
def adj_entropy(params: EntropyParams, transmittance: real) -> real:
    """dL/dp = log(1 - p) - log p; 0 where p is clamped."""
    if transmittance <= real(LEAST) or transmittance >= real(MOST):
        return real(0.0)
    return params.factor * (wp.log(real(1.0) - transmittance) - wp.log(transmittance))


ENTROPY = RayLoss(
    Params=EntropyParams,
    State=Nothing,
    add=add_nothing,
    value=entropy,
    weighted=no_weighted,
    adj_weight=no_adj_weight,
    bound=no_bound,
    adj_transmittance=adj_entropy,
    vectors=OF_LIGHT_ONLY,
)
