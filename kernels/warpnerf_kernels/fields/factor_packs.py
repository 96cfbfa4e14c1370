"""The vector form of factors: what sixteen samples read, and how their gradients are scattered.

Numbers of an entry fill the vectors, sixteen to each; samples go through the decoder side by side.

Workers own rows of each plane. A pack that lies in rows of others, too, leaves a record for them,
of places and of what flows back to raw values: who owns a sample's lower row of a plane reads plane
and line there once more, and does all that follows. Gradients of lines and of the decoder go to a
worker's own copy, since a line's entries belong to the rows of no one.
"""

from functools import cache

import warp as wp

from ..base.parts import EncodingVectors
from .decoder import DECODER, VectorCode, decoded_vectors, record_type

wp.set_module_options({"enable_backward": False})

WORDS = (
    DECODER
    + r"""
constexpr int PRODUCTS = 3 * WIDTH;  // rows of the decoder
// The three planes: axes of their rows and within these, of their line, and where both begin.
const auto& size = params.size;
const int first_axis[3] = {0, 0, 1}, second_axis[3] = {1, 2, 2};
const int plane_begin[3] = {0, size.c[0] * size.c[1], size.c[0] * (size.c[1] + size.c[2])};
const int line_begin[3] = {0, size.c[2], size.c[2] + size.c[1]};

struct Places { ivec node[3]; vec fraction[3]; };
// Where samples lie in the lattice; what is no sample lies anywhere in it.
auto places_of = [&](const auto& samples) -> Places {
    Places places;
    const vec c[3] = {load(samples.x), load(samples.y), load(samples.z)};
    #pragma clang loop unroll(full)
    for (int axis = 0; axis < 3; ++axis) {
        const vec u = c[axis] * params.to_nodes.c[axis] + params.middle.c[axis];
        places.node[axis] = clamp(truncate(u), size.c[axis] - 1);
        places.fraction[axis] = u - to_float(places.node[axis]);
    }
    return places;
};
struct Corners { int entry[LANES], line[LANES]; float shares[4][LANES], up[LANES]; int row; };
// The same in a plane and its line, lane by lane.
auto corners_of = [&](const Places& places, int plane, Corners& corners) {
    const int a = first_axis[plane], b = second_axis[plane], c = 2 - plane;
    corners.row = size.c[b];
    *(ivec_at*)corners.entry = plane_begin[plane] + places.node[a] * size.c[b] + places.node[b];
    *(ivec_at*)corners.line = line_begin[plane] + places.node[c];
    split(places.fraction[a], places.fraction[b], corners.shares);
    put(corners.up, places.fraction[c]);
};
// Sixteen numbers of the mean of a plane's entries around a lane's place, and of its line's.
auto in_plane = [&](const Corners& corners, int lane, int block) -> vec {
    const float* low = (const float*)(params.planes.data + corners.entry[lane]) + block;
    const float* high = low + (size_t)corners.row * WIDTH;
    vec x = corners.shares[0][lane] * at(low);
    x = fma(splat(corners.shares[1][lane]), at(low + WIDTH), x);
    x = fma(splat(corners.shares[2][lane]), at(high), x);
    return fma(splat(corners.shares[3][lane]), at(high + WIDTH), x);
};
auto on_line = [&](const Corners& corners, int lane, int block) -> vec {
    const float* low = params.lines.data + (size_t)corners.line[lane] * WIDTH + block;
    return fma(splat(corners.up[lane]), at(low + WIDTH) - at(low), at(low));
};
"""
)
"""What native functions about factors begin with."""

ADD_OWN = (
    WORDS
    + r"""
const int n_workers = sink.records.shape[0], n_packs = sink.records.shape[1];
const int row = sink.n_recipients.shape[1];  // numbers in a sender's row
const float* transposed = params.transposed.data + (size_t)worker * params.transposed.shape[1];
float* line_gradient =
    sink.gradient.lines.data + (size_t)worker * sink.gradient.lines.shape[1];
float* decoder_gradient =
    sink.gradient.decoder.data + (size_t)worker * sink.gradient.decoder.shape[1];
auto* flags = sink.gradient.touched.data;
// The lanes whose rows of a plane, those at `node`, are an owner's.
auto owned = [&](int owner, int plane, ivec node) -> unsigned {
    const int n = size.c[first_axis[plane]], rows = (n + n_workers - 1) / n_workers;
    const int begin = min(owner * rows, n), end = min((owner + 1) * rows, n);
    return bits((begin <= node) & (node < end));
};
auto lower_of = [&](int owner, int plane, const Places& places) -> unsigned {
    return owned(owner, plane, places.node[first_axis[plane]]);
};
auto upper_of = [&](int owner, int plane, const Places& places) -> unsigned {
    return owned(owner, plane, places.node[first_axis[plane]] + 1);
};
// Add to a row of a plane what some samples have for its two entries.
auto add_pair = [&](int entry, int block, float first, float second, vec adj) {
    float* to = (float*)(sink.gradient.planes.data + entry) + block;
    put(to, fma(splat(first), adj, at(to)));
    put(to + WIDTH, fma(splat(second), adj, at(to + WIDTH)));
    flags[(unsigned)entry / TILE] = 1;  // on the border of two parts by either, with the same 1
};
// Add what samples have for a plane's rows that are the worker's own, `lower` and `upper` ones; and
// for line and decoder, if the lower one is. adj_raw[lane] is what flows back to raw values.
auto add_plane = [&](const Places& places, int plane, unsigned lower, unsigned upper,
                     const auto& adj_raw) {
    int lane_of[2 * LANES];
    const int n_rows = list_lanes(lower | upper, 0, lane_of);
    Corners corners;
    corners_of(places, plane, corners);
    float adj_products[LANES][WIDTH], products[LANES][WIDTH], adj_of[LANES][COLUMNS];
    for (int r = 0; r < n_rows; ++r) {
        __builtin_memcpy(adj_of[r], adj_raw[lane_of[r]], sizeof(adj_of[r]));
    }
    #pragma clang loop unroll(full)
    for (int block = 0; block < WIDTH; block += LANES) {
        multiply(n_rows, DECODED, [&](int r) { return adj_of[r]; },
                 transposed + plane * WIDTH + block, PRODUCTS,
                 [&](int r) { return adj_products[r] + block; });
    }
    if (!n_rows) return;
    for (int r = 0; r < n_rows; ++r) {
        const int lane = lane_of[r], entry = corners.entry[lane];
        const bool is_lower = lower >> lane & 1, is_upper = upper >> lane & 1;
        float* to = line_gradient + (size_t)corners.line[lane] * WIDTH;
        #pragma clang loop unroll(full)
        for (int block = 0; block < WIDTH; block += LANES) {
            const vec adj = at(adj_products[r] + block), line = on_line(corners, lane, block);
            const vec adj_plane = adj * line;
            vec product = splat(0.0f);
            if (is_lower) {
                const vec around = in_plane(corners, lane, block);
                const vec adj_line = adj * around, high = corners.up[lane] * adj_line;
                put(to + block, at(to + block) + (adj_line - high));
                put(to + WIDTH + block, at(to + WIDTH + block) + high);
                product = around * line;
                add_pair(entry, block, corners.shares[0][lane], corners.shares[1][lane], adj_plane);
            }
            if (is_upper) {
                add_pair(entry + corners.row, block, corners.shares[2][lane],
                         corners.shares[3][lane], adj_plane);
            }
            put(products[r] + block, product);
        }
    }
    add_products(n_rows, WIDTH, [&](int r) { return products[r]; },
                 [&](int r) { return adj_of[r]; },
                 decoder_gradient + (size_t)plane * WIDTH * COLUMNS, Columns());
};
"""
)
"""What adj_read_pack and add_records begin with: adding to the rows that a worker owns."""

READ_PACK = (
    WORDS
    + r"""
auto& pack = packs.data[slot];
const unsigned active = bits(load_int(pack.active));
const Places places = places_of(pack);
int lane_of[2 * LANES];
const int n_rows = list_lanes(active, 0, lane_of);
float products[LANES][PRODUCTS], raw[LANES][COLUMNS];
Corners corners;
#pragma clang loop unroll(full)
for (int plane = 0; plane < 3; ++plane) {
    corners_of(places, plane, corners);
    for (int r = 0; r < n_rows; ++r) {
        #pragma clang loop unroll(full)
        for (int block = 0; block < WIDTH; block += LANES) {
            put(products[r] + plane * WIDTH + block,
                in_plane(corners, lane_of[r], block) * on_line(corners, lane_of[r], block));
        }
    }
}
for (int block = 0; block < COLUMNS; block += LANES) {
    multiply(n_rows, PRODUCTS, [&](int r) { return products[r]; }, params.decoder.data + block,
             COLUMNS, [&](int r) { return raw[r] + block; });
}
put_raw(pack, n_rows, lane_of, raw);
"""
)

ADJ_READ_PACK = (
    ADD_OWN
    + r"""
const auto& pack = packs.data[slot];
const unsigned active = bits(load_int(pack.active));
float adj_raw[LANES][COLUMNS];
take_adj_raw(pack, adj_raw);
const Places places = places_of(pack);
bool all_mine = true;
#pragma clang loop unroll(full)
for (int plane = 0; plane < 3; ++plane) {
    const unsigned lower = active & lower_of(worker, plane, places);
    const unsigned upper = active & upper_of(worker, plane, places);
    add_plane(places, plane, lower, upper, adj_raw);
    all_mine &= (lower & upper) == active;
}
if (all_mine) return;
const int sent = sink.n_records.data[worker * row]++;
auto& record = sink.records.data[(size_t)worker * n_packs + sent];
record.active = active;
store(record.x, load(pack.x));
store(record.y, load(pack.y));
store(record.z, load(pack.z));
__builtin_memcpy(&record.adj_raw, adj_raw, sizeof(adj_raw));
for (int receiver = 0; receiver < n_workers; ++receiver) {
    int theirs = 0;  // bit p: plane p
    for (int plane = 0; plane < 3; ++plane) {
        const unsigned rows =
            lower_of(receiver, plane, places) | upper_of(receiver, plane, places);
        theirs |= (rows & active ? 1 : 0) << plane;
    }
    if (receiver == worker || !theirs) continue;
    int& n = sink.n_recipients.data[worker * row + receiver];
    sink.recipients.data[((size_t)worker * n_workers + receiver) * n_packs + n++] =
        sent * 8 + theirs;
}
"""
)

ADD_RECORDS = (
    ADD_OWN
    + r"""
const auto* records = sink.records.data + (size_t)sender * n_packs;
const int* which = sink.recipients.data + ((size_t)sender * n_workers + worker) * n_packs;
const int n = sink.n_recipients.data[sender * row + worker];
for (int k = 0; k < n; ++k) {
    const auto& record = records[which[k] / 8];
    const Places places = places_of(record);
    each(which[k] & 7, [&](int plane) {
        const unsigned lower = record.active & lower_of(worker, plane, places);
        const unsigned upper = record.active & upper_of(worker, plane, places);
        add_plane(places, plane, lower, upper, record.adj_raw.data);
    });
}
"""
)


@cache
def vectors_of(
    width: int, n_floats: int, n_decoded: int, columns: int, by_sample: bool
) -> EncodingVectors:
    """The vector form of ``factors.factors``, which says what the arguments are."""
    words = (
        f"constexpr int WIDTH = {width}, FLOATS = {n_floats}, DECODED = {n_decoded}, "
        f"COLUMNS = {columns}, INPUTS = {3 * width};\n"
    )
    code = VectorCode(READ_PACK, ADJ_READ_PACK, ADD_RECORDS)
    return decoded_vectors(words, code, record_type("adj_raw", columns), n_floats, by_sample)
