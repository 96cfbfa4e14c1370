"""Losses over the samples of a ray, besides that of its colour: none, and several as one.

Those of the package are in losses/, a file each.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import RayLoss, RayLossVectors
from ..base.simd import LANES, lanes
from ..base.types import Nothing, real

wp.set_module_options({"enable_backward": False})


@wp.func
def add_nothing(
    params: Any, state: Nothing, weight: real, t: real, dt: real, raw_density: real
) -> Nothing:
    """Of a loss without sums: none changes."""
    return state


@wp.func
def no_value(params: Any, state: Nothing, transmittance: real) -> real:
    """Value of no loss."""
    return real(0.0)


@wp.func
def no_weighted(params: Any, state: Any) -> real:
    """Sum over samples of weight times dL/dweight, for a loss that does not look at weights."""
    return real(0.0)


@wp.func
def no_adj_weight(params: Any, total: Any, before: Any, weight: real, t: real, dt: real) -> real:
    """Derivative by a weight, of such a loss."""
    return real(0.0)


@wp.func
def no_bound(params: Any, total: Any, t_end: real) -> real:
    """Bound of that derivative."""
    return real(0.0)


@wp.func
def no_adj_transmittance(params: Any, transmittance: real) -> real:
    """Derivative by the light that passes all samples, of a loss that does not look at it."""
    return real(0.0)


@wp.func
def no_adj_density(params: Any, t: real) -> real:
    """Derivative by a raw density, of a loss that looks at weights only."""
    return real(0.0)


@wp.func
def add_no_pack(params: Any, state: Nothing, packs: wp.array(dtype=Any), slot: int) -> Nothing:
    """Of a loss without sums: samples do not count."""
    return state


@wp.func
def adj_add_no_pack(
    params: Any,
    total: Nothing,
    before: Nothing,
    adj_value: wp.float32,
    packs: wp.array(dtype=Any),
    slot: int,
) -> Nothing:
    """Nor does anything flow back to their weights."""
    return before


OF_LIGHT_ONLY = RayLossVectors(add_no_pack, adj_add_no_pack)
"""The vector form of losses that look at nothing but the light that passes all samples."""

NONE = RayLoss(
    Params=Nothing,
    State=Nothing,
    add=add_nothing,
    value=no_value,
    weighted=no_weighted,
    adj_weight=no_adj_weight,
    bound=no_bound,
)
"""The loss that is 0."""


@cache
def vector_form(loss: RayLoss) -> RayLossVectors:
    """A loss's vector form, or the scalar functions called for each sample of a pack in turn."""
    if loss.vectors is not None:
        return loss.vectors
    Params, State = loss.Params, loss.State
    add, adj_weight, adj_density = loss.add, loss.adj_weight, loss.adj_density
    of_density = adj_density is not None

    @wp.func
    def add_pack(params: Params, state: State, packs: wp.array(dtype=Any), slot: int) -> State:
        """The sums with the samples of a pack."""
        after = state
        for lane in range(LANES):
            if packs[slot].active[lane] != 0:
                weight, t, dt = (
                    packs[slot].weight[lane],
                    packs[slot].t[lane],
                    packs[slot].length[lane],
                )
                after = add(params, after, weight, t, dt, packs[slot].raw[0, lane])
        return after

    @wp.func
    def adj_add_pack(
        params: Params,
        total: State,
        before: State,
        adj_value: wp.float32,
        packs: wp.array(dtype=Any),
        slot: int,
    ) -> State:
        """What the loss adds to the slopes of a pack's weights; the sums with its samples."""
        after = before
        adj, adj_raw = lanes(), lanes()
        for lane in range(LANES):
            if packs[slot].active[lane] != 0:
                weight, t, dt = (
                    packs[slot].weight[lane],
                    packs[slot].t[lane],
                    packs[slot].length[lane],
                )
                adj[lane] = adj_value * adj_weight(params, total, after, weight, t, dt)
                if wp.static(of_density):
                    adj_raw[lane] = adj_value * adj_density(params, t)
                after = add(params, after, weight, t, dt, packs[slot].raw[0, lane])
        packs[slot].adj_weight = packs[slot].adj_weight + adj
        if wp.static(of_density):
            packs[slot].adj_density = packs[slot].adj_density + adj_raw
        return after

    return RayLossVectors(add_pack, adj_add_pack)


@cache
def sum_of(a: RayLoss, b: RayLoss) -> RayLoss:
    """Two losses as one. They are composed when kernels are compiled."""
    ParamsA, ParamsB, StateA, StateB = a.Params, b.Params, a.State, b.State
    add_a, value_a, weighted_a, adj_a, bound_a = a.add, a.value, a.weighted, a.adj_weight, a.bound
    add_b, value_b, weighted_b, adj_b, bound_b = b.add, b.value, b.weighted, b.adj_weight, b.bound
    adj_light_a = a.adj_transmittance or no_adj_transmittance
    adj_light_b = b.adj_transmittance or no_adj_transmittance
    adj_density_a, adj_density_b = a.adj_density or no_adj_density, b.adj_density or no_adj_density
    vectors_a, vectors_b = vector_form(a), vector_form(b)
    add_pack_a, add_pack_b = vectors_a.add_pack, vectors_b.add_pack
    adj_pack_a, adj_pack_b = vectors_a.adj_add_pack, vectors_b.adj_add_pack

    @wp.struct
    class Params:
        a: ParamsA
        b: ParamsB

    @wp.struct
    class Both:
        a: StateA
        b: StateB

    @wp.func
    def add(
        params: Params, state: Both, weight: real, t: real, dt: real, raw_density: real
    ) -> Both:
        out = Both()
        out.a = add_a(params.a, state.a, weight, t, dt, raw_density)
        out.b = add_b(params.b, state.b, weight, t, dt, raw_density)
        return out

    @wp.func
    def value(params: Params, state: Both, transmittance: real) -> real:
        return value_a(params.a, state.a, transmittance) + value_b(params.b, state.b, transmittance)

    @wp.func
    def weighted(params: Params, state: Both) -> real:
        return weighted_a(params.a, state.a) + weighted_b(params.b, state.b)

    @wp.func
    def of_weight(
        params: Params, total: Both, before: Both, weight: real, t: real, dt: real
    ) -> real:
        return adj_a(params.a, total.a, before.a, weight, t, dt) + adj_b(
            params.b, total.b, before.b, weight, t, dt
        )

    @wp.func
    def bound(params: Params, total: Both, t_end: real) -> real:
        return bound_a(params.a, total.a, t_end) + bound_b(params.b, total.b, t_end)

    @wp.func
    def of_transmittance(params: Params, transmittance: real) -> real:
        return adj_light_a(params.a, transmittance) + adj_light_b(params.b, transmittance)

    @wp.func
    def of_density(params: Params, t: real) -> real:
        return adj_density_a(params.a, t) + adj_density_b(params.b, t)

    @wp.func
    def add_pack(params: Params, state: Both, packs: wp.array(dtype=Any), slot: int) -> Both:
        out = Both()
        out.a = add_pack_a(params.a, state.a, packs, slot)
        out.b = add_pack_b(params.b, state.b, packs, slot)
        return out

    @wp.func
    def adj_add_pack(
        params: Params,
        total: Both,
        before: Both,
        adj_value: wp.float32,
        packs: wp.array(dtype=Any),
        slot: int,
    ) -> Both:
        out = Both()
        out.a = adj_pack_a(params.a, total.a, before.a, adj_value, packs, slot)
        out.b = adj_pack_b(params.b, total.b, before.b, adj_value, packs, slot)
        return out

    has_light = a.adj_transmittance is not None or b.adj_transmittance is not None
    has_density = a.adj_density is not None or b.adj_density is not None
    fields = dict([*vectors_a.pack_fields, *vectors_b.pack_fields])
    return RayLoss(
        Params,
        Both,
        add,
        value,
        weighted,
        of_weight,
        bound,
        of_transmittance if has_light else None,
        of_density if has_density else None,
        RayLossVectors(add_pack, adj_add_pack, tuple(fields.items())),
    )
