"""How the gradients of samples get into the grid on a CPU with several workers.

Rays cross the grid in every direction; adding as they go, threads would race for its nodes. So each
worker owns a part of the grid, some planes of nodes along x, and is the only one to add to it. What
its rays have for its own part it adds at once; what they have for another's it leaves in parcels, a
sample in each. Once all rays are through, each worker adds what the others have left for it. That
is the less, the more of a ray goes through the part of the worker that has it: rays are shared out
along x by where their middles lie, to each worker as much work. What is added to a node, and in
which order, depends on nothing but the rays and the number of workers.

Like packs.py this is for float32 on the CPU, and most of it C++ on Clang's vector types.
"""

from functools import cache

import warp as wp

from .contraction import contract
from .march import prepare_ray, step_edge
from .packs import Pack
from .types import Gradient, Grid, March, real, vec3
from .vectors import VECTORS, float3, float4

wp.set_module_options({"enable_backward": False})

BLOCK = 64
"""Parcels from one worker to another that lie side by side in memory."""


@wp.struct
class Parcel:
    """What a sample has for the nodes around it, of which some belong to another worker."""

    adj: float4  # of the grid's raw values at the sample
    fraction: float3  # position between the nodes, [0, 1]
    base: int  # flat index of the lowest of the eight nodes


@wp.struct
class Parcels:
    """Parcels on their way between workers: chains of blocks from each to each."""

    contents: wp.array2d(dtype=Parcel)  # [n_workers, BLOCK * n_blocks] by sender
    next: wp.array2d(dtype=wp.int32)  # [n_workers, n_blocks] the block that follows in the chain
    # By sender, in rows of whole cache lines, and by receiver:
    first_block: wp.array2d(dtype=wp.int32)  # of the chain
    end: wp.array2d(dtype=wp.int32)  # one past its last parcel; 0 if there is none
    used: wp.array2d(dtype=wp.int32)  # by sender alone: blocks that are in use
    gradient: Gradient  # where it all goes
    order: wp.array(dtype=wp.int32)  # [n_rays] all of the first worker's, of the second's, ...


WORDS = (
    VECTORS
    + f"constexpr int BLOCK = {BLOCK}, AHEAD = 16;"
    + r"""
const int n_workers = parcels.end.shape[0];
const int row = parcels.end.shape[1];  // numbers in a sender's row
const int n_planes = (size.c[0] + n_workers - 1) / n_workers;  // of nodes, for each worker
const int own_first = worker * n_planes, own_end = own_first + n_planes;
const int stride_y = size.c[2], stride_x = stride_y * size.c[1];
auto* values = parcels.gradient.values.data;
auto* flags = parcels.gradient.touched.data;
// Give a column's two nodes their shares of what a sample has, split by its position along z.
auto add_column = [&](int node, float share, quad low, quad high) {
    quad_at* pair = (quad_at*)(values + node);
    pair[0] = fma(quad(share), low, quad(pair[0]));
    pair[1] = fma(quad(share), high, quad(pair[1]));
    flags[(unsigned)node / TILE] = 1;  // on the border of two parts by either, with the same 1
};
"""
)
"""What hand_out and take_in begin with; it uses their arguments size, worker and parcels."""


@wp.func_native(
    WORDS
    + r"""
auto& pack = packs.data[slot];
auto own = [&](ivec i) -> unsigned { return bits((own_first <= i) & (i < own_end)); };
each(own(load_int(packs.data[later].i)), [&](int n) {
    fetch(values + packs.data[later].base.c[n], size);
});
vec red = load(pack.red), green = load(pack.green), blue = load(pack.blue);
quad adj[LANES];
to_quads(
    load(pack.sigma_slope) * load(pack.adj_sigma),
    red * (1.0f - red) * load(pack.adj_red),
    green * (1.0f - green) * load(pack.adj_green),
    blue * (1.0f - blue) * load(pack.adj_blue),
    adj);
auto send = [&](int n, int receiver) {
    auto* contents = parcels.contents.data + (size_t)worker * parcels.contents.shape[1];
    int* next = parcels.next.data + (size_t)worker * parcels.next.shape[1];
    int& used = parcels.used.data[worker * row];
    int& first = parcels.first_block.data[worker * row + receiver];
    int& end = parcels.end.data[worker * row + receiver];
    if (end % BLOCK == 0) {
        if (end == 0) first = used;
        else next[end / BLOCK - 1] = used;
        end = BLOCK * used++;
    }
    auto& parcel = contents[end++];
    *(quad_at*)&parcel.adj = adj[n];
    parcel.fraction.c[0] = pack.fraction_x.c[n];
    parcel.fraction.c[1] = pack.fraction_y.c[n];
    parcel.fraction.c[2] = pack.fraction_z.c[n];
    parcel.base = pack.base.c[n];
};
auto add_plane = [&](int n, int base, float share, float share_y) {
    quad high = pack.fraction_z.c[n] * adj[n], low = adj[n] - high;
    add_column(base, share, low, high);
    add_column(base + stride_y, share_y, low, high);
};
auto add_lower = [&](int n) {
    add_plane(n, pack.base.c[n], pack.share_00.c[n], pack.share_01.c[n]);
};
auto add_upper = [&](int n) {
    add_plane(n, pack.base.c[n] + stride_x, pack.share_10.c[n], pack.share_11.c[n]);
};
const ivec i = load_int(pack.i);
const unsigned visited = bits(load_int(pack.visited));
const unsigned lower = own(i), upper = own(i + 1);
if ((lower & upper & visited) == visited) {
    #pragma clang loop unroll(full)
    for (int n = 0; n < LANES; ++n) {
        if (!(visited >> n & 1)) continue;
        add_lower(n);
        add_upper(n);
    }
} else {
    each(visited, [&](int n) {
        const bool own_lower = lower >> n & 1, own_upper = upper >> n & 1;
        if (own_lower) add_lower(n);
        else send(n, i[n] / n_planes);
        if (own_upper) add_upper(n);
        else if (own_lower || (i[n] + 1) % n_planes == 0) send(n, (i[n] + 1) / n_planes);
    });
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
    """integral.adj_shade, down to interp.adj_gather, for a pack; or as far as parcels."""
    ...


@wp.func_native(
    WORDS
    + r"""
auto add = [&](const auto& parcel) {
    const quad adj = *(const quad_at*)&parcel.adj;
    const float fx = parcel.fraction.c[0], fy = parcel.fraction.c[1], fz = parcel.fraction.c[2];
    const quad high = fz * adj, low = adj - high;
    const int base = parcel.base;
    if (base >= (long long)own_first * stride_x) {
        add_column(base, (1.0f - fx) * (1.0f - fy), low, high);
        add_column(base + stride_y, (1.0f - fx) * fy, low, high);
    }
    if (base + stride_x < (long long)own_end * stride_x) {
        add_column(base + stride_x, fx * (1.0f - fy), low, high);
        add_column(base + stride_x + stride_y, fx * fy, low, high);
    }
};
for (int sender = 0; sender < n_workers; ++sender) {
    const auto* contents = parcels.contents.data + (size_t)sender * parcels.contents.shape[1];
    const int* next = parcels.next.data + (size_t)sender * parcels.next.shape[1];
    int block = parcels.first_block.data[sender * row + worker];
    int& end = parcels.end.data[sender * row + worker];
    while (end) {
        const auto* parcel = contents + (size_t)BLOCK * block;
        const bool is_last = block == (end - 1) / BLOCK;
        const int n_here = is_last ? end - BLOCK * block : BLOCK;
        for (int n = 0; n < AHEAD && n < n_here; ++n) fetch(values + parcel[n].base, size);
        for (int n = 0; n < n_here; ++n) {
            if (n + AHEAD < n_here) fetch(values + parcel[n + AHEAD].base, size);
            add(parcel[n]);
        }
        if (is_last) end = 0;
        else block = next[block];
    }
}
"""
)
def take_in(size: wp.vec3i, worker: int, parcels: Parcels):
    """Add what others have left for a worker."""
    ...


@wp.kernel
def deliver_parcels(first: int, size: wp.vec3i, parcels: Parcels):
    """Add what lies in parcels to the grid's gradient, each worker to its own part."""
    take_in(size, first + wp.tid(), parcels)


RAY = 4
"""What a ray takes besides its steps, in steps."""


@cache
def measure_rays_kernel(contraction: int) -> wp.Kernel:
    """How much work rays are, and where along x their middle steps lie."""

    @wp.kernel(module="unique", enable_backward=False)
    def measure_rays(
        first: int,
        grid: Grid,
        march: March,
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        out_work: wp.array(dtype=wp.int32),  # [n_rays] steps in the grid, and RAY
        out_middle: wp.array(dtype=wp.uint16),  # [n_rays] 0: first plane of nodes; 65535: last
    ):
        i = first + wp.tid()
        ray = prepare_ray(grid, march, origins[i], directions[i], real(0.0), contraction)
        t = wp.min(step_edge(march, (ray.begin + ray.end) // 2), march.far)
        q = contract(ray.q_origin + t * ray.q_direction, grid.border, contraction)
        x = (q[0] * grid.to_nodes[0] + grid.middle[0]) / (real(2.0) * grid.middle[0])
        out_work[i] = ray.end - ray.begin + wp.static(RAY)
        out_middle[i] = wp.uint16(wp.clamp(x, real(0.0), real(1.0)) * real(65535.0))

    return measure_rays
