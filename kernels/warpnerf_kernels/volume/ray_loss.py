"""Losses over the samples of a ray, besides that of its colour: none, and several as one."""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import RayLoss
from ..base.types import Nothing, real

wp.set_module_options({"enable_backward": False})


@wp.func
def add_nothing(state: Nothing, weight: real, t: real, dt: real) -> Nothing:
    """No loss: no sum changes."""
    return state


@wp.func
def zero(state: Nothing) -> real:
    """Value and weighted sum of no loss."""
    return real(0.0)


@wp.func
def no_slope(total: Nothing, before: Nothing, weight: real, t: real, dt: real) -> real:
    """Derivative of no loss by a weight."""
    return real(0.0)


@wp.func
def no_bound(total: Nothing, t_end: real) -> real:
    """Bound of that derivative."""
    return real(0.0)


NONE = RayLoss(
    State=Nothing,
    add=add_nothing,
    value=zero,
    weighted=zero,
    adj_weight=no_slope,
    bound=no_bound,
)
"""The loss that is 0."""


@cache
def sum_of(a: RayLoss, b: RayLoss) -> RayLoss:
    """Two losses as one. They are composed when kernels are compiled."""
    A: Any = a.State
    B: Any = b.State
    add_a, value_a, weighted_a, adj_a, bound_a = a.add, a.value, a.weighted, a.adj_weight, a.bound
    add_b, value_b, weighted_b, adj_b, bound_b = b.add, b.value, b.weighted, b.adj_weight, b.bound

    @wp.struct
    class Both:
        a: A
        b: B

    @wp.func
    def add(state: Both, weight: real, t: real, dt: real) -> Both:
        out = Both()
        out.a = add_a(state.a, weight, t, dt)
        out.b = add_b(state.b, weight, t, dt)
        return out

    @wp.func
    def value(state: Both) -> real:
        return value_a(state.a) + value_b(state.b)

    @wp.func
    def weighted(state: Both) -> real:
        return weighted_a(state.a) + weighted_b(state.b)

    @wp.func
    def of_weight(total: Both, before: Both, weight: real, t: real, dt: real) -> real:
        return adj_a(total.a, before.a, weight, t, dt) + adj_b(total.b, before.b, weight, t, dt)

    @wp.func
    def bound(total: Both, t_end: real) -> real:
        return bound_a(total.a, t_end) + bound_b(total.b, t_end)

    return RayLoss(Both, add, value, weighted, of_weight, bound)
