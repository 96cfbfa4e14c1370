"""How the gradients of samples get into the grid on a CPU with several workers.

Rays cross the grid in every direction; adding as they go, threads would race for its nodes. So each
worker owns a part of the grid, some planes of nodes along x, and is the only one to add to it. What
its rays have for its own part it adds at once; a pack of samples that has something for others goes
into a parcel. Once all rays are through, each worker adds what the others have left for it. That is
the less, the more of a ray goes through the part of the worker that has it, for which order.py
cares. What is added to a node, and in which order, depends on nothing but the rays and the number
of workers.

Like packs.py this is for float32 on the CPU, and most of it C++ on Clang's vector types.
"""

import warp as wp

from .meeting import meet
from .order import Turn
from .packs import Pack
from .types import Gradient
from .vectors import VECTORS, lanes, lanes_int

wp.set_module_options({"enable_backward": False})


@wp.struct
class Parcel:
    """What a pack of samples has for the nodes around them, not all of which are the sender's."""

    visited: wp.uint32  # bit n: lane n is a sample
    base: lanes_int  # flat index of the lowest of the eight nodes around
    fraction_x: lanes  # position between the nodes, [0, 1]
    fraction_y: lanes
    fraction_z: lanes
    adj_density: lanes  # of the raw values at the samples
    adj_red: lanes
    adj_green: lanes
    adj_blue: lanes


@wp.struct
class Parcels:
    """Parcels on their way between workers."""

    contents: wp.array2d(dtype=Parcel)  # [n_workers, n_packs] by sender
    addressed: wp.array3d(dtype=wp.int32)  # [n_workers, n_workers, n_packs] by sender and receiver:
    # which of the contents are for whom
    # How many there are of both, by sender, in rows of whole cache lines, which no two workers
    # share:
    n_contents: wp.array2d(dtype=wp.int32)  # [n_workers, row] in the first column
    n_addressed: wp.array2d(dtype=wp.int32)  # [n_workers, row] by receiver
    gradient: Gradient  # where it all goes
    turn: Turn  # whose rays they are from


WORDS = (
    VECTORS
    + r"""
const int n_workers = parcels.contents.shape[0], n_packs = parcels.contents.shape[1];
const int row = parcels.n_addressed.shape[1];  // numbers in a sender's row
const int n_planes = (size.c[0] + n_workers - 1) / n_workers;  // of nodes, for each worker
const int stride_y = size.c[2], stride_x = stride_y * size.c[1];
auto* values = parcels.gradient.values.data;
auto* flags = parcels.gradient.touched.data;
// No more than there are, which int holds.
auto first_node = [&](int owner) -> int { return least(owner * n_planes, size.c[0]) * stride_x; };
auto owned = [&](int owner, ivec node) -> unsigned {
    return bits((first_node(owner) <= node) & (node < first_node(owner + 1)));
};
auto fetch_own = [&](const auto& samples) {
    each(owned(worker, load_int(samples.base)), [&](int n) {
        fetch(values + samples.base.c[n], size);
    });
};
// Give a column's two nodes their shares of what a sample has for both.
auto add_column = [&](int node, float share, octet both) {
    octet_at* pair = (octet_at*)(values + node);
    *pair = fma(octet(share), both, octet(*pair));
    flags[(unsigned)node / TILE] = 1;  // on the border of two parts by either, with the same 1
};
// Add what samples have for the worker's own planes. Returns whether that is all of it.
auto add_own = [&](const auto& samples, unsigned visited, const auto& shares, vec adj_density,
                   vec adj_red, vec adj_green, vec adj_blue) -> bool {
    quad adj[LANES];
    to_quads(adj_density, adj_red, adj_green, adj_blue, adj);
    auto add_plane = [&](int n, int node, const auto* share) {
        octet both;
        both.hi = samples.fraction_z.c[n] * adj[n];
        both.lo = adj[n] - both.hi;
        add_column(node, share[0][n], both);
        add_column(node + stride_y, share[1][n], both);
    };
    auto add_lower = [&](int n) { add_plane(n, samples.base.c[n], shares); };
    auto add_upper = [&](int n) { add_plane(n, samples.base.c[n] + stride_x, shares + 2); };
    const ivec base = load_int(samples.base);
    const unsigned lower = visited & owned(worker, base);
    const unsigned upper = visited & owned(worker, base + stride_x);
    if ((lower & upper) == visited) {
        #pragma clang loop unroll(full)
        for (int n = 0; n < LANES; ++n) {
            if (!(visited >> n & 1)) continue;
            add_lower(n);
            add_upper(n);
        }
        return true;
    }
    each(lower, add_lower);
    each(upper, add_upper);
    return false;
};
"""
)
"""What hand_out and take_in begin with; it uses their arguments size, worker and parcels."""


@wp.func_native(
    WORDS
    + r"""
const auto& pack = packs.data[slot];
fetch_own(packs.data[later]);
const unsigned visited = bits(load_int(pack.visited));
const vec red = load(pack.red), green = load(pack.green), blue = load(pack.blue);
const vec adj_density = load(pack.sigma_slope) * load(pack.adj_sigma);
const vec adj_red = red * (1.0f - red) * load(pack.adj_red);
const vec adj_green = green * (1.0f - green) * load(pack.adj_green);
const vec adj_blue = blue * (1.0f - blue) * load(pack.adj_blue);
if (add_own(pack, visited, pack.shares.data, adj_density, adj_red, adj_green, adj_blue)) return;
const int sent = parcels.n_contents.data[worker * row]++;
auto& parcel = parcels.contents.data[(size_t)worker * n_packs + sent];
const ivec base = load_int(pack.base);
parcel.visited = visited;
store_int(parcel.base, base);
store(parcel.fraction_x, load(pack.fraction_x));
store(parcel.fraction_y, load(pack.fraction_y));
store(parcel.fraction_z, load(pack.fraction_z));
store(parcel.adj_density, adj_density);
store(parcel.adj_red, adj_red);
store(parcel.adj_green, adj_green);
store(parcel.adj_blue, adj_blue);
for (int receiver = 0; receiver < n_workers; ++receiver) {
    const unsigned theirs = owned(receiver, base) | owned(receiver, base + stride_x);
    if (receiver == worker || !(theirs & visited)) continue;
    int& n = parcels.n_addressed.data[worker * row + receiver];
    parcels.addressed.data[((size_t)worker * n_workers + receiver) * n_packs + n++] = sent;
}
"""
)
def hand_out(
    size: wp.vec3i,
    packs: wp.array(dtype=Pack),
    slot: int,
    later: int,  # slot of a pack that comes soon
    worker: int,
    parcels: Parcels,
):
    """integral.adj_shade, down to interp.adj_gather, for a pack; or as far as a parcel."""
    ...


@wp.func_native(
    WORDS
    + r"""
constexpr int SOON = 4;  // parcels from the one that is added to the one that is asked for
auto fetch_whole = [&](const auto& x) {
    for (size_t at = 0; at < sizeof(x); at += 64) __builtin_prefetch((const char*)&x + at);
};
for (int sender = 0; sender < n_workers; ++sender) {
    const auto* contents = parcels.contents.data + (size_t)sender * n_packs;
    const int* which = parcels.addressed.data + ((size_t)sender * n_workers + worker) * n_packs;
    const int n = parcels.n_addressed.data[sender * row + worker];
    for (int k = 0; k < n; ++k) {
        if (k + SOON < n) fetch_whole(contents[which[k + SOON]]);
        if (k + 1 < n) fetch_own(contents[which[k + 1]]);
        const auto& parcel = contents[which[k]];
        float shares[4][LANES];
        split(load(parcel.fraction_x), load(parcel.fraction_y), shares);
        add_own(
            parcel,
            parcel.visited,
            shares,
            load(parcel.adj_density),
            load(parcel.adj_red),
            load(parcel.adj_green),
            load(parcel.adj_blue));
    }
}
"""
)
def take_in(size: wp.vec3i, worker: int, parcels: Parcels):
    """Add what others have left for a worker."""
    ...


@wp.func
def leave_none(worker: int, parcels: Parcels):
    """Forget what a worker left in the last turn."""
    parcels.n_contents[worker, 0] = 0
    for receiver in range(parcels.contents.shape[0]):
        parcels.n_addressed[worker, receiver] = 0


@wp.func
def deliver(size: wp.vec3i, worker: int, parcels: Parcels):
    """Once the rays of all workers are through, add what lies in parcels to a worker's own part."""
    n_workers = parcels.contents.shape[0]
    if n_workers > 1:
        if meet(parcels.turn.meeting, n_workers):
            take_in(size, worker, parcels)
