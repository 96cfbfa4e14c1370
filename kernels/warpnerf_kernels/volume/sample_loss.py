"""Losses on the colours of a ray's samples: none, and the vector form of those that have none.

Those of the package are in losses/, a file each.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import SampleLoss, SampleLossVectors
from ..base.simd import LANES
from ..base.types import Nothing, real, vec3

wp.set_module_options({"enable_backward": False})


@wp.func
def add_nothing(
    params: Any, state: Nothing, weight: real, channels: Any, target_rgb: vec3
) -> Nothing:
    """There are no sums."""
    return state


@wp.func
def no_value(params: Any, state: Nothing, channels: Any, target_rgb: vec3) -> real:
    """Value of no loss."""
    return real(0.0)


NO_SAMPLE_LOSS = SampleLoss(
    Params=Nothing, State=Nothing, add=add_nothing, value=no_value, adj_channels=None
)
"""The loss that is 0."""


@cache
def lanes_form(loss: SampleLoss, n_channels: int) -> SampleLossVectors:
    """A loss's vector form, or the scalar functions called for each sample of a pack in turn."""
    if loss.vectors is not None:
        return loss.vectors
    Params, State, add, adj_channels = loss.Params, loss.State, loss.add, loss.adj_channels
    Channels = wp.types.vector(n_channels, wp.float32)
    OfLanes = wp.types.matrix((n_channels, LANES), wp.float32)

    @wp.func
    def channels_of(packs: wp.array(dtype=Any), slot: int, lane: int) -> Channels:
        channels = Channels()
        for c in range(n_channels):
            channels[c] = packs[slot].channel[c, lane]
        return channels

    @wp.func
    def add_pack(
        params: Params, state: State, target_rgb: vec3, packs: wp.array(dtype=Any), slot: int
    ) -> State:
        """The sums with the samples of a pack."""
        after = state
        for lane in range(LANES):
            weight = packs[slot].colour_weight[lane]
            if weight > 0.0:
                channels = channels_of(packs, slot, lane)
                after = add(params, after, weight, channels, target_rgb)
        return after

    @wp.func
    def adj_add_pack(
        params: Params,
        adj_value: wp.float32,
        target_rgb: vec3,
        packs: wp.array(dtype=Any),
        slot: int,
    ):
        """What flows back to the channels of a pack's samples, besides what the ray's do."""
        adj = OfLanes()
        for lane in range(LANES):
            if packs[slot].active[lane] != 0:
                channels = channels_of(packs, slot, lane)
                own = adj_channels(params, channels, target_rgb, adj_value)
                for c in range(n_channels):
                    adj[c, lane] = own[c]
        packs[slot].adj_channel = packs[slot].adj_channel + adj

    return SampleLossVectors(add_pack, adj_add_pack)
