"""Deferred shading: features are composited along the ray like colours, and shaded once a ray.

    F = sum_i w_i sigmoid(f_i)                        3 diffuse and K specular channels
    rgb = F_diffuse + opacity MLP(F, encoded direction)

After SNeRG (Hedman et al. 2021). The MLP's weights belong to no sample, so the distance scaling
leaves their gradient alone.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Head
from ..base.types import real, vec3, vector
from ..networks.mlp import Layout, Weights, mlp
from . import rgb as plain
from . import view as views

wp.set_module_options({"enable_backward": False})

BATCH = 16
"""Rays whose rows go through the MLP together."""


def layout_of(n_channels: int, n_frequencies: int, width: int, n_hidden: int) -> Layout:
    """The MLP's shape: it sees all channels and the encoded direction."""
    return Layout(n_channels + views.n_encoded(n_frequencies), 0, width, n_hidden)


PREPARE_ROW = (
    views.ENCODE
    + r"""
auto& own = rows.data[row];
encode_direction(own.ray.direction, FREQUENCIES, (float*)&own.inputs + CHANNELS);
"""
)

SHADE_ROWS = r"""
auto* batch = rows.data + row;
const float* w = weights.values.data;
for (int r = 0; r < n; ++r) {
    for (int c = 0; c < CHANNELS; ++c) batch[r].inputs.c[c] = batch[r].channels.c[c];
}
forward(n, w, [&](int r) { return (const float*)&batch[r].inputs; },
        [&](int) { return w + AT_BIASES; }, [&](int r) { return (float*)&batch[r].hidden; },
        [&](int r) { return (float*)&batch[r].specular; });
for (int r = 0; r < n; ++r) {
    const float opacity = 1.0f - batch[r].transmittance;
    for (int c = 0; c < 3; ++c) {
        batch[r].rgb.c[c] = batch[r].channels.c[c] + opacity * batch[r].specular.c[c];
    }
}
"""

ADJ_SHADE_ROWS = r"""
auto* batch = rows.data + row;
const size_t n_transposed = weights.transposed.shape[1], n_weights = gradient.weights.shape[1];
float* g = gradient.weights.data + (size_t)worker * n_weights;
for (int r = 0; r < n; ++r) {
    const float opacity = 1.0f - batch[r].transmittance;
    float adj_opacity = 0.0f;
    for (int c = 0; c < 3; ++c) {
        adj_opacity += batch[r].adj_rgb.c[c] * batch[r].specular.c[c];
        batch[r].specular.c[c] = opacity * batch[r].adj_rgb.c[c];
    }
    batch[r].specular.c[3] = 0.0f;
    batch[r].adj_opacity = adj_opacity;
}
backward(n, weights.transposed.data + (size_t)worker * n_transposed, g,
         [&](int r) { return (const float*)&batch[r].inputs; },
         [&](int r) { return (const float*)&batch[r].hidden; },
         [&](int r) { return (const float*)&batch[r].specular; },
         [&](int r) { return (float*)&batch[r].adj_inputs; }, g + AT_BIASES);
for (int r = 0; r < n; ++r) {
    for (int c = 0; c < CHANNELS; ++c) {
        const float diffuse = c < 3 ? batch[r].adj_rgb.c[c] : 0.0f;
        batch[r].adj.channels.c[c] = batch[r].adj_inputs.c[c] + diffuse;
    }
}
"""


@cache
def deferred(n_channels: int, n_frequencies: int, width: int, n_hidden: int) -> Head:
    """The head of rays.

    Args:
        n_channels: 3 diffuse ones and the specular ones.
        n_frequencies: Of the encoded direction of view.
        width: Units of a hidden layer, a multiple of 16.
        n_hidden: Hidden layers.
    """
    layout = layout_of(n_channels, n_frequencies, width, n_hidden)
    network = mlp(layout)
    encode = views.encoding(n_frequencies)
    first, adj_first = network.first, network.adj_first
    add_inputs, adj_add_inputs = network.add_inputs, network.adj_add_inputs
    outputs, adj_outputs = network.outputs, network.adj_outputs
    prelude = network.prelude + (
        f"constexpr int CHANNELS = {n_channels}, FREQUENCIES = {n_frequencies};"
    )
    Channels = vector(n_channels)
    Encoded = vector(views.n_encoded(n_frequencies))

    @wp.func
    def begin(weights: Weights, encoded: Encoded, channels: Channels):
        """The first layer before ReLU."""
        units = add_inputs(weights, 0, channels, first(weights))
        return add_inputs(weights, n_channels, encoded, units)

    @wp.func
    def shade(weights: Weights, direction: vec3, channels: Channels, opacity: real) -> vec3:
        """Diffuse colour and what the MLP adds for this direction."""
        units = begin(weights, encode(direction), channels)
        return vec3(channels[0], channels[1], channels[2]) + opacity * outputs(weights, units)

    @wp.func
    def adj_shade(
        weights: Weights,
        direction: vec3,
        channels: Channels,
        opacity: real,
        adj_rgb: vec3,
        gradient: Any,
    ):
        encoded = encode(direction)
        units = begin(weights, encoded, channels)
        adj_opacity = wp.dot(adj_rgb, outputs(weights, units))
        adj_units = adj_outputs(weights, units, opacity * adj_rgb, gradient)
        adj_first(weights, adj_units, gradient)
        adj_channels = adj_add_inputs(weights, 0, channels, adj_units, gradient)
        adj_add_inputs(weights, n_channels, encoded, adj_units, gradient)
        for c in range(3):
            adj_channels[c] += adj_rgb[c]
        return adj_channels, adj_opacity

    @wp.func_native(prelude + PREPARE_ROW)
    def prepare_row(weights: Weights, rows: wp.array(dtype=Any), row: int): ...

    @wp.func_native(prelude + SHADE_ROWS)
    def shade_rows(weights: Weights, rows: wp.array(dtype=Any), row: int, n: int): ...

    @wp.func_native(prelude + ADJ_SHADE_ROWS)
    def adj_shade_rows(
        weights: Weights,
        rows: wp.array(dtype=Any),
        row: int,
        n: int,
        worker: int,
        gradient: Any,
    ): ...

    decode, adj_decode = plain.decode_of(n_channels)
    padded = wp.types.vector(layout.n_padded, wp.float32)
    head = plain.rgb()
    return head.replace(
        n_channels=n_channels,
        Params=Weights,
        decode=decode,
        adj_decode=adj_decode,
        shade=shade,
        adj_shade=adj_shade,
        vectors=head.vectors._replace(
            begin_rows=network.begin_rows,
            prepare_row=prepare_row,
            shade_rows=shade_rows,
            adj_shade_rows=adj_shade_rows,
            row_fields=(
                ("inputs", padded),
                ("adj_inputs", padded),
                ("hidden", wp.types.vector(layout.units, wp.float32)),
                ("specular", wp.types.vector(4, wp.float32)),  # and, on the way back, its adjoint
            ),
            batch=BATCH,
        ),
    )
