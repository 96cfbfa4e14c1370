"""Steps drawn for each ray from a proposal: a histogram of where its light may end.

A ray's bins (``BINS``) have equal widths in 1 / (unit + t). Their weights come from a small grid of
densities, the proposal; blurred, they are what the ray's intervals (``INTERVALS``) are drawn from,
each of which gets as much of the sum. The proposal learns to bound what the intervals then weigh.

Source: Barron et al. 2022 (Mip-NeRF 360), sections 3 and 5; the blur is that of mip-NeRF, Barron et
al. 2021, in place of their dilation. launch.propose has the kernels. Derivation: kernels/README.md.
"""

from typing import Any

import warp as wp

from ..base.parts import Sampler
from ..base.simd import VECTORS
from ..base.types import Ray, real, vec2
from .steps import March, longest_step

wp.set_module_options({"enable_backward": False})

PADDING = 0.01
"""Of a histogram's sum, about, that is spread evenly over its bins, so that none is never looked
at."""

EPSILON = 1e-7
"""Weights far below it count for nothing in the bound."""


@wp.struct
class Bins:
    """Where the bins of rays lie."""

    ends: wp.array(dtype=vec2)  # [n_rays] 1 / (unit + t) where they begin and end; alike: none
    n: int  # of each ray
    unit: real  # scene units: up to about this distance bins are equally long; 0: nowhere
    near: real
    far: real
    transmittance_min: real  # nothing is sampled once less light than this passes


@wp.func
def bin_width(bins: Bins, ends: vec2) -> real:
    """Of a ray's bins, in 1 / (unit + t)."""
    return (ends[0] - ends[1]) / real(bins.n)


@wp.func
def bin_edge(bins: Bins, ray: Ray, k: int) -> real:
    """Distance at which bin k begins: counted from the end, where digits are lost first."""
    ends = bins.ends[ray.index]
    return real(1.0) / (ends[1] + real(bins.n - k) * bin_width(bins, ends)) - bins.unit


@wp.func
def bin_interval(bins: Bins, ray: Ray, k: int) -> vec2:
    """Where bin k begins, and its length, not by a difference, which would lose digits."""
    ends = bins.ends[ray.index]
    width = bin_width(bins, ends)
    begin = ends[1] + real(bins.n - k) * width
    end = ends[1] + real(bins.n - k - 1) * width
    return vec2(real(1.0) / begin - bins.unit, width / (begin * end))


@wp.func
def bin_at(bins: Bins, ends: vec2, t: real) -> int:
    """The bin that holds a distance; the nearest where none does."""
    k = (ends[0] - real(1.0) / (bins.unit + t)) / bin_width(bins, ends)
    return wp.clamp(int(k), 0, bins.n - 1)


@wp.func
def all_bins(bins: Bins, ray: Ray, interval: vec2) -> wp.vec2i:
    """A ray's bins lie within what it may be sampled in."""
    return wp.vec2i(0, bins.n)


@wp.func
def bin_after(bins: Bins, ray: Ray, t: real, step: int) -> int:
    """First bin after `step` whose sample may lie at t or beyond: the one before that of t."""
    ends = bins.ends[ray.index]
    k = (ends[0] - real(1.0) / (bins.unit + t)) / bin_width(bins, ends)
    return wp.max(step + 1, int(wp.min(k, real(bins.n)) - real(1.0e-3)))


@wp.func
def longest_bin(bins: Bins, boxes_out: real) -> real:
    """No bin is longer than all of them."""
    return bins.far - bins.near


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const ivec k = step + lane;
const auto ends = bins.ends.data[ray.index];
const float width = (ends.c[0] - ends.c[1]) / bins.n;
const vec begin = ends.c[1] + to_float(bins.n - k) * width;
const vec end = ends.c[1] + to_float(bins.n - 1 - k) * width;
const vec dt = width / (begin * end);
const vec t = (1.0f / begin - bins.unit) + ray.offset * dt;
pack.step = step;
store_int(pack.active, (k < ray.end) & (t < bins.far));
store(pack.t, t);
store(pack.dt, dt);
"""
)
def place_bins(bins: Bins, ray: Ray, step: int, packs: wp.array(dtype=Any), slot: int):
    """Sixteen bins in a row: t and dt, and which of them lie before the ray's end."""
    ...


BINS = Sampler(
    Params=Bins,
    interval=bin_interval,
    edge=bin_edge,
    steps_within=all_bins,
    step_after=bin_after,
    longest=longest_bin,
    place_pack=place_bins,
)
"""The sampler of the proposal."""


@wp.func
def blurred(
    weights: wp.array2d(dtype=real),  # [n_rays, n_bins]
    ray: int,
    k: int,
) -> real:
    """A bin's weight as intervals are drawn from it: the mean of the larger ones of it and each of
    its neighbours, and padding.
    """
    n = weights.shape[1]
    here = weights[ray, k]
    before = wp.max(here, weights[ray, wp.max(k - 1, 0)])
    after = wp.max(here, weights[ray, wp.min(k + 1, n - 1)])
    return real(0.5) * (before + after) + real(wp.static(PADDING)) / real(n)


@wp.func
def place_edges(
    bins: Bins,
    ray: int,
    weights: wp.array2d(dtype=real),  # [n_rays, n_bins]
    anneal: real,  # (0, 1]: power of blurred weights
    mass: wp.array2d(dtype=real),  # [n_rays, n_bins] written
    out_edges: wp.array2d(dtype=real),  # [n_rays, n + 1] written, in rising order
):
    """The edges of a ray's intervals, each of which gets as much of the histogram.

    The first begins where the bins do, the last ends where these do.
    """
    n_bins = weights.shape[1]
    n = out_edges.shape[1] - 1
    total = real(0.0)
    for k in range(n_bins):
        here = blurred(weights, ray, k)
        if anneal < real(1.0):
            here = wp.pow(here, anneal)
        mass[ray, k] = here
        total += here
    ends = bins.ends[ray]
    width = bin_width(bins, ends)
    before = real(0.0)  # mass of the bins before bin k
    k = int(0)
    for edge in range(n + 1):
        wanted = total * (real(edge) / real(n))
        while k < n_bins - 1 and before + mass[ray, k] < wanted:
            before += mass[ray, k]
            k += 1
        share = wp.clamp((wanted - before) / mass[ray, k], real(0.0), real(1.0))
        left = real(n_bins - k) - share  # bins behind the edge
        out_edges[ray, edge] = real(1.0) / (ends[1] + left * width) - bins.unit


@wp.func_native(
    VECTORS
    + f"constexpr float PADDING = {PADDING}f;"
    + r"""
const int n_bins = weights.shape[1], n = out_edges.shape[1] - 1;
const float* row = weights.data + (size_t)ray * n_bins;
float* heights = mass.data + (size_t)ray * n_bins;
float* edges = out_edges.data + (size_t)ray * (n + 1);
const auto ends = bins.ends.data[ray];
const float width = (ends.c[0] - ends.c[1]) / n_bins;
vec sums = splat(0.0f);
for (int k = 0; k < n_bins; k += LANES) {
    const bool last = k + LANES == n_bins;
    const vec here = *(const vec_at*)(row + k);
    const vec before = k == 0 ? SHIFT_LANES_1(here, splat(here[0])) : *(const vec_at*)(row + k - 1);
    vec after = here;
    for (int n = 0; n < LANES; ++n) after[n] = row[last && n == LANES - 1 ? k + n : k + n + 1];
    vec height = 0.5f * (max(here, before) + max(here, after)) + PADDING / n_bins;
    if (anneal < 1.0f) {
        for (int n = 0; n < LANES; ++n) height[n] = powf(height[n], anneal);
    }
    *(vec_at*)(heights + k) = height;
    sums += height;
}
const float each_one = sum(sums) / n;
float before = 0.0f;  // mass of the bins before bin k
int k = 0;
for (int edge = 0; edge <= n; ++edge) {
    const float wanted = edge * each_one;
    while (k < n_bins - 1 && before + heights[k] < wanted) before += heights[k++];
    const float share = (wanted - before) / heights[k];
    const float left = (n_bins - k) - (share < 0.0f ? 0.0f : share > 1.0f ? 1.0f : share);
    edges[edge] = 1.0f / (ends.c[1] + left * width) - bins.unit;
}
"""
)
def place_edges_packed(
    bins: Bins,
    ray: int,
    weights: wp.array2d(dtype=wp.float32),
    anneal: wp.float32,
    mass: wp.array2d(dtype=wp.float32),
    out_edges: wp.array2d(dtype=wp.float32),
):
    """place_edges, blurring sixteen bins at a time."""
    ...


@wp.func
def bound(weight: real, most: real) -> real:
    """Loss of an interval that weighs more than the bins that it overlaps.

    Source: Barron et al. 2022, eq. 13.
    """
    above = wp.max(weight - most, real(0.0))
    return above * above / (weight + real(wp.static(EPSILON)))


@wp.func
def adj_bound(weight: real, most: real, adj_loss: real) -> real:
    """Adjoint of bound with respect to what the bins weigh; the interval's own is a constant."""
    above = wp.max(weight - most, real(0.0))
    return real(-2.0) * adj_loss * above / (weight + real(wp.static(EPSILON)))


@wp.struct
class Intervals:
    """Where the steps of rays lie, and what samples in them weigh."""

    edges: wp.array2d(dtype=real)  # [n_rays, n + 1] in rising order, scene units
    out_weights: wp.array2d(dtype=real)  # [n_rays, n] of active ones; [0, 0]: nobody asks
    march: March  # by whose steps cells are free
    near: real
    far: real
    transmittance_min: real


@wp.func
def edge(intervals: Intervals, ray: Ray, k: int) -> real:
    """Distance at which interval k begins."""
    return intervals.edges[ray.index, k]


@wp.func
def interval(intervals: Intervals, ray: Ray, k: int) -> vec2:
    """Where interval k begins, and its length."""
    begin = intervals.edges[ray.index, k]
    return vec2(begin, intervals.edges[ray.index, k + 1] - begin)


@wp.func
def all_intervals(intervals: Intervals, ray: Ray, within: vec2) -> wp.vec2i:
    """A ray's intervals lie within what it may be sampled in."""
    return wp.vec2i(0, intervals.edges.shape[1] - 1)


@wp.func
def interval_after(intervals: Intervals, ray: Ray, t: real, step: int) -> int:
    """First interval after `step` that ends at t or beyond."""
    low = step + 1
    high = wp.max(low, intervals.edges.shape[1] - 1)
    while low < high:
        middle = (low + high) // 2
        if intervals.edges[ray.index, middle + 1] < t:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def longest_interval(intervals: Intervals, boxes_out: real) -> real:
    """That of the steps that a march would take: so what is free depends on no proposal."""
    return longest_step(intervals.march, boxes_out)


@wp.func
def keep_weight(intervals: Intervals, ray: Ray, step: int, weight: real):
    """Tell the proposal what it has to bound."""
    if intervals.out_weights.shape[0] > 0:
        intervals.out_weights[ray.index, step] = weight


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const ivec k = step + lane;
const int last = intervals.edges.shape[1] - 1;
const float* row = intervals.edges.data + (size_t)ray.index * (last + 1);
vec begin, end;
if (step + LANES <= last) {
    begin = *(const vec_at*)(row + step);
    end = *(const vec_at*)(row + step + 1);
} else {
    for (int n = 0; n < LANES; ++n) {
        begin[n] = row[step + n < last ? step + n : last];
        end[n] = row[step + n + 1 < last ? step + n + 1 : last];
    }
}
const vec dt = end - begin;
const vec t = begin + ray.offset * dt;
pack.step = step;
store_int(pack.active, (k < ray.end) & (t < intervals.far));
store(pack.t, t);
store(pack.dt, dt);
"""
)
def place_intervals(
    intervals: Intervals, ray: Ray, step: int, packs: wp.array(dtype=Any), slot: int
):
    """Sixteen intervals in a row: t and dt, and which of them lie before the ray's end."""
    ...


@wp.func_native(
    VECTORS
    + r"""
if (intervals.out_weights.shape[0] == 0) return;
const auto& pack = packs.data[slot];
float* row = intervals.out_weights.data + (size_t)ray.index * intervals.out_weights.shape[1];
each(bits(load_int(pack.active)), [&](int n) { row[pack.step + n] = pack.weight.c[n]; });
"""
)
def keep_weights(intervals: Intervals, ray: Ray, packs: wp.array(dtype=Any), slot: int):
    """keep_weight for the samples of a pack."""
    ...


INTERVALS = Sampler(
    Params=Intervals,
    interval=interval,
    edge=edge,
    steps_within=all_intervals,
    step_after=interval_after,
    longest=longest_interval,
    keep=keep_weight,
    place_pack=place_intervals,
    keep_pack=keep_weights,
)
"""The sampler of what is resampled."""
