"""Dense voxel grid: trilinear interpolation between nodes. An encoding, with its transpose below.

Nodes hold n_floats values side by side: raw density, features, padding to a power of two.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Encoding, EncodingVectors
from ..base.simd import LANES, VECTORS, lanes, lanes_int
from ..base.types import Ray, gradient_type, real, struct, vec3, vector
from .interp import adj_gather, flat_index, gather, lowest_node, place_in

wp.set_module_options({"enable_backward": False})


@cache
def grid_type(n_floats: int) -> type:
    """A grid as kernels take it."""

    @wp.struct
    class Grid:
        values: wp.array(dtype=vector(n_floats))  # [X * Y * Z]
        size: wp.vec3i  # X, Y, Z, each >= 2
        to_nodes: vec3  # contracted coordinates to grid coordinates: u = c to_nodes + middle
        middle: vec3  # grid coordinates of the centre, (size - 1) / 2

    return Grid


@wp.func
def read(grid: Any, position: vec3):
    """Trilinear interpolation of the raw values at a position."""
    u = wp.cw_mul(position, grid.to_nodes) + grid.middle
    node = lowest_node(u, grid.size)
    fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
    return gather(
        grid.values, grid.size, flat_index(node[0], node[1], node[2], grid.size), fraction
    )


@wp.func
def adj_read(
    grid: Any,
    position: vec3,
    adj_raw: Any,
    gradient: Any,  # added to
):
    """Transpose of read (scatter-add to the eight nodes)."""
    u = wp.cw_mul(position, grid.to_nodes) + grid.middle
    node = lowest_node(u, grid.size)
    fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
    adj_gather(
        grid.size,
        flat_index(node[0], node[1], node[2], grid.size),
        fraction,
        adj_raw,
        gradient,
    )


@wp.func
def place(grid: Any, position: vec3) -> vec3:
    """Where a position lies in the grid, [0, 1]^3."""
    u = wp.cw_mul(position, grid.to_nodes) + grid.middle
    return wp.cw_div(u, real(2.0) * grid.middle)


PACK_FIELDS = (
    ("base", lanes_int),  # flat index of the lowest of the eight nodes around
    # Of the four columns of nodes around, by x and y; together 1:
    ("shares", wp.types.matrix((4, LANES), wp.float32)),
    ("fraction_x", lanes),  # position between the nodes, [0, 1]
    ("fraction_y", lanes),
    ("fraction_z", lanes),
)

NODES = (
    VECTORS
    + r"""
constexpr int FLOATS = sizeof(*VALUES) / sizeof(float);  // of a node
typedef float node_vec __attribute__((ext_vector_type(FLOATS)));
typedef float pair_vec __attribute__((ext_vector_type(2 * FLOATS)));  // a column's two nodes
typedef float node_at __attribute__((ext_vector_type(FLOATS), aligned(4), may_alias));
typedef float pair_at __attribute__((ext_vector_type(2 * FLOATS), aligned(4), may_alias));
typedef float float4_at __attribute__((ext_vector_type(4), aligned(4), may_alias));
// Bring the four columns of nodes around a sample into L2, ahead of their use: more requests
// fit on the way there than on the way into L1. Every other column of nodes of 32
// bytes lies across two cache lines.
auto prefetch_column = [&](const auto* node) {
    const char* column = (const char*)node;
    constexpr size_t BYTES = 2 * sizeof(*node);
    for (size_t at = 0; at < BYTES; at += 64) __builtin_prefetch(column + at, 0, 2);
    if (BYTES == 64) __builtin_prefetch(column + BYTES - 1, 0, 2);
};
auto prefetch_nodes = [&](const auto* node, const auto& size) {
    const size_t stride_y = size.c[2], stride_x = stride_y * size.c[1];
    prefetch_column(node);
    prefetch_column(node + stride_y);
    prefetch_column(node + stride_x);
    prefetch_column(node + stride_x + stride_y);
};
"""
)
"""What native functions about nodes begin with; VALUES is where these lie."""


@wp.func_native(
    NODES.replace("VALUES", "grid.values.data")
    + r"""
auto& pack = packs.data[slot];
const ivec active = load_int(pack.active);
vec ux = load(pack.x) * grid.to_nodes.c[0] + grid.middle.c[0];
vec uy = load(pack.y) * grid.to_nodes.c[1] + grid.middle.c[1];
vec uz = load(pack.z) * grid.to_nodes.c[2] + grid.middle.c[2];
auto index = [&](ivec i, ivec j, ivec l) -> ivec {
    return (i * grid.size.c[1] + j) * grid.size.c[2] + l;
};
ivec i = clamp(truncate(ux), grid.size.c[0] - 1);
ivec j = clamp(truncate(uy), grid.size.c[1] - 1);
ivec l = clamp(truncate(uz), grid.size.c[2] - 1);
store_int(pack.base, index(i, j, l));
const vec fraction_x = active ? ux - to_float(i) : splat(0.0f);
const vec fraction_y = active ? uy - to_float(j) : splat(0.0f);
const vec fraction_z = active ? uz - to_float(l) : splat(0.0f);
split(fraction_x, fraction_y, pack.shares.data);
store(pack.fraction_x, fraction_x);
store(pack.fraction_y, fraction_y);
store(pack.fraction_z, fraction_z);
// Memory is slower than all of this: fetch what the next pack will read, going straight on.
const vec ahead = (float)LANES * load(pack.dt);
ux += ahead * (ray.q_direction.c[0] * grid.to_nodes.c[0]);
uy += ahead * (ray.q_direction.c[1] * grid.to_nodes.c[1]);
uz += ahead * (ray.q_direction.c[2] * grid.to_nodes.c[2]);
i = clamp(truncate(ux), grid.size.c[0] - 1);
j = clamp(truncate(uy), grid.size.c[1] - 1);
l = clamp(truncate(uz), grid.size.c[2] - 1);
int node_ahead[LANES];  // in memory, as lanes are needed one by one
*(ivec_at*)node_ahead = index(i, j, l);
// Wide nodes are many cache lines, so only where the next pack begins right behind this one.
const bool goes_on = FLOATS == 4 || bits(active) >> (LANES - 1);

const float* values = (const float*)grid.values.data;
const size_t stride_y = FLOATS * (size_t)grid.size.c[2], stride_x = stride_y * grid.size.c[1];
const auto& shares = pack.shares.data;
const unsigned wanted = FLOATS > 4 ? bits(active) : 0xffffu;  // four read as fast as a branch
node_vec raw[LANES];
#pragma clang loop unroll(full)
for (int n = 0; n < LANES; ++n) {
    raw[n] = 0.0f;
    // Lane by lane: all at once, requests would hold up what this pack has to read.
    if (goes_on) prefetch_nodes(grid.values.data + node_ahead[n], grid.size);
    if (!(wanted >> n & 1)) continue;
    // A column's two nodes lie side by side: one vector holds both.
    auto column = [&](const float* node) -> pair_vec { return *(const pair_at*)node; };
    const float* node = values + FLOATS * (size_t)pack.base.c[n];
    pair_vec both = shares[0][n] * column(node);
    both = fma(pair_vec(shares[1][n]), column(node + stride_y), both);
    both = fma(pair_vec(shares[2][n]), column(node + stride_x), both);
    both = fma(pair_vec(shares[3][n]), column(node + stride_x + stride_y), both);
    raw[n] = fma(node_vec(pack.fraction_z.c[n]), both.hi - both.lo, both.lo);
}
constexpr int BY_LANE = sizeof(pack.raw) / sizeof(vec);
[&](auto& pack) {
    if constexpr (BY_LANE < FLOATS) {
        #pragma clang loop unroll(full)
        for (int n = 0; n < LANES; ++n) {
            if (wanted >> n & 1) *(node_at*)&pack.by_sample.data[n] = raw[n];
        }
    }
}(pack);
for (int f = 0; f < BY_LANE; f += 4) {
    float4 four[LANES];
    for (int n = 0; n < LANES; ++n) four[n] = *(const float4_at*)((const float*)&raw[n] + f);
    vec a, b, c, d;
    float4_to_lanes(four, a, b, c, d);
    store(pack.raw.data[f], a);
    store(pack.raw.data[f + 1], b);
    store(pack.raw.data[f + 2], c);
    store(pack.raw.data[f + 3], d);
}
"""
)
def read_pack(grid: Any, ray: Ray, packs: wp.array(dtype=Any), slot: int):
    """read for the samples of a pack, and the fetching of what the next pack will read."""
    ...


ADD_OWN = (
    NODES.replace("VALUES", "sink.gradient.values.data")
    + r"""
const auto& size = grid.size;
const int n_workers = sink.records.shape[0], n_packs = sink.records.shape[1];
const int row = sink.n_recipients.shape[1];  // numbers in a sender's row
const int n_planes = (size.c[0] + n_workers - 1) / n_workers;  // of nodes, for each worker
const int stride_y = size.c[2], stride_x = stride_y * size.c[1];
auto* values = sink.gradient.values.data;
auto* flags = sink.gradient.touched.data;
// No more than there are, which int holds.
auto first_node = [&](int owner) -> int { return min(owner * n_planes, size.c[0]) * stride_x; };
auto owned = [&](int owner, ivec node) -> unsigned {
    return bits((first_node(owner) <= node) & (node < first_node(owner + 1)));
};
// Prefetches what add_own will add to for a lane of some samples.
auto prefetch_own = [&](const auto& samples, unsigned active) {
    const unsigned own = owned(worker, load_int(samples.base)) & active;
    return [&, own](int n) {
        if (own >> n & 1) prefetch_nodes(values + samples.base.c[n], size);
    };
};
// Give a column's two nodes their shares of what a sample has for both.
auto add_column = [&](int node, float share, pair_vec both) {
    pair_at* pair = (pair_at*)(values + node);
    *pair = fma(pair_vec(share), both, pair_vec(*pair));
    flags[(unsigned)node / TILE] = 1;  // on the border of two parts by either, with the same 1
};
// Add what samples have for the worker's own planes, and do something else for each lane before
// it is added, which memory has time for. Returns whether that is all the samples have.
auto add_own = [&](const auto& samples, unsigned active, const auto& shares,
                   auto&& meanwhile) -> bool {
    constexpr int BY_LANE = sizeof(samples.adj_raw) / sizeof(vec);
    float4 four[BY_LANE / 4][LANES];
    #pragma clang loop unroll(full)
    for (int f = 0; f < BY_LANE; f += 4) {
        lanes_to_float4(load(samples.adj_raw.data[f]), load(samples.adj_raw.data[f + 1]),
                 load(samples.adj_raw.data[f + 2]), load(samples.adj_raw.data[f + 3]), four[f / 4]);
    }
    node_vec adj[LANES];
    #pragma clang loop unroll(full)
    for (int n = 0; n < LANES; ++n) {
        node_vec whole;  // put together in registers: what is stored in parts is slow to load
        if constexpr (BY_LANE < FLOATS) whole = *(const node_at*)&samples.adj_by_sample.data[n];
        #pragma clang loop unroll(full)
        for (int f = 0; f < BY_LANE; f += 4) *(float4_at*)((float*)&whole + f) = four[f / 4][n];
        adj[n] = whole;
    }
    auto add_plane = [&](int n, int node, const auto* share) {
        pair_vec both;
        both.hi = samples.fraction_z.c[n] * adj[n];
        both.lo = adj[n] - both.hi;
        add_column(node, share[0][n], both);
        add_column(node + stride_y, share[1][n], both);
    };
    auto add_lower = [&](int n) { add_plane(n, samples.base.c[n], shares); };
    auto add_upper = [&](int n) { add_plane(n, samples.base.c[n] + stride_x, shares + 2); };
    const ivec base = load_int(samples.base);
    const unsigned lower = active & owned(worker, base);
    const unsigned upper = active & owned(worker, base + stride_x);
    if ((lower & upper) == active) {
        #pragma clang loop unroll(full)
        for (int n = 0; n < LANES; ++n) {
            meanwhile(n);
            if (!(active >> n & 1)) continue;
            add_lower(n);
            add_upper(n);
        }
        return true;
    }
    for (int n = 0; n < LANES; ++n) meanwhile(n);
    each(lower, add_lower);
    each(upper, add_upper);
    return false;
};
"""
)
"""What adj_read_pack and add_records begin with: adding to the planes that a worker owns."""


@wp.func_native(
    ADD_OWN
    + r"""
const auto& pack = packs.data[slot];
const auto& next = packs.data[later];
const unsigned active = bits(load_int(pack.active));
const auto prefetch_next = prefetch_own(next, bits(load_int(next.active)));
if (add_own(pack, active, pack.shares.data, prefetch_next)) return;
const int sent = sink.n_records.data[worker * row]++;
auto& record = sink.records.data[(size_t)worker * n_packs + sent];
const ivec base = load_int(pack.base);
record.active = active;
store_int(record.base, base);
store(record.fraction_x, load(pack.fraction_x));
store(record.fraction_y, load(pack.fraction_y));
store(record.fraction_z, load(pack.fraction_z));
constexpr int BY_LANE = sizeof(pack.adj_raw) / sizeof(vec);
for (int f = 0; f < BY_LANE; ++f) store(record.adj_raw.data[f], load(pack.adj_raw.data[f]));
[&](auto& record, const auto& pack) {
    if constexpr (BY_LANE < FLOATS) record.adj_by_sample = pack.adj_by_sample;
}(record, pack);
for (int receiver = 0; receiver < n_workers; ++receiver) {
    const unsigned theirs = owned(receiver, base) | owned(receiver, base + stride_x);
    if (receiver == worker || !(theirs & active)) continue;
    int& n = sink.n_recipients.data[worker * row + receiver];
    sink.recipients.data[((size_t)worker * n_workers + receiver) * n_packs + n++] = sent;
}
"""
)
def adj_read_pack(
    grid: Any,
    packs: wp.array(dtype=Any),
    slot: int,
    later: int,  # slot of the pack that comes next
    worker: int,
    sink: Any,  # added to, and what is in it
):
    """adj_read for a pack's samples, where the worker owns the nodes; a record of the rest."""
    ...


@wp.func_native(
    ADD_OWN
    + r"""
const auto prefetch_lane = prefetch_own(packs.data[slot], bits(load_int(packs.data[slot].active)));
for (int n = 0; n < LANES; ++n) prefetch_lane(n);
"""
)
def prefetch_gradient(grid: Any, packs: wp.array(dtype=Any), slot: int, worker: int, sink: Any):
    """Prefetch the nodes that adj_read_pack will add to, where the worker owns them."""
    ...


@wp.func_native(
    ADD_OWN
    + r"""
const auto* records = sink.records.data + (size_t)sender * n_packs;
const int* which = sink.recipients.data + ((size_t)sender * n_workers + worker) * n_packs;
const int n = sink.n_recipients.data[sender * row + worker];
for (int k = 0; k < n; ++k) {
    const auto& record = records[which[k]];
    const auto& next = records[which[k + 1 < n ? k + 1 : k]];
    float shares[4][LANES];
    split(load(record.fraction_x), load(record.fraction_y), shares);
    add_own(record, record.active, shares, prefetch_own(next, next.active));
}
"""
)
def add_records(grid: Any, worker: int, sender: int, sink: Any):
    """Add what a sender has left for a worker."""
    ...


@cache
def record_type(n_floats: int, n_by_lane: int) -> type:
    """What a pack of samples has for the nodes around them, not all of which are the sender's."""
    fields = {
        "active": wp.uint32,  # bit n: lane n is a sample
        "base": lanes_int,  # flat index of the lowest of the eight nodes around
        "fraction_x": lanes,  # position between the nodes, [0, 1]
        "fraction_y": lanes,
        "fraction_z": lanes,
        "adj_raw": wp.types.matrix((n_by_lane, LANES), wp.float32),  # of the raw values at samples
    }
    if n_by_lane < n_floats:
        fields["adj_by_sample"] = wp.types.matrix((LANES, n_floats), wp.float32)
    return struct("Record", fields, __name__)


@cache
def dense(n_floats: int, by_sample: bool = False) -> Encoding:
    """The encoding whose nodes hold so many values: 4, 8, 16, 32 or 64.

    Args:
        n_floats: Of a node.
        by_sample: Whether packs hold values after the first four sample by sample, as heads want
            them that work on samples and not on lanes.
    """
    n_by_lane = 4 if by_sample else n_floats
    pack_fields = PACK_FIELDS
    if n_by_lane < n_floats:
        rows = wp.types.matrix((LANES, n_floats), wp.float32)
        pack_fields += (("by_sample", rows), ("adj_by_sample", rows))
    return Encoding(
        n_floats=n_floats,
        Params=grid_type(n_floats),
        Gradient=gradient_type(n_floats),
        read=read,
        adj_read=adj_read,
        place=place,
        vectors=EncodingVectors(
            read_pack=read_pack,
            adj_read_pack=adj_read_pack,
            prefetch_gradient=prefetch_gradient,
            add_records=add_records,
            Record=record_type(n_floats, n_by_lane),
            n_by_lane=n_by_lane,
            pack_fields=pack_fields,
            # Without the first four numbers, where those lie sample by sample as well.
            record_bytes=4 * LANES * (4 + n_floats),
        ),
    )


@cache
def resample_kernel(n_floats: int) -> wp.Kernel:
    """Resampling: another grid's nodes, interpolated from a first one."""
    node = vector(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def resample(
        # launch
        first: int,
        # scene
        values: wp.array(dtype=node),  # [X * Y * Z]
        size: wp.vec3i,
        # choices
        scale: vec3,  # u in the old grid = u in the new one * scale + offset
        offset: vec3,
        # out
        out_size: wp.vec3i,
        out_values: wp.array(dtype=node),  # [X' * Y' * Z']
    ):
        n = first + wp.tid()
        base, fraction = place_in(size, scale, offset, n, out_size)
        out_values[n] = gather(values, size, base, fraction)

    return resample
