"""The vector form of a hash: what sixteen samples read, and how their gradients are scattered.

Places in a level are computed for sixteen samples at once, entries are read sample by sample,
level by level, and samples go through the matrices side by side. Units of a hidden layer stay in
the pack between the passes.

Workers own levels, in turns there and back, as fine ones take longer; where there are more workers
than levels, equal parts of one. What a pack has for levels of others goes into a record of places
and of what flows back to each entry's numbers. Gradients of matrices go to a worker's own copies.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..base.parts import EncodingVectors
from ..base.simd import LANES
from .decoder import (
    DECODER,
    TRANSPOSE_DECODER,
    VectorCode,
    decoded_vectors,
    padded,
    record_type,
)

wp.set_module_options({"enable_backward": False})

PRIME_X, PRIME_Y = 2654435761, 805459861
"""What a row's i and j are multiplied by, modulo 2^32; those of Instant-NGP for j and k."""

WORDS = DECODER + (
    r"""
typedef unsigned uvec __attribute__((ext_vector_type(LANES)));
typedef float entry_vec __attribute__((ext_vector_type(WIDTH)));
typedef float pair_vec __attribute__((ext_vector_type(2 * WIDTH)));  // of two nodes of a row
typedef float entry_at __attribute__((ext_vector_type(WIDTH), aligned(4), may_alias));
typedef float pair_at __attribute__((ext_vector_type(2 * WIDTH), aligned(4), may_alias));
const int n_active = params.n_active;

// Lane by lane: the lower entries of the four rows around, shares of these, position between the
// nodes of a row; bit n: lane n lies in the cell of the lane before.
struct Corners { int entry[4][LANES]; float shares[4][LANES], up[LANES]; unsigned stays; };
// Where the samples among lanes lie in a level.
auto corners_of = [&](const auto& samples, unsigned active, int number, Corners& corners) {
    const auto& level = params.levels.data[number];
    const vec c[3] = {load(samples.x), load(samples.y), load(samples.z)};
    ivec node[3];
    vec fraction[3];
    #pragma clang loop unroll(full)
    for (int axis = 0; axis < 3; ++axis) {
        const vec u = c[axis] * level.to_nodes.c[axis] + level.middle.c[axis];
        node[axis] = clamp(truncate(u), level.size.c[axis] - 1);
        fraction[axis] = u - to_float(node[axis]);
    }
    const ivec first = node[2] + level.begin;
    if (level.mask) {
        const uvec x = __builtin_convertvector(node[0], uvec) * X_PRIMEu;
        const uvec y = __builtin_convertvector(node[1], uvec) * Y_PRIMEu;
        auto row = [&](int n, uvec a, uvec b) {
            const uvec begin = (a ^ b) & level.mask;
            *(ivec_at*)corners.entry[n] = first + __builtin_convertvector(begin, ivec);
        };
        row(0, x, y);
        row(1, x, y + Y_PRIMEu);
        row(2, x + X_PRIMEu, y);
        row(3, x + X_PRIMEu, y + Y_PRIMEu);
    } else {
        const int of_y = level.size.c[2], of_x = level.size.c[1] * of_y;
        const ivec lowest = first + node[0] * of_x + node[1] * of_y;
        #pragma clang loop unroll(full)
        for (int n = 0; n < 4; ++n) {
            *(ivec_at*)corners.entry[n] = lowest + (n / 2 * of_x + n % 2 * of_y);
        }
    }
    split(fraction[0], fraction[1], corners.shares);
    put(corners.up, fraction[2]);
    ivec same = -1;
    #pragma clang loop unroll(full)
    for (int axis = 0; axis < 3; ++axis) {
        ivec before = SHIFT_LANES_1(node[axis], ivec(-1));
        same &= node[axis] == before;
    }
    corners.stays = bits(same) & active & active << 1;
};
""".replace("X_PRIME", str(PRIME_X)).replace("Y_PRIME", str(PRIME_Y))
)
"""What native functions about a hash begin with."""

ADD_OWN = (
    WORDS
    + r"""
const int n_workers = sink.records.shape[0], n_packs = sink.records.shape[1];
const int row = sink.n_recipients.shape[1];  // numbers in a sender's row
auto* values = sink.gradient.values.data;
auto* flags = sink.gradient.touched.data;
const int parts = (n_workers + n_active - 1) / n_active;  // of a level
// Who owns a part of a level: 0, 1, .., n - 1, n - 1, .., 1, 0, 0, 1, ..
auto owner_of = [&](int level, int part) -> int {
    const int n = level * parts + part, place = n % n_workers;
    return n / n_workers % 2 ? n_workers - 1 - place : place;
};
// The first level after another one of which the worker owns some; n_active: there is none.
auto own_after = [&](int level) -> int {
    while (++level < n_active) {
        for (int part = 0; part < parts; ++part) {
            if (owner_of(level, part) == worker) return level;
        }
    }
    return level;
};
// Asks for what will be added to for a lane.
auto prefetch = [&](const Corners& corners, int lane) {
    for (int n = 0; n < 4; ++n) __builtin_prefetch(values + corners.entry[n][lane], 1);
};
// Add a share of what a sample has for a pair of entries.
auto add_pair = [&](int entry, pair_vec sum) {
    pair_at* pair = (pair_at*)(values + entry);
    *pair = *pair + sum;
    flags[(unsigned)entry / TILE] = 1;  // on the border of two parts by either, with the same 1
};
// The same for those of a pair's entries that lie between two.
auto add_between = [&](int entry, pair_vec sum, int first, int last) {
    const bool low = first <= entry && entry < last, high = first <= entry + 1 && entry + 1 < last;
    entry_at* one = (entry_at*)(values + entry);
    if (low) *one = *one + sum.lo;
    if (high) one[1] = one[1] + sum.hi;
    if (low || high) flags[(unsigned)entry / TILE] = 1;
};
// Add what samples have for a level, or for those parts of it that are the worker's. adj_of(r) is
// what flows back to the numbers of all levels of the lane lane_of[r]. Samples of one cell, which
// follow each other, are accumulated before. Does something else for each lane, which memory has
// time for.
auto add_level = [&](const Corners& corners, int level, int n_rows, const int* lane_of,
                     auto&& adj_of, auto&& meanwhile) {
    auto for_each_cell = [&](auto&& add) {
        pair_vec sums[4];
        for (int r = 0; r < n_rows; ++r) {
            const int lane = lane_of[r];
            meanwhile(r);
            const entry_vec adj = *(const entry_at*)(adj_of(r) + level * WIDTH);
            pair_vec both;
            both.hi = corners.up[lane] * adj;
            both.lo = adj - both.hi;
            const bool begins = !(corners.stays >> lane & 1);
            #pragma clang loop unroll(full)
            for (int n = 0; n < 4; ++n) {
                const pair_vec before = begins ? pair_vec(0.0f) : sums[n];
                sums[n] = fma(pair_vec(corners.shares[n][lane]), both, before);
            }
            if (corners.stays >> (lane + 1) & 1) continue;
            #pragma clang loop unroll(full)
            for (int n = 0; n < 4; ++n) add(corners.entry[n][lane], sums[n]);
        }
    };
    if (parts == 1) {
        for_each_cell(add_pair);
        return;
    }
    const int begin = params.levels.data[level].begin;
    const int end = level + 1 < N_LEVELS ? params.levels.data[level + 1].begin
                                         : (int)params.values.shape[0];
    const int of_part = ((end - begin) / parts / TILE + 1) * TILE;
    for (int part = 0; part < parts; ++part) {
        if (owner_of(level, part) != worker) continue;
        const int first = min(begin + part * of_part, end), last = min(first + of_part, end);
        for_each_cell([&](int entry, pair_vec sum) { add_between(entry, sum, first, last); });
    }
};
"""
)
"""What adj_read_pack and add_records begin with: adding to the levels that a worker owns."""

READ_PACK = (
    WORDS
    + r"""
auto& pack = packs.data[slot];
int lane_of[2 * LANES] = {};
const unsigned active = bits(load_int(pack.active));
const int n_rows = list_lanes(active, 0, lane_of);
auto features_of = [&](int r) -> float* { return (float*)&pack.features.data[lane_of[r]]; };
const float* values = (const float*)params.values.data;
Corners corners[2];
corners_of(pack, active, 0, corners[0]);
for (int level = 0; level < n_active; ++level) {
    const Corners& here = corners[level % 2];
    Corners& next = corners[(level + 1) % 2];
    const bool goes_on = level + 1 < n_active;
    if (goes_on) corners_of(pack, active, level + 1, next);
    for (int r = 0; r < n_rows; ++r) {
        const int lane = lane_of[r];
        pair_vec both = 0.0f;
        #pragma clang loop unroll(full)
        for (int n = 0; n < 4; ++n) {
            if (goes_on) __builtin_prefetch(values + WIDTH * (size_t)next.entry[n][lane]);
            const pair_vec pair = *(const pair_at*)(values + WIDTH * (size_t)here.entry[n][lane]);
            both = fma(pair_vec(here.shares[n][lane]), pair, both);
        }
        *(entry_at*)(features_of(r) + level * WIDTH) =
            fma(entry_vec(here.up[lane]), both.hi - both.lo, both.lo);
    }
}
const int n_inputs = n_active * WIDTH;
OF_LAYER
float raw[LANES][COLUMNS];
for (int block = 0; block < COLUMNS; block += LANES) {
    multiply(n_rows, n_decoder_inputs, decoder_inputs_of, params.decoder.data + block, COLUMNS,
             [&](int r) { return raw[r] + block; });
}
put_raw(pack, n_rows, lane_of, raw);
"""
)

ADJ_READ_PACK = (
    ADD_OWN
    + r"""
const auto& pack = packs.data[slot];
int lane_of[2 * LANES] = {};
const unsigned active = bits(load_int(pack.active));
const int n_rows = list_lanes(active, 0, lane_of), n_inputs = n_active * WIDTH;
float adj_raw[LANES][COLUMNS], adj_features[LANES][PADDED];
take_adj_raw(pack, adj_raw);
auto adj_raw_of = [&](int r) { return adj_raw[lane_of[r]]; };
auto features_of = [&](int r) { return (const float*)&pack.features.data[lane_of[r]]; };
float* decoder_gradient =
    sink.gradient.decoder.data + (size_t)worker * sink.gradient.decoder.shape[1];
const float* transposed = params.transposed.data + (size_t)worker * params.transposed.shape[1];
OF_LAYER
add_products(n_rows, n_inputs, features_of, adj_of, matrix_gradient, MatrixColumns());
for (int block = 0; block < n_inputs; block += LANES) {
    multiply(n_rows, N_NUMBERS, adj_of, transposed + block, PADDED,
             [&](int r) { return adj_features[r] + block; });
}
Corners corners[2];
int level = own_after(-1);
if (level < n_active) corners_of(pack, active, level, corners[0]);
for (int k = 0; level < n_active; k = 1 - k) {
    const int later = own_after(level);
    if (later < n_active) corners_of(pack, active, later, corners[1 - k]);
    add_level(corners[k], level, n_rows, lane_of, [&](int r) { return adj_features[r]; },
              [&](int r) { if (later < n_active) prefetch(corners[1 - k], lane_of[r]); });
    level = later;
}
if (n_workers == 1 || !n_rows) return;
const int sent = sink.n_records.data[worker * row]++;
auto& record = sink.records.data[(size_t)worker * n_packs + sent];
record.active = active;
store(record.x, load(pack.x));
store(record.y, load(pack.y));
store(record.z, load(pack.z));
for (int r = 0; r < n_rows; ++r) {
    for (int n = 0; n < n_inputs; n += LANES) {
        put((float*)&record.adj_features.data[r] + n, at(adj_features[r] + n));
    }
}
"""
)

ADD_RECORDS = (
    ADD_OWN
    + r"""
if (sender == worker) return;
const auto* records = sink.records.data + (size_t)sender * n_packs;
const int n = sink.n_records.data[sender * row];
for (int level = own_after(-1); n && level < n_active; level = own_after(level)) {
    Corners corners[2];
    int lane_of[2][2 * LANES] = {}, n_rows[2];
    auto prepare = [&](int k) {
        n_rows[k % 2] = list_lanes(records[k].active, 0, lane_of[k % 2]);
        corners_of(records[k], records[k].active, level, corners[k % 2]);
    };
    prepare(0);
    for (int k = 0; k < n; ++k) {
        const int here = k % 2, next = 1 - here;
        const bool goes_on = k + 1 < n;
        if (goes_on) prepare(k + 1);
        add_level(corners[here], level, n_rows[here], lane_of[here],
                  [&](int r) { return (const float*)&records[k].adj_features.data[r]; },
                  [&](int r) {
                      if (goes_on && r < n_rows[next]) prefetch(corners[next], lane_of[next][r]);
                  });
    }
}
"""
)


class Layer(NamedTuple):
    """What stands between features and decoder, in C++."""

    forward: str
    adjoint: str
    begin: str


NO_LAYER = Layer(
    r"""
const auto& decoder_inputs_of = features_of;
const int n_decoder_inputs = n_inputs;
""",
    r"""
const auto& adj_of = adj_raw_of;
float* matrix_gradient = decoder_gradient;
constexpr int N_NUMBERS = DECODED;
using MatrixColumns = Columns;
""",
    TRANSPOSE_DECODER,
)
"""The decoder sees features."""

HIDDEN_LAYER = Layer(
    r"""
float units[LANES][HIDDEN];
for (int block = 0; block < HIDDEN; block += LANES) {
    multiply(n_rows, n_inputs, features_of, params.hidden.data + block, HIDDEN,
             [&](int r) { return units[r] + block; });
}
auto decoder_inputs_of = [&](int r) -> float* { return (float*)&pack.units.data[lane_of[r]]; };
constexpr int n_decoder_inputs = HIDDEN;
for (int r = 0; r < n_rows; ++r) {
    for (int n = 0; n < HIDDEN; n += LANES) {
        const vec before = at(units[r] + n);
        put(decoder_inputs_of(r) + n, before < 0.0f ? splat(0.0f) : before);
    }
}
""",
    r"""
auto units_of = [&](int r) { return (const float*)&pack.units.data[lane_of[r]]; };
add_products(n_rows, HIDDEN, units_of, adj_raw_of, decoder_gradient, Columns());
float adj_units[LANES][HIDDEN];
for (int block = 0; block < HIDDEN; block += LANES) {
    multiply(n_rows, DECODED, adj_raw_of, transposed + HIDDEN * PADDED + block, HIDDEN,
             [&](int r) { return adj_units[r] + block; });
    for (int r = 0; r < n_rows; ++r) {
        float* adj = adj_units[r] + block;
        put(adj, at(units_of(r) + block) > 0.0f ? at(adj) : splat(0.0f));
    }
}
auto adj_of = [&](int r) { return adj_units[r]; };
float* matrix_gradient =
    sink.gradient.hidden.data + (size_t)worker * sink.gradient.hidden.shape[1];
constexpr int N_NUMBERS = HIDDEN;
struct MatrixColumns { enum { value = HIDDEN }; };
""",
    "transpose(params.hidden.data, INPUTS, HIDDEN, HIDDEN);\n"
    "transpose(params.decoder.data, HIDDEN, COLUMNS, DECODED);",
)
"""The decoder sees the units of a hidden layer with ReLU, which sees features."""


@cache
def vectors_of(
    width: int,
    n_levels: int,
    n_floats: int,
    n_decoded: int,
    columns: int,
    by_sample: bool,
    hidden: int,
) -> EncodingVectors:
    """The vector form of ``hashed.hashed``, which says what the arguments are."""
    n_inputs = width * n_levels
    n_padded = padded(n_inputs)
    words = (
        f"constexpr int WIDTH = {width}, N_LEVELS = {n_levels}, FLOATS = {n_floats}, "
        f"DECODED = {n_decoded}, COLUMNS = {columns}, INPUTS = {n_inputs}, PADDED = {n_padded}, "
        f"HIDDEN = {hidden};\n"
    )
    layer = HIDDEN_LAYER if hidden else NO_LAYER
    code = VectorCode(
        READ_PACK.replace("OF_LAYER", layer.forward),
        ADJ_READ_PACK.replace("OF_LAYER", layer.adjoint),
        ADD_RECORDS,
        layer.begin,
    )
    Record = record_type("adj_features", n_padded)  # rows in the order of lanes, samples only
    kept = {"features": n_padded} | ({"units": hidden} if hidden else {})
    rows = tuple((name, wp.types.matrix((LANES, n), wp.float32)) for name, n in kept.items())
    return decoded_vectors(words, code, Record, n_floats, by_sample, rows)
