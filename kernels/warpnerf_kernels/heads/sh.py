"""Spherical harmonics per node: view-dependent colour without an MLP.

c = sigmoid(sum_k Y_k(d) f_k),   f_k = raw features 3k, 3k + 1, 3k + 2 (red, green, blue)
"""

import math
from functools import cache
from typing import Any

import warp as wp

from ..base.activation import adj_sigmoid, sigmoid
from ..base.parts import Head
from ..base.simd import VECTORS
from ..base.types import real, vec3, vector
from . import rgb as plain

wp.set_module_options({"enable_backward": False})

Y0 = 0.5 / math.sqrt(math.pi)
Y1 = math.sqrt(3.0 / (4.0 * math.pi))
Y2 = math.sqrt(15.0 / (4.0 * math.pi))
Y2_2 = 0.5 * Y2
Y2_0 = 0.25 * math.sqrt(5.0 / math.pi)
Y3_0 = 0.25 * math.sqrt(7.0 / math.pi)
Y3_1 = 0.25 * math.sqrt(21.0 / (2.0 * math.pi))
Y3_2 = 0.5 * math.sqrt(105.0 / math.pi)
Y3_2_2 = 0.5 * Y3_2
Y3_3 = 0.25 * math.sqrt(35.0 / (2.0 * math.pi))


@cache
def basis(degree: int) -> wp.Function:
    """The real spherical harmonics up to a degree, (degree + 1)^2 of them, of a unit vector.

    Condon-Shortley phase included, m from -l to l: the order and signs of PlenOctrees (Yu et al.
    2021), and of what 3D Gaussian splats are stored with.
    """
    n = (degree + 1) ** 2
    Basis = vector(n)

    @wp.func
    def harmonics(params: Any, direction: vec3) -> Basis:
        x = direction[0]
        y = direction[1]
        z = direction[2]
        out = Basis()
        out[0] = real(Y0)
        if wp.static(degree > 0):
            out[1] = -real(Y1) * y
            out[2] = real(Y1) * z
            out[3] = -real(Y1) * x
        if wp.static(degree > 1):
            out[4] = real(Y2) * x * y
            out[5] = -real(Y2) * y * z
            out[6] = real(Y2_0) * (real(2.0) * z * z - x * x - y * y)
            out[7] = -real(Y2) * x * z
            out[8] = real(Y2_2) * (x * x - y * y)
        if wp.static(degree > 2):
            out[9] = -real(Y3_3) * y * (real(3.0) * x * x - y * y)
            out[10] = real(Y3_2) * x * y * z
            out[11] = -real(Y3_1) * y * (real(4.0) * z * z - x * x - y * y)
            out[12] = real(Y3_0) * z * (real(2.0) * z * z - real(3.0) * (x * x + y * y))
            out[13] = -real(Y3_1) * x * (real(4.0) * z * z - x * x - y * y)
            out[14] = real(Y3_2_2) * z * (x * x - y * y)
            out[15] = -real(Y3_3) * x * (x * x - real(3.0) * y * y)
        return out

    return harmonics


@wp.func
def decode(params: Any, view: Any, raw: Any) -> vec3:
    """Colour of a sample from one direction."""
    total = vec3()
    for k in range(len(view)):
        total += view[k] * vec3(raw[1 + 3 * k], raw[2 + 3 * k], raw[3 + 3 * k])
    return sigmoid(total)


@wp.func
def adj_decode(params: Any, view: Any, raw: Any, channels: vec3, adj_channels: vec3, gradient: Any):
    """Transpose of decode; directions are constants."""
    adj = adj_sigmoid(channels, adj_channels)
    adj_raw = raw * real(0.0)
    for k in range(len(view)):
        for c in range(3):
            adj_raw[1 + 3 * k + c] = view[k] * adj[c]
    return adj_raw, view - view


DECODE_PACK = (
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const auto& view = rows.data[row].view;
constexpr int BASIS = sizeof(view) / sizeof(float);
vec total[3] = {splat(0.0f), splat(0.0f), splat(0.0f)};
for (int k = 0; k < BASIS; ++k) {
    for (int c = 0; c < 3; ++c) {
        total[c] = fma(splat(view.c[k]), load(pack.raw.data[1 + 3 * k + c]), total[c]);
    }
}
for (int c = 0; c < 3; ++c) store(pack.channel.data[c], sigmoid(total[c]));
"""
)

ADJ_DECODE_PACK = (
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const auto& view = rows.data[row].view;
constexpr int BASIS = sizeof(view) / sizeof(float);
constexpr int FLOATS = sizeof(pack.raw) / sizeof(vec);
const vec share = load(pack.scale) * load(pack.weight);
for (int c = 0; c < 3; ++c) {
    const vec channel = load(pack.channel.data[c]);
    const vec adj = channel * (1.0f - channel) * (share * ADJ_CHANNEL);
    for (int k = 0; k < BASIS; ++k) store(pack.adj_raw.data[1 + 3 * k + c], view.c[k] * adj);
}
for (int f = 1 + 3 * BASIS; f < FLOATS; ++f) store(pack.adj_raw.data[f], splat(0.0f));
"""
)


@cache
def sh(degree: int) -> Head:
    """Spherical harmonics of a degree from 0 to 3, 3 (degree + 1)^2 features."""
    ViewFeatures = vector((degree + 1) ** 2)
    harmonics = basis(degree)
    decode_pack, adj_decode_pack = plain.decoding(DECODE_PACK, ADJ_DECODE_PACK)

    @wp.func
    def prepare_row(params: Any, rows: wp.array(dtype=Any), row: int):
        rows[row].view = harmonics(params, rows[row].ray.direction)

    head = plain.rgb()
    return head.replace(
        ViewFeatures=ViewFeatures,
        prepare=harmonics,
        decode=decode,
        adj_decode=adj_decode,
        vectors=head.vectors._replace(
            prepare_row=prepare_row,
            decode_pack=decode_pack,
            adj_decode_pack=adj_decode_pack,
            row_fields=(("view", ViewFeatures),),
        ),
    )
