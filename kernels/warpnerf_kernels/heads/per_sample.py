"""An MLP per sample on its features and the encoded direction of view, as in DVGO.

    direct:     c = sigmoid(MLP(f, encoded direction))
    residual:   c = sigmoid(f[:3] + MLP(f[3:], encoded direction))

Source: Sun, Sun & Chen 2022, section 4. Only samples of more weight than a threshold have a colour.
What of the first layer sees only the direction is computed once a ray. The MLP's gradient is
summed over samples, each of which is scaled by its distance before.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.activation import adj_sigmoid, sigmoid
from ..base.parts import Head
from ..base.simd import LANES
from ..base.types import vec3, vector
from ..networks.mlp import Layout, Weights, mlp
from . import rgb as plain
from . import view as views

wp.set_module_options({"enable_backward": False})


def layout_of(
    n_features: int, n_frequencies: int, width: int, n_hidden: int, residual: bool
) -> Layout:
    """The MLP's shape: features that it sees are a row's own inputs, the direction is shared."""
    own = n_features - 3 if residual else n_features
    return Layout(own, views.n_encoded(n_frequencies), width, n_hidden)


PREPARE_ROW = (
    views.ENCODE
    + r"""
auto& own = rows.data[row];
const float* w = weights.values.data;
encode_direction(own.ray.direction, FREQUENCIES, (float*)&own.encoded);
for (int u = 0; u < WIDTH; u += LANES) {
    vec sum = at(w + AT_BIASES + u);
    for (int n = 0; n < N_VIEW; ++n) {
        sum = fma(splat(own.encoded.c[n]), at(w + (INPUTS + n) * WIDTH + u), sum);
    }
    put((float*)&own.view + u, sum);
    put((float*)&own.adj_view + u, splat(0.0f));
}
"""
)

ADJ_PREPARE_ROW = r"""
const auto& own = rows.data[row];
float* g = gradient.weights.data + (size_t)worker * gradient.weights.shape[1];
for (int u = 0; u < WIDTH; u += LANES) {
    const vec adj = at((const float*)&own.adj_view + u);
    put(g + AT_BIASES + u, at(g + AT_BIASES + u) + adj);
    for (int n = 0; n < N_VIEW; ++n) {
        float* to = g + (INPUTS + n) * WIDTH + u;
        put(to, fma(splat(own.encoded.c[n]), adj, at(to)));
    }
}
"""

ROWS_OF_PACKS = r"""
// Samples that get a colour are put side by side: a row of the MLP is a lane of one of n packs, and
// keeps its hidden units with that pack.
struct Place { int pack, lane, kept; };
Place place[N_PACKS * LANES];
int n_rows = 0;
for (int p = 0; p < n; ++p) {
    int kept = 0;
    each(bits(load(packs.data[slot + p].weight) > WEIGHT_MIN), [&](int lane) {
        place[n_rows++] = {slot + p, lane, kept++};
    });
}
auto x_of = [&](int r) {
    return (const float*)&packs.data[place[r].pack].by_sample.data[place[r].lane] + 1 + SKIPPED;
};
auto h_of = [&](int r) { return (float*)&packs.data[place[r].pack].hidden.data[place[r].kept]; };
"""

DECODE_PACK = (
    ROWS_OF_PACKS
    + r"""
const auto* view = (const float*)&rows.data[row].view;
float y[N_PACKS * LANES][OUTPUTS];
forward(n_rows, params.values.data, x_of, [&](int) { return view; }, h_of,
        [&](int r) { return y[r]; });
int r = 0;
for (int p = slot; p < slot + n; ++p) {
    auto& pack = packs.data[p];
    float by_lane[3][LANES] = {};
    const ivec colored = load(pack.weight) > WEIGHT_MIN;
    for (; r < n_rows && place[r].pack == p; ++r) {
        for (int c = 0; c < 3; ++c) by_lane[c][place[r].lane] = y[r][c];
    }
    for (int c = 0; c < 3; ++c) {
        const vec logit = at(by_lane[c]) + (RESIDUAL ? load(pack.raw.data[1 + c]) : splat(0.0f));
        store(pack.channel.data[c], colored ? sigmoid(logit) : splat(0.0f));
    }
}
"""
)

ADJ_DECODE_PACK = (
    ROWS_OF_PACKS
    + r"""
auto& own = rows.data[row];
float adj_y[N_PACKS * LANES][OUTPUTS], adj_x[N_PACKS * LANES][PADDED];
int r = 0;
for (int p = slot; p < slot + n; ++p) {
    auto& pack = packs.data[p];
    const vec share = load(pack.scale) * load(pack.weight);
    float by_lane[3][LANES];
    for (int c = 0; c < 3; ++c) {
        const vec channel = load(pack.channel.data[c]);  // 0 where there is no colour
        const vec adj = channel * (1.0f - channel) * (share * ADJ_CHANNEL);
        put(by_lane[c], adj);
        if (RESIDUAL) store(pack.adj_raw.data[1 + c], adj);
    }
    for (; r < n_rows && place[r].pack == p; ++r) {
        for (int c = 0; c < 3; ++c) adj_y[r][c] = by_lane[c][place[r].lane];
        adj_y[r][3] = 0.0f;
    }
    for (int c = SKIPPED; c < 3; ++c) store(pack.adj_raw.data[1 + c], splat(0.0f));
    each(bits(load_int(pack.active)), [&](int lane) {
        auto& adj_of_sample = pack.adj_by_sample.data[lane];
        __builtin_memset(&adj_of_sample, 0, sizeof(adj_of_sample));
    });
}
const size_t n_transposed = params.transposed.shape[1], n_weights = gradient.weights.shape[1];
backward(n_rows, params.transposed.data + (size_t)worker * n_transposed,
         gradient.weights.data + (size_t)worker * n_weights, x_of, h_of,
         [&](int r) { return (const float*)adj_y[r]; }, [&](int r) { return adj_x[r]; },
         (float*)&own.adj_view);
for (r = 0; r < n_rows; ++r) {
    auto& pack = packs.data[place[r].pack];
    const int lane = place[r].lane;
    float* adj = (float*)&pack.adj_by_sample.data[lane] + 1 + SKIPPED;
    __builtin_memcpy(adj, adj_x[r], INPUTS * sizeof(float));
    for (int c = SKIPPED; c < 3 && c < INPUTS; ++c) pack.adj_raw.data[1 + c][lane] = adj_x[r][c];
}
"""
)

N_PACKS = 8
"""Packs of a ray whose samples go through the MLP together."""


@cache
def per_sample(
    n_features: int,
    n_frequencies: int,
    width: int,
    n_hidden: int,
    residual: bool,
    weight_min: float,
) -> Head:
    """The head of samples.

    Args:
        n_features: Of a node.
        n_frequencies: Of the encoded direction of view.
        width: Units of a hidden layer, a multiple of 16.
        n_hidden: Hidden layers.
        residual: Whether the first three features are colour, to which the MLP adds.
        weight_min: Samples of no more weight get no colour.
    """
    layout = layout_of(n_features, n_frequencies, width, n_hidden, residual)
    network = mlp(layout)
    encode = views.encoding(n_frequencies)
    first, adj_first = network.first, network.adj_first
    add_inputs, adj_add_inputs = network.add_inputs, network.adj_add_inputs
    outputs, adj_outputs = network.outputs, network.adj_outputs
    n_own = layout.n_own
    skipped = 3 if residual else 0
    Own = vector(n_own)
    Units = vector(width)

    @wp.func
    def prepare(weights: Weights, direction: vec3) -> Units:
        """The first layer's biases, and what the direction adds to them."""
        return add_inputs(weights, n_own, encode(direction), first(weights))

    @wp.func
    def adj_prepare(weights: Weights, direction: vec3, adj_view: Units, gradient: Any):
        adj_add_inputs(weights, n_own, encode(direction), adj_view, gradient)
        adj_first(weights, adj_view, gradient)

    @wp.func
    def own_inputs(raw: Any) -> Own:
        x = Own()
        for i in range(n_own):
            x[i] = raw[1 + skipped + i]
        return x

    @wp.func
    def decode(weights: Weights, view: Units, raw: Any) -> vec3:
        """Colour of a sample from the view's direction."""
        y = outputs(weights, add_inputs(weights, 0, own_inputs(raw), view))
        if wp.static(residual):
            y += vec3(raw[1], raw[2], raw[3])
        return sigmoid(y)

    @wp.func
    def adj_decode(
        weights: Weights,
        view: Units,
        raw: Any,
        channels: vec3,
        adj_channels: vec3,
        gradient: Any,
    ):
        adj_y = adj_sigmoid(channels, adj_channels)
        x = own_inputs(raw)
        adj_view = adj_outputs(weights, add_inputs(weights, 0, x, view), adj_y, gradient)
        adj_x = adj_add_inputs(weights, 0, x, adj_view, gradient)
        adj_raw = raw - raw
        if wp.static(residual):
            for c in range(3):
                adj_raw[1 + c] = adj_y[c]
        for i in range(n_own):
            adj_raw[1 + skipped + i] = adj_x[i]
        return adj_raw, adj_view

    prelude = network.prelude + (
        f"constexpr int N_VIEW = {layout.n_shared}, SKIPPED = {skipped}, N_PACKS = {N_PACKS},"
        f" FREQUENCIES = {n_frequencies};"
        f"constexpr bool RESIDUAL = {str(residual).lower()};"
        f"constexpr float WEIGHT_MIN = {weight_min!r}f;"
    )

    decode_pack, adj_decode_pack = plain.decoding(prelude + DECODE_PACK, prelude + ADJ_DECODE_PACK)

    @wp.func_native(prelude + PREPARE_ROW)
    def prepare_row(weights: Weights, rows: wp.array(dtype=Any), row: int): ...

    @wp.func_native(prelude + ADJ_PREPARE_ROW)
    def adj_prepare_row(
        weights: Weights, rows: wp.array(dtype=Any), row: int, worker: int, gradient: Any
    ): ...

    units = wp.types.vector(width, wp.float32)
    head = plain.rgb()
    return head.replace(
        Params=Weights,
        ViewFeatures=Units,
        prepare=prepare,
        adj_prepare=adj_prepare,
        decode=decode,
        adj_decode=adj_decode,
        weight_min=weight_min,
        vectors=head.vectors._replace(
            begin_rows=network.begin_rows,
            prepare_row=prepare_row,
            adj_prepare_row=adj_prepare_row,
            decode_pack=decode_pack,
            adj_decode_pack=adj_decode_pack,
            pack_fields=(("hidden", wp.types.matrix((LANES, layout.units), wp.float32)),),
            row_fields=(
                ("view", units),
                ("adj_view", units),
                ("encoded", wp.types.vector(layout.n_shared, wp.float32)),
            ),
            n_packs=N_PACKS,
        ),
    )
