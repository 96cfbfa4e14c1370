"""Kernels of the proposal: where a ray's intervals lie, and what their weights teach it.

The proposal is a dense grid over the box of the field, whose nodes hold a density and nothing else:
so it stays in a core's cache, and rays may come in any order.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.activation import alpha_of
from ..base.parts import Space
from ..base.simd import LANES, VECTORS
from ..base.tiles import tile_of
from ..base.types import Box, Density, FreeSpace, Ray, Rays, real, vec2, vec3, vector
from ..fields.dense import dense
from ..fields.interp import flat_index, lowest_node
from ..heads.rgb import rgb
from ..sampling.resampled import (
    BINS,
    Bins,
    adj_bound,
    bin_at,
    bin_interval,
    bound,
    place_edges,
    place_edges_packed,
)
from ..sampling.traversal import pack_traversal, traversal
from ..volume.compositing import activate_density
from ..volume.loss import PHOTOMETRIC_ONLY
from ..volume.pack import pack_type, weigh
from ..volume.render_params import ray_value
from .variant import NoScratch

ENCODING = dense(1)
Grid, Gradient, Raw = ENCODING.Params, ENCODING.Gradient, vector(1)
Pack = pack_type(ENCODING, rgb(), PHOTOMETRIC_ONLY)


@wp.struct
class Guide:
    """What rays are marched through to propose."""

    box: Box
    free: FreeSpace
    bins: Bins  # its ends are written
    grid: Grid
    density: Density
    between: wp.array(dtype=vec2)  # [n_rays] distances that bins lie between; none: near and far


@wp.struct
class Histograms:
    """What bins of rays weigh, and what the way back needs of them: [n_rays, n_bins] each.

    Zeros where a bin is not active.
    """

    weights: wp.array2d(dtype=real)
    light: wp.array2d(dtype=real)  # transmittance behind a bin
    slopes: wp.array2d(dtype=real)  # d optical depth / d raw density
    mass: wp.array2d(dtype=real)  # blurred weights; on the way back the gradient of raw densities


@wp.struct
class Packs:
    """Scratch of the workers of the vector form."""

    packs: wp.array(dtype=Pack)  # [n_workers]


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const vec ux = load(pack.x) * grid.to_nodes.c[0] + grid.middle.c[0];
const vec uy = load(pack.y) * grid.to_nodes.c[1] + grid.middle.c[1];
const vec uz = load(pack.z) * grid.to_nodes.c[2] + grid.middle.c[2];
const ivec i = clamp(truncate(ux), grid.size.c[0] - 1);
const ivec j = clamp(truncate(uy), grid.size.c[1] - 1);
const ivec l = clamp(truncate(uz), grid.size.c[2] - 1);
const ivec base = (i * grid.size.c[1] + j) * grid.size.c[2] + l;
const int stride_y = grid.size.c[2], stride_x = stride_y * grid.size.c[1];
float corners[8][LANES] = {};
each(bits(load_int(pack.active)), [&](int n) {
    const float* node = (const float*)grid.values.data + base[n];
    auto column = [&](int c, const float* at) { corners[c][n] = at[0]; corners[c + 1][n] = at[1]; };
    column(0, node);
    column(2, node + stride_y);
    column(4, node + stride_x);
    column(6, node + stride_x + stride_y);
});
const vec x = ux - to_float(i), y = uy - to_float(j), z = uz - to_float(l);
auto between = [&](vec share, vec a, vec b) -> vec { return fma(share, b - a, a); };
vec along_z[4];
for (int c = 0; c < 4; ++c) {
    along_z[c] = between(z, load(corners[2 * c]), load(corners[2 * c + 1]));
}
const vec low = between(y, along_z[0], along_z[1]), high = between(y, along_z[2], along_z[3]);
store(pack.raw.data[0], between(x, low, high));
"""
)
def read_bins(grid: Grid, packs: wp.array(dtype=Pack), slot: int):
    """fields.dense.read for the bins of a pack; 0 where they are not active."""
    ...


@wp.func_native(
    VECTORS
    + r"""
const auto& pack = packs.data[slot];
const size_t at = (size_t)ray * histograms.weights.shape[1] + pack.step;
const ivec active = load_int(pack.active);
const vec zero = splat(0.0f);
*(vec_at*)(histograms.weights.data + at) = load(pack.weight);
*(vec_at*)(histograms.light.data + at) = active ? load(pack.transmittance) : zero;
*(vec_at*)(histograms.slopes.data + at) =
    active ? load(pack.sigma_slope) * load(pack.dt) : zero;
"""
)
def keep_bins(packs: wp.array(dtype=Pack), slot: int, ray: int, histograms: Histograms):
    """Write what a pack's bins weigh to the row of their ray."""
    ...


@wp.func
def forget_bins(histograms: Histograms, ray: int, begin: int):
    """No bin of a ray from one on is active."""
    for k in range(begin, histograms.weights.shape[1]):
        histograms.weights[ray, k] = real(0.0)
        histograms.light[ray, k] = real(0.0)
        histograms.slopes[ray, k] = real(0.0)


@wp.func
def add_planes(
    grid: Grid,
    position: vec3,  # contracted coordinates
    adj_density: real,  # of the raw density there
    begin: int,  # planes of nodes along x that are added to
    end: int,  # one past the last
    gradient: Gradient,  # added to
):
    """fields.dense.adj_read of a density, to some planes of nodes only."""
    u = wp.cw_mul(position, grid.to_nodes) + grid.middle
    lowest = lowest_node(u, grid.size)
    for corner in range(8):
        i = lowest[0] + corner // 4
        if begin <= i and i < end:
            j = lowest[1] + (corner // 2) % 2
            k = lowest[2] + corner % 2
            share = (
                (real(1.0) - wp.abs(u[0] - real(i)))
                * (real(1.0) - wp.abs(u[1] - real(j)))
                * (real(1.0) - wp.abs(u[2] - real(k)))
            )
            node = flat_index(i, j, k, grid.size)
            wp.atomic_add(gradient.values, node, Raw(share * adj_density))
            pair = flat_index(i, j, lowest[2], grid.size)
            gradient.touched[tile_of(pair)] = wp.uint8(1)


@cache
def proposing(space: Space, packed: bool) -> SimpleNamespace:
    """The kernels in a space.

    Args:
        space: Of the field.
        packed: Sixteen bins at a time: in float32 on the CPU, where the space has a vector form.

    Returns:
        propose_forward, propose_backward, add_bins, and Scratch of the first.
    """
    traversed = traversal(BINS, space)
    clip_ray, prepare_ray, next_sample = (
        traversed.clip_ray,
        traversed.prepare_ray,
        traversed.next_sample,
    )
    contract = space.contract
    read, place_pack = ENCODING.read, BINS.place_pack
    locate_pack = pack_traversal(space).locate_pack if packed else None
    Scratch = Packs if packed else NoScratch

    @wp.func
    def weigh_bins(guide: Guide, ray: Ray, scratch: NoScratch, worker: int, histograms: Histograms):
        """What a ray's bins weigh, which its row is told."""
        forget_bins(histograms, ray.index, 0)
        transmittance = real(1.0)
        k = int(0)
        while k < ray.end and transmittance >= guide.bins.transmittance_min:
            sample = next_sample(guide.box, guide.free, guide.bins, ray, k)
            k = sample.step + 1
            if sample.step < ray.end:
                raw = read(guide.grid, sample.position)
                activated = activate_density(guide.density, raw[0], sample.dt)
                weight = transmittance * alpha_of(
                    activated.sigma * sample.dt, activated.attenuation
                )
                transmittance *= activated.attenuation
                histograms.weights[ray.index, sample.step] = weight
                histograms.light[ray.index, sample.step] = transmittance
                histograms.slopes[ray.index, sample.step] = activated.sigma_slope * sample.dt

    @wp.func
    def weigh_packs(guide: Guide, ray: Ray, scratch: Packs, worker: int, histograms: Histograms):
        """weigh_bins, sixteen at a time; there are whole packs of them."""
        transmittance = float(1.0)
        k = int(0)
        while k < ray.end and transmittance >= guide.bins.transmittance_min:
            place_pack(guide.bins, ray, k, scratch.packs, worker)
            locate_pack(guide.box, guide.free, ray, scratch.packs, worker)
            read_bins(guide.grid, scratch.packs, worker)
            weigh(guide.density, transmittance, guide.bins.transmittance_min, scratch.packs, worker)
            keep_bins(scratch.packs, worker, ray.index, histograms)
            transmittance = scratch.packs[worker].transmittance_out
            k += wp.static(LANES)
        forget_bins(histograms, ray.index, k)

    weigh_ray, draw = (weigh_packs, place_edges_packed) if packed else (weigh_bins, place_edges)

    @wp.kernel(module="unique", enable_backward=False)
    def propose_forward(
        # launch
        first: int,
        worker: int,  # row of scratch
        # scene
        guide: Guide,
        # rays
        rays: Rays,
        # choices
        anneal: real,  # (0, 1]: power of blurred weights
        # out
        scratch: Scratch,
        out_histograms: Histograms,
        out_edges: wp.array2d(dtype=real),  # [n_rays, n + 1]
        out_weights: wp.array2d(dtype=real),  # [n_rays, n] zeros, or [0, 0]
    ):
        """Draw the intervals of rays from what the bins weigh."""
        i = first + wp.tid()
        bins = guide.bins
        between = vec2(bins.near, bins.far)
        if guide.between.shape[0] > 0:
            ends = guide.between[i]
            between = vec2(wp.max(bins.near, ends[0]), wp.min(bins.far, ends[1]))
        ray, within = clip_ray(
            guide.box,
            between,
            i,
            rays.origins[i],
            rays.directions[i],
            ray_value(rays.offsets, i),
        )
        if out_weights.shape[0] > 0:
            for k in range(out_weights.shape[1]):
                out_weights[i, k] = real(0.0)
        if within[0] < within[1]:
            bins.ends[i] = vec2(
                real(1.0) / (bins.unit + within[0]), real(1.0) / (bins.unit + within[1])
            )
            ray.begin = 0
            ray.end = bins.n
            weigh_ray(guide, ray, scratch, worker, out_histograms)
            draw(bins, i, out_histograms.weights, anneal, out_histograms.mass, out_edges)
        else:
            bins.ends[i] = vec2(real(0.0), real(0.0))
            for k in range(out_edges.shape[1]):
                out_edges[i, k] = bins.near

    @wp.kernel(module="unique", enable_backward=False)
    def propose_backward(
        # launch
        first: int,
        # scene
        bins: Bins,
        # rays
        edges: wp.array2d(dtype=real),  # [n_rays, n + 1]
        weights: wp.array2d(dtype=real),  # [n_rays, n] of intervals
        # choices
        loss_weight: real,  # of one ray
        # out
        histograms: Histograms,  # as propose_forward left them; mass is written
        out_loss: wp.array(dtype=real),  # [n_rays] the bound's
    ):
        """Adjoint of the bins' weights: from the loss of the bound to their raw densities.

        With G_k = dL/dweight of bin k, dL/dtau_k = T_{k+1} G_k - sum_{j>k} weight_j G_j.
        """
        i = first + wp.tid()
        ends = bins.ends[i]
        for k in range(bins.n):
            histograms.mass[i, k] = real(0.0)
        loss = real(0.0)
        if ends[0] > ends[1]:
            for n in range(weights.shape[1]):
                weight = weights[i, n]
                if weight > real(0.0):
                    begin = bin_at(bins, ends, edges[i, n])
                    end = bin_at(bins, ends, edges[i, n + 1]) + 1
                    most = real(0.0)
                    for k in range(begin, end):
                        most += histograms.weights[i, k]
                    if weight > most:
                        loss += bound(weight, most)
                        adj_most = adj_bound(weight, most, loss_weight)
                        for k in range(begin, end):
                            histograms.mass[i, k] += adj_most
        out_loss[i] = loss
        suffix_sum = real(0.0)
        for n in range(bins.n):
            k = bins.n - 1 - n
            adj_weight = histograms.mass[i, k]
            adj_tau = histograms.light[i, k] * adj_weight - suffix_sum
            suffix_sum += histograms.weights[i, k] * adj_weight
            histograms.mass[i, k] = histograms.slopes[i, k] * adj_tau

    @wp.kernel(module="unique", enable_backward=False)
    def add_bins(
        # launch
        first: int,
        # scene
        guide: Guide,
        # rays
        rays: Rays,
        histograms: Histograms,  # as propose_backward left them
        # choices
        parts: int,  # of the planes of nodes along x, each added to by one thread
        stride: int,  # rays from one of a thread to the next; threads of a part are as many
        # out
        out_gradient: Gradient,  # added to
    ):
        """Hand the gradient of bins to the nodes around their samples, ray by ray in each part."""
        n = first + wp.tid()
        part = n % parts
        size = guide.grid.size[0]
        begin = part * size // parts
        end = (part + 1) * size // parts
        for i in range(n // parts, rays.origins.shape[0], stride):
            ends = guide.bins.ends[i]
            if ends[0] > ends[1]:
                ray = prepare_ray(
                    guide.box,
                    guide.bins,
                    i,
                    rays.origins[i],
                    rays.directions[i],
                    ray_value(rays.offsets, i),
                )
                for k in range(guide.bins.n):
                    adj_density = histograms.mass[i, k]
                    if adj_density != real(0.0):
                        within = bin_interval(guide.bins, ray, k)
                        t = within[0] + ray.offset * within[1]
                        position = contract(guide.box, ray.q_origin + t * ray.q_direction)
                        add_planes(guide.grid, position, adj_density, begin, end, out_gradient)

    return SimpleNamespace(
        propose_forward=propose_forward,
        propose_backward=propose_backward,
        add_bins=add_bins,
        Scratch=Scratch,
    )
