"""Sixteen samples of a ray at a time: integral.py in vectors, for a CPU's cores.

A core computes many numbers as fast as one, but only where code says so. It computes sixteen in
less time than eight twice, even where they take two instructions each: a sample is a long chain of
operations that wait for each other. Each function here is the vector form of the plain one that its
docstring names, and tests hold the two together. CUDA, where threads are the vector, and float64,
which is for checking, run the plain ones.

The bodies are C++ on Clang's vector types, which compile for any processor. A native function
cannot return a vector: they hand on what they compute in a ``Pack``, scratch memory of a worker.
"""

import warp as wp

from .contraction import L2, NONE
from .types import FreeSpace, Grid, March, Ray
from .vectors import VECTORS, by_column, float3, float4, lanes, lanes_int

wp.set_module_options({"enable_backward": False})


@wp.struct
class Pack:
    """Sixteen consecutive steps of a ray, which of them are samples, and what those hold."""

    step: int  # of the first lane
    n_samples: int
    passed: wp.float32  # light that passes the pack
    behind: wp.float32  # of what flows back, the part that lies behind the pack
    integral: float4  # sums of weight times (red, green, blue, t)
    visited: lanes_int  # -1 where a step is a sample, 0 where it is not
    t: lanes  # distance from the ray's origin
    dt: lanes  # step length
    det_jacobian: lanes  # |det J| of the contraction, 1 without
    base: lanes_int  # flat index of the lowest of the eight nodes around
    shares: by_column  # of the four columns of nodes around, by x and y; together 1
    fraction_x: lanes  # position between the nodes, [0, 1]
    fraction_y: lanes
    fraction_z: lanes
    sigma_slope: lanes  # d sigma / d raw density
    attenuation: lanes  # exp(-sigma dt)
    alpha: lanes  # 1 - attenuation
    red: lanes  # [0, 1]
    green: lanes
    blue: lanes
    weight: lanes  # transmittance times alpha; 0 where not visited
    transmittance: lanes  # what passes the samples up to this one, it included
    scale: lanes  # of the gradient, by distance
    adj_sigma: lanes
    adj_red: lanes
    adj_green: lanes
    adj_blue: lanes


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const ivec k = step + lane;
vec begin = march.near + to_float(k) * march.step;
vec dt = all(march.step);
if (march.growth != 0.0f) {
    ivec n = k - (step > march.n_linear ? step : march.n_linear);
    vec power = all(1.0f);
    float g = 1.0f + march.growth;
    for (int bit = 1; bit < LANES; bit *= 2, g *= g) power *= (n & bit) != 0 ? all(g) : all(1.0f);
    begin = n < 0 ? begin : edge * power;
    dt = n < 0 ? dt : begin * march.growth;
}
vec t = begin + ray.offset * dt;
vec qx = ray.q_origin.c[0] + t * ray.q_direction.c[0];
vec qy = ray.q_origin.c[1] + t * ray.q_direction.c[1];
vec qz = ray.q_origin.c[2] + t * ray.q_direction.c[2];
ivec visited = (k < ray.end) & (t < march.far);
vec det_jacobian = all(1.0f);
if (contraction == NONE) {
    visited &= (magnitude(qx) <= 1.0f) & (magnitude(qy) <= 1.0f) & (magnitude(qz) <= 1.0f);
} else {
    vec norm = contraction == L2
        ? __builtin_elementwise_sqrt(qx * qx + qy * qy + qz * qz)
        : most(most(magnitude(qx), magnitude(qy)), magnitude(qz));
    vec n = most(norm, all(1.0f));
    vec shrink = norm > 1.0f ? (1.0f + grid.border - grid.border / n) / n : all(1.0f);
    vec across = ((1.0f + grid.border) * n - grid.border) / (n * n);
    det_jacobian = norm > 1.0f ? grid.border / (n * n) * across * across : det_jacobian;
    qx *= shrink;
    qy *= shrink;
    qz *= shrink;
}
if (free.distance.shape[0] > 1) {
    ivec i = clamp(truncate(qx * free.to_cells.c[0] + 0.5f * free.size.c[0]), free.size.c[0]);
    ivec j = clamp(truncate(qy * free.to_cells.c[1] + 0.5f * free.size.c[1]), free.size.c[1]);
    ivec l = clamp(truncate(qz * free.to_cells.c[2] + 0.5f * free.size.c[2]), free.size.c[2]);
    ivec cell = (i * free.size.c[1] + j) * free.size.c[2] + l;
    ivec distance;
    for (int n = 0; n < LANES; ++n) distance[n] = free.distance.data[cell[n]];
    visited &= distance == 0;
}
vec ux = qx * grid.to_nodes.c[0] + grid.middle.c[0];
vec uy = qy * grid.to_nodes.c[1] + grid.middle.c[1];
vec uz = qz * grid.to_nodes.c[2] + grid.middle.c[2];
auto index = [&](ivec i, ivec j, ivec l) -> ivec {
    return (i * grid.size.c[1] + j) * grid.size.c[2] + l;
};
ivec i = clamp(truncate(ux), grid.size.c[0] - 1);
ivec j = clamp(truncate(uy), grid.size.c[1] - 1);
ivec l = clamp(truncate(uz), grid.size.c[2] - 1);
store_int(pack.visited, visited);
store(pack.t, visited ? t : all(0.0f));
store(pack.dt, dt);
store(pack.det_jacobian, det_jacobian);
store_int(pack.base, index(i, j, l));
const vec fraction_x = visited ? ux - to_float(i) : all(0.0f);
const vec fraction_y = visited ? uy - to_float(j) : all(0.0f);
split(fraction_x, fraction_y, pack.shares.data);
store(pack.fraction_x, fraction_x);
store(pack.fraction_y, fraction_y);
store(pack.fraction_z, visited ? uz - to_float(l) : all(0.0f));
pack.step = step;
// Memory is slower than all of this: fetch what the next pack will read, going straight on.
vec ahead = (float)LANES * dt;
ux += ahead * (ray.q_direction.c[0] * grid.to_nodes.c[0]);
uy += ahead * (ray.q_direction.c[1] * grid.to_nodes.c[1]);
uz += ahead * (ray.q_direction.c[2] * grid.to_nodes.c[2]);
i = clamp(truncate(ux), grid.size.c[0] - 1);
j = clamp(truncate(uy), grid.size.c[1] - 1);
l = clamp(truncate(uz), grid.size.c[2] - 1);
ivec node = index(i, j, l);
for (int n = 0; n < LANES; ++n) fetch(grid.values.data + node[n], grid.size);
""".replace("NONE", str(NONE)).replace("L2", str(L2))
)
def place(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    step: int,  # of the first lane
    edge: wp.float32,  # where step max(step, n_linear) begins
    contraction: int,
    packs: wp.array(dtype=Pack),
    slot: int,
):
    """integral.next_sample for sixteen steps in a row: where they are, and which are samples.

    Equal steps are rounded as there, so that both visit the same samples.
    """
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const float* values = (const float*)grid.values.data;
const size_t stride_y = 4 * (size_t)grid.size.c[2], stride_x = stride_y * grid.size.c[1];
const auto& shares = pack.shares.data;
quad raw[LANES];
#pragma clang loop unroll(full)
for (int n = 0; n < LANES; ++n) {
    // A column's two nodes lie side by side: one vector holds both.
    auto column = [&](const float* node) -> octet { return *(const octet_at*)node; };
    const float* node = values + 4 * (size_t)pack.base.c[n];
    octet both = shares[0][n] * column(node);
    both = fma(octet(shares[1][n]), column(node + stride_y), both);
    both = fma(octet(shares[2][n]), column(node + stride_x), both);
    both = fma(octet(shares[3][n]), column(node + stride_x + stride_y), both);
    raw[n] = fma(quad(pack.fraction_z.c[n]), both.hi - both.lo, both.lo);
}
vec density, red, green, blue;
to_lanes(raw, density, red, green, blue);
density += grid.density_shift;
vec e = exponential(-magnitude(density));
vec sigma = grid.density_scale * ((density < 0.0f ? all(0.0f) : density) + log1p(e));
vec slope = (density >= 0.0f ? all(1.0f) : e) / (1.0f + e);
vec tau = sigma * load(pack.dt);
vec attenuation = exponential(-tau);
vec series = fma(all(-1.0f / 24.0f), tau, all(1.0f / 6.0f));
series = fma(fma(series, -tau, all(0.5f)), -tau, all(1.0f));
store(pack.sigma_slope, grid.density_scale * slope);
store(pack.attenuation, attenuation);
store(pack.alpha, tau < 0.01f ? tau * series : 1.0f - attenuation);
store(pack.red, sigmoid(red));
store(pack.green, sigmoid(green));
store(pack.blue, sigmoid(blue));
"""
)
def shade(grid: Grid, packs: wp.array(dtype=Pack), slot: int):
    """integral.shade, from interp.gather to activation.opacity_of, for the samples of a pack."""
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
ivec visited = load_int(pack.visited);
vec light = transmittance * running_product(visited ? load(pack.attenuation) : all(1.0f));
vec before = UP_1(light, all(transmittance));
ivec lit = ~(before < transmittance_min);
visited &= lit;
vec weight = visited ? before * load(pack.alpha) : all(0.0f);
store_int(pack.visited, visited);
store(pack.weight, weight);
store(pack.transmittance, light);
pack.n_samples = count(visited);
pack.passed = pack.transmittance.c[count(lit) - 1];
pack.integral.c[0] = sum(weight * load(pack.red));
pack.integral.c[1] = sum(weight * load(pack.green));
pack.integral.c[2] = sum(weight * load(pack.blue));
pack.integral.c[3] = sum(weight * load(pack.t));
"""
)
def composite(
    transmittance: wp.float32,  # of what lies before, at least transmittance_min
    transmittance_min: wp.float32,  # nothing is sampled once less light than this passes
    packs: wp.array(dtype=Pack),
    slot: int,
):
    """What integral.integrate does with a sample, for those of a pack."""
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
float adj_red = adj_rgb.c[0], adj_green = adj_rgb.c[1], adj_blue = adj_rgb.c[2];
vec weight = load(pack.weight);
vec adj_weight = fma(all(adj_depth), load(pack.t), adj_blue * load(pack.blue));
adj_weight = fma(all(adj_green), load(pack.green), adj_weight);
adj_weight = fma(all(adj_red), load(pack.red), adj_weight);
vec light = load(pack.transmittance);
vec left = behind - running_sum(weight * adj_weight);
left = least(most(left, -limit * light), limit * light);
vec adj_tau = fma(light, adj_weight, -left);
vec scale = load(pack.scale);
store(pack.adj_sigma, scale * (load(pack.dt) * adj_tau));
store(pack.adj_red, scale * (weight * adj_red));
store(pack.adj_green, scale * (weight * adj_green));
store(pack.adj_blue, scale * (weight * adj_blue));
pack.behind = left[LANES - 1];
"""
)
def adj_composite(
    adj_rgb: float3,
    adj_depth: wp.float32,
    behind: wp.float32,  # what lies behind the pack before this one
    limit: wp.float32,  # of what lies behind, for each unit of light
    packs: wp.array(dtype=Pack),
    slot: int,
):
    """What integral.adj_integrate does with a sample, for those of a pack."""
    ...
