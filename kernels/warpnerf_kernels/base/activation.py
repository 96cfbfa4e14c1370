"""Pointwise functions from raw values to densities and colours, each with its adjoint below it."""

from typing import Any

import warp as wp

from ..base.types import real


@wp.func
def log1p_small(x: real) -> real:
    """log(1 + x) for x in [0, 1], to full relative precision when x is small."""
    if x < real(0.01):
        return x * (
            real(1.0)
            - x
            * (
                real(0.5)
                - x * (real(1.0) / real(3.0) - x * (real(0.25) - x * (real(1.0) / real(5.0))))
            )
        )
    return wp.log(real(1.0) + x)


@wp.func
def alpha_of(tau: real, attenuation: real) -> real:
    """1 - exp(-tau) for tau >= 0, given attenuation = exp(-tau); precise for small tau too."""
    if tau < real(0.01):
        return tau * (
            real(1.0)
            - tau
            * (
                real(0.5)
                - tau
                * (
                    real(1.0) / real(6.0)
                    - tau * (real(1.0) / real(24.0) - tau * (real(1.0) / real(120.0)))
                )
            )
        )
    return real(1.0) - attenuation


@wp.func
def softplus(x: real) -> real:
    """log(1 + exp(x)), arranged so that a large x does not overflow."""
    return wp.max(x, real(0.0)) + log1p_small(wp.exp(-wp.abs(x)))


@wp.func
def softplus_slope(x: real) -> real:
    """d softplus / dx = sigmoid(x)."""
    e = wp.exp(-wp.abs(x))
    return wp.where(x >= real(0.0), real(1.0), e) / (real(1.0) + e)


@wp.func
def adj_softplus(slope: real, adj_y: real) -> real:
    """Adjoint of softplus, given its slope."""
    return slope * adj_y


@wp.func
def sigmoid(x: Any):
    """1 / (1 + exp(-x)) of each entry."""
    y = x - x
    for n in range(len(x)):
        y[n] = real(1.0) / (real(1.0) + wp.exp(-x[n]))
    return y


@wp.func
def adj_sigmoid(y: Any, adj_y: Any):
    """Adjoint of sigmoid, from its value: d sigmoid / dx = y (1 - y)."""
    adj_x = y - y
    for n in range(len(y)):
        adj_x[n] = adj_y[n] * y[n] * (real(1.0) - y[n])
    return adj_x
