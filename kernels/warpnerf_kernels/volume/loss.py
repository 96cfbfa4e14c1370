"""Photometric losses, which compare a rendered ray's colour with its pixel, and their adjoints."""

import warp as wp

from ..base.parts import Losses, Photometric
from ..base.types import Nothing, real, vec3
from .ray_loss import NONE
from .sample_loss import NO_SAMPLE_LOSS

wp.set_module_options({"enable_backward": False})


@wp.func
def squared_error(rgb: vec3, target_rgb: vec3) -> real:
    """|rgb - target|^2, summed over the three channels."""
    return wp.length_sq(rgb - target_rgb)


@wp.func
def adj_squared_error(rgb: vec3, target_rgb: vec3, adj_error: real) -> vec3:
    """Adjoint of squared_error with respect to rgb."""
    return (real(2.0) * adj_error) * (rgb - target_rgb)


@wp.func
def squared(params: Nothing, rgb: vec3, target_rgb: vec3) -> real:
    """squared_error, as a part."""
    return squared_error(rgb, target_rgb)


@wp.func
def adj_squared(params: Nothing, rgb: vec3, target_rgb: vec3, adj_value: real) -> vec3:
    """Adjoint of squared with respect to rgb."""
    return adj_squared_error(rgb, target_rgb, adj_value)


@wp.struct
class HuberParams:
    """Where squares end."""

    delta: real  # > 0, of a channel


@wp.func
def huber(params: HuberParams, rgb: vec3, target_rgb: vec3) -> real:
    """Summed over channels: d^2 up to |d| = delta, and from there on its tangent.

    Source: Huber 1964, times two, so that it is the squared error where errors are small.
    """
    total = real(0.0)
    for c in range(3):
        d = wp.abs(rgb[c] - target_rgb[c])
        square = wp.min(d, params.delta)
        total += square * (real(2.0) * d - square)
    return total


@wp.func
def adj_huber(params: HuberParams, rgb: vec3, target_rgb: vec3, adj_value: real) -> vec3:
    """Adjoint of huber with respect to rgb: no channel pulls more than one that is delta off."""
    adj_rgb = vec3()
    for c in range(3):
        d = wp.clamp(rgb[c] - target_rgb[c], -params.delta, params.delta)
        adj_rgb[c] = real(2.0) * adj_value * d
    return adj_rgb


SQUARED = Photometric(Params=Nothing, value=squared, adj_value=adj_squared)
HUBER = Photometric(Params=HuberParams, value=huber, adj_value=adj_huber)

PHOTOMETRIC_ONLY = Losses(photometric=SQUARED, on_ray=NONE, on_samples=NO_SAMPLE_LOSS)
"""The squared error, and nothing else."""
