"""The head without parameters: each channel is the sigmoid of one raw feature."""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from ..base.activation import adj_sigmoid, sigmoid
from ..base.parts import Head, HeadVectors
from ..base.simd import VECTORS
from ..base.types import Nothing, real, vec3, vector

wp.set_module_options({"enable_backward": False})


@wp.func
def no_view(params: Any, direction: vec3):
    """One zero: colour does not depend on the direction of view."""
    return vector_1(real(0.0))


vector_1 = vector(1)


@wp.func
def adj_no_view(params: Any, direction: vec3, adj_view: Any, gradient: Any):
    """Nothing flows back."""


@cache
def decode_of(n_channels: int) -> tuple[wp.Function, wp.Function]:
    """decode and adj_decode for so many channels."""
    Channels = vector(n_channels)

    @wp.func
    def decode(params: Any, view: Any, raw: Any) -> Channels:
        channels = Channels()
        for c in range(n_channels):
            channels[c] = raw[1 + c]
        return sigmoid(channels)

    @wp.func
    def adj_decode(
        params: Any, view: Any, raw: Any, channels: Channels, adj_channels: Channels, gradient: Any
    ):
        adj = adj_sigmoid(channels, adj_channels)
        adj_raw = raw * real(0.0)
        for c in range(n_channels):
            adj_raw[1 + c] = adj[c]
        return adj_raw, view - view

    return decode, adj_decode


OF_RAY, OF_SAMPLE = "rows.data[row].adj.channels.c[c]", "load(pack.adj_channel.data[c])"
"""What flows back to channel c of a sample: as to the ray's, or to each sample its own."""


def decoding(decode: str, adj_decode: str) -> tuple[wp.Function, Callable[[bool], wp.Function]]:
    """decode_pack and adj_decode_pack of a head's vector form, see base.parts.HeadVectors.

    Args:
        decode: C++ of the former.
        adj_decode: Of the latter; what it calls ADJ_CHANNEL flows back to a sample's channel c.
    """

    @wp.func_native(decode)
    def decode_pack(
        params: Any,
        rows: wp.array(dtype=Any),
        row: int,
        packs: wp.array(dtype=Any),
        slot: int,
        n: int,
    ): ...

    @cache
    def adj_decode_pack(by_sample: bool) -> wp.Function:
        @wp.func_native(adj_decode.replace("ADJ_CHANNEL", OF_SAMPLE if by_sample else OF_RAY))
        def adj_decode_packs(
            params: Any,
            rows: wp.array(dtype=Any),
            row: int,
            packs: wp.array(dtype=Any),
            slot: int,
            n: int,
            worker: int,
            gradient: Any,
        ): ...

        return adj_decode_packs

    return decode_pack, adj_decode_pack


DECODE_PACK = (
    VECTORS
    + r"""
auto& pack = packs.data[slot];
constexpr int CHANNELS = sizeof(pack.channel) / sizeof(vec);
#pragma clang loop unroll(full)
for (int c = 0; c < CHANNELS; ++c) {
    store(pack.channel.data[c], sigmoid(load(pack.raw.data[1 + c])));
}
"""
)

ADJ_DECODE_PACK = (
    VECTORS
    + r"""
auto& pack = packs.data[slot];
constexpr int CHANNELS = sizeof(pack.channel) / sizeof(vec);
constexpr int FLOATS = sizeof(pack.raw) / sizeof(vec);
const vec weight = load(pack.weight), scale = load(pack.scale);
#pragma clang loop unroll(full)
for (int c = 0; c < CHANNELS; ++c) {
    const vec channel = load(pack.channel.data[c]);
    const vec adj_channel = scale * (weight * ADJ_CHANNEL);
    store(pack.adj_raw.data[1 + c], channel * (1.0f - channel) * adj_channel);
}
for (int f = 1 + CHANNELS; f < FLOATS; ++f) store(pack.adj_raw.data[f], splat(0.0f));
"""
)


@wp.func
def shade(params: Any, direction: vec3, channels: vec3, opacity: real) -> vec3:
    """The accumulated channels are the colour."""
    return channels


@wp.func
def adj_shade(
    params: Any, direction: vec3, channels: vec3, opacity: real, adj_rgb: vec3, gradient: Any
):
    """Transpose of shade."""
    return adj_rgb, real(0.0)


@wp.func
def shade_rows(params: Any, rows: wp.array(dtype=Any), row: int, n: int):
    """shade for the rays of a batch."""
    for r in range(row, row + n):
        rows[r].rgb = rows[r].channels


@wp.func
def adj_shade_rows(
    params: Any, rows: wp.array(dtype=Any), row: int, n: int, worker: int, gradient: Any
):
    """adj_shade for the rays of a batch."""
    for r in range(row, row + n):
        rows[r].adj.channels = rows[r].adj_rgb
        rows[r].adj_opacity = real(0.0)


@wp.func
def begin_rows(params: Any, worker: int):
    """The head has no parameters to prepare."""


@wp.func
def prepare_row(params: Any, rows: wp.array(dtype=Any), row: int):
    """The view is not looked at."""


@wp.func
def adj_prepare_row(params: Any, rows: wp.array(dtype=Any), row: int, worker: int, gradient: Any):
    """Nothing flows back."""


@cache
def rgb() -> Head:
    """Density and r, g, b: colour that is the same from all sides."""
    decode, adj_decode = decode_of(3)
    decode_pack, adj_decode_pack = decoding(DECODE_PACK, ADJ_DECODE_PACK)
    return Head(
        n_channels=3,
        Params=Nothing,
        ViewFeatures=vector(1),
        prepare=no_view,
        adj_prepare=adj_no_view,
        decode=decode,
        adj_decode=adj_decode,
        shade=shade,
        adj_shade=adj_shade,
        vectors=HeadVectors(
            begin_rows=begin_rows,
            prepare_row=prepare_row,
            adj_prepare_row=adj_prepare_row,
            decode_pack=decode_pack,
            adj_decode_pack=adj_decode_pack,
            shade_rows=shade_rows,
            adj_shade_rows=adj_shade_rows,
        ),
    )
