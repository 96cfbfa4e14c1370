"""Opacity loss: a ray should end at something opaque, where each pixel shows something.

    L = -log o,                         o = 1 - T_end, where o >= LEAST;
    L = -log LEAST + 1 - o / LEAST      below, on the tangent

That is the cross entropy of the opacity against 1. Without it what is as dark as the background may
as well be the background.
"""

import warp as wp

from ...base.parts import RayLoss
from ...base.types import Nothing, real
from ..ray_loss import OF_LIGHT_ONLY, add_nothing, no_adj_weight, no_bound, no_weighted

wp.set_module_options({"enable_backward": False})

LEAST = 0.01
"""Opacity below which the slope is that at it, so that it ends where rays meet nothing."""


@wp.struct
class OpacityParams:
    """How much it counts."""

    factor: real


@wp.func
def opacity_loss(params: OpacityParams, state: Nothing, transmittance: real) -> real:
    """L."""
    opacity = real(1.0) - transmittance
    most = wp.max(opacity, real(LEAST))
    return params.factor * ((most - opacity) / most - wp.log(most))


@wp.func
def adj_opacity_loss(params: OpacityParams, transmittance: real) -> real:
    """dL/dT_end = 1 / o, at most 1 / LEAST."""
    return params.factor / wp.max(real(1.0) - transmittance, real(LEAST))


OPACITY = RayLoss(
    Params=OpacityParams,
    State=Nothing,
    add=add_nothing,
    value=opacity_loss,
    weighted=no_weighted,
    adj_weight=no_adj_weight,
    bound=no_bound,
    adj_transmittance=adj_opacity_loss,
    vectors=OF_LIGHT_ONLY,
)
