"""Which steps of a ray are samples: the box, folded space, and the skipping of free space."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..base.parts import Sampler
from ..base.simd import VECTORS
from ..base.types import Box, FreeSpace, Ray, Sample, real, vec2, vec3
from ..space.contraction import L2, LINF, NDC, contract, det_jacobian_of, folds
from ..space.ndc import LEAST, distance_at, enter, length_to, stretch_at

wp.set_module_options({"enable_backward": False})


@wp.func
def slab(q_origin: real, q_direction: real, interval: vec2) -> vec2:
    """Narrows an interval of t to where |q| <= 1 along one axis."""
    enter = interval[0]
    exit = interval[1]
    if q_direction == real(0.0):
        if wp.abs(q_origin) > real(1.0):
            exit = enter - real(1.0)
    else:
        a = (real(-1.0) - q_origin) / q_direction
        b = (real(1.0) - q_origin) / q_direction
        enter = wp.max(enter, wp.min(a, b))
        exit = wp.min(exit, wp.max(a, b))
    return vec2(enter, exit)


@wp.func
def free_distance(free: FreeSpace, m: vec3) -> int:
    """Cells between the one that holds m and the nearest occupied one; 0: sample here."""
    i = wp.clamp(int(m[0]), 0, free.size[0] - 1)
    j = wp.clamp(int(m[1]), 0, free.size[1] - 1)
    k = wp.clamp(int(m[2]), 0, free.size[2] - 1)
    return int(free.distance[(i * free.size[1] + j) * free.size[2] + k])


@wp.func
def block_exit(m: real, speed: real, rings: real) -> real:
    """Distance along a ray until m leaves its cell and `rings` cells around it, on one axis."""
    within = m - wp.floor(m)
    if speed > real(0.0):
        return (rings + real(1.0) - within) / speed
    if speed < real(0.0):
        return (rings + within) / -speed
    return real(1.0e30)


@wp.func
def cell_margin(m: real) -> real:
    """Distance from m to the nearer wall of its cell, in cells."""
    within = m - wp.floor(m)
    return wp.min(within, real(1.0) - within)


@wp.func
def free_length(free: FreeSpace, ray: Ray, m: vec3, distance: int, contraction: int) -> real:
    """A distance along the ray through which nothing but free cells is met."""
    rings = real(distance - 1)
    if not folds(contraction):
        speed = wp.cw_mul(ray.q_direction, free.to_cells)
        return wp.min(
            block_exit(m[0], speed[0], rings),
            wp.min(block_exit(m[1], speed[1], rings), block_exit(m[2], speed[2], rings)),
        )
    # A contraction with border <= 1 stretches no displacement by more than 2 (largest component out
    # over length in), so whatever its direction the ray stays in the block for this long.
    widest = wp.max(wp.max(free.to_cells[0], free.to_cells[1]), free.to_cells[2])
    margin = wp.min(wp.min(cell_margin(m[0]), cell_margin(m[1])), cell_margin(m[2]))
    return (rings + margin) / (real(2.0) * wp.length(ray.q_direction) * widest)


@wp.func
def distance_of(ray: Ray, t: real, contraction: int) -> real:
    """How far from its origin a ray is at t, scene units."""
    if contraction == NDC:
        return distance_at(ray.line, t)
    return t


@wp.func
def length_of(ray: Ray, distance: real, dt: real, contraction: int) -> real:
    """How long a step dt at a distance is, scene units."""
    if contraction == NDC:
        return dt * stretch_at(ray.line, distance)
    return dt


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
vec t = load(pack.t);
const bool folds = contraction == LINF || contraction == L2;
vec qx = ray.q_origin.c[0] + t * ray.q_direction.c[0];
vec qy = ray.q_origin.c[1] + t * ray.q_direction.c[1];
vec qz = ray.q_origin.c[2] + t * ray.q_direction.c[2];
ivec visited = load_int(pack.visited);
vec det_jacobian = all(1.0f);
if (!folds) {
    visited &= (magnitude(qx) <= 1.0f) & (magnitude(qy) <= 1.0f) & (magnitude(qz) <= 1.0f);
} else {
    vec norm = contraction == L2
        ? __builtin_elementwise_sqrt(qx * qx + qy * qy + qz * qz)
        : most(most(magnitude(qx), magnitude(qy)), magnitude(qz));
    vec n = most(norm, all(1.0f));
    vec shrink = norm > 1.0f ? (1.0f + box.border - box.border / n) / n : all(1.0f);
    vec across = ((1.0f + box.border) * n - box.border) / (n * n);
    det_jacobian = norm > 1.0f ? box.border / (n * n) * across * across : det_jacobian;
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
if (contraction == NDC) {
    const vec left = most(ray.line.speed - t * ray.line.slope, all(LEAST * ray.line.speed));
    t = ray.line.t + t * ray.line.w / left;
    visited &= t < box.frustum.end;
}
store_int(pack.visited, visited);
store(pack.t, visited ? t : all(0.0f));
store(pack.det_jacobian, det_jacobian);
store(pack.x, qx);
store(pack.y, qy);
store(pack.z, qz);
""".replace("LINF", str(LINF))
    .replace("L2", str(L2))
    .replace("NDC", str(NDC))
    .replace("LEAST", f"{LEAST!r}f")
)
def locate_pack(
    box: Box,
    free: FreeSpace,
    ray: Ray,
    contraction: int,
    packs: wp.array(dtype=Any),
    slot: int,
):
    """What next_sample does with a step, for sixteen: where they are, and which are samples."""
    ...


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
vec length = load(pack.dt);
if (contraction == NDC) {
    const vec w = ray.line.w + (load(pack.t) - ray.line.t) * ray.line.slope;
    length *= w * w / (ray.line.w * ray.line.speed);
}
store(pack.length, length);
""".replace("NDC", str(NDC))
)
def measure_pack(ray: Ray, contraction: int, packs: wp.array(dtype=Any), slot: int):
    """length_of each sample of a pack, for losses."""
    ...


@cache
def traversal(sampler: Sampler) -> SimpleNamespace:
    """The functions that ask the sampler where a step lies.

    Args:
        sampler: Where steps lie.

    Returns:
        prepare_ray(box, march, index, origin, direction, offset, contraction) -> Ray,
        next_sample(box, free, march, ray, first, contraction) -> Sample.
    """
    Steps = sampler.Params
    interval_of, steps_within, step_after = (
        sampler.interval,
        sampler.steps_within,
        sampler.step_after,
    )

    @wp.func
    def prepare_ray(
        box: Box,
        march: Steps,
        index: int,
        origin: vec3,
        direction: vec3,  # unit
        offset: real,
        contraction: int,
    ) -> Ray:
        """Clip a ray to the box and to [near, far].

        A ray that is not finite or has no direction, of a lens that folds over, meets nothing.
        """
        ray = Ray()
        ray.index = index
        ray.offset = offset
        ray.direction = direction
        interval = vec2(march.near, march.far)
        if contraction == NDC:
            line, place, along = enter(box.frustum, origin, direction)
            ray.line = line
            ray.q_origin = wp.cw_div(place - box.centre, box.half)
            ray.q_direction = wp.cw_div(along, box.half)
            interval[1] = wp.min(interval[1], length_to(line, box.frustum.end))
        else:
            ray.q_origin = wp.cw_div(origin - box.centre, box.half)
            ray.q_direction = wp.cw_div(direction, box.half)
        if not folds(contraction):
            interval = slab(ray.q_origin[0], ray.q_direction[0], interval)
            interval = slab(ray.q_origin[1], ray.q_direction[1], interval)
            interval = slab(ray.q_origin[2], ray.q_direction[2], interval)
        ray.begin = int(0)
        ray.end = int(0)
        finite = wp.isfinite(ray.q_origin) and wp.isfinite(ray.q_direction)
        if interval[0] <= interval[1] and finite and wp.length_sq(ray.q_direction) > real(0.0):
            steps = steps_within(march, ray, interval)
            ray.begin = steps[0]
            ray.end = steps[1]
        return ray

    @wp.func
    def next_sample(
        box: Box,
        free: FreeSpace,
        march: Steps,
        ray: Ray,
        first: int,  # step to begin looking at
        contraction: int,
    ) -> Sample:
        """The first sample at or after step `first` that is in the box and not in free space.

        Its step is ray.end where there is none.
        """
        sample = Sample()
        sample.step = ray.end
        step = int(first)
        while step < ray.end:
            edge_and_length = interval_of(march, ray, step)
            dt = edge_and_length[1]
            t = edge_and_length[0] + ray.offset * dt
            if t >= march.far:
                return sample
            q = ray.q_origin + t * ray.q_direction
            inside = (
                wp.abs(q[0]) <= real(1.0)
                and wp.abs(q[1]) <= real(1.0)
                and wp.abs(q[2]) <= real(1.0)
            )
            if inside or folds(contraction):
                c = contract(q, box.border, contraction)
                m = wp.cw_mul(c, free.to_cells) + real(0.5) * vec3(
                    real(free.size[0]), real(free.size[1]), real(free.size[2])
                )
                distance = free_distance(free, m)
                if distance == 0:
                    sample.t = distance_of(ray, t, contraction)
                    if contraction == NDC and sample.t >= box.frustum.end:
                        return sample
                    sample.step = step
                    sample.dt = dt
                    sample.det_jacobian = det_jacobian_of(q, box.border, contraction)
                    sample.position = c
                    return sample
                step = step_after(
                    march, ray, t + free_length(free, ray, m, distance, contraction), step
                )
            else:
                step += 1
        return sample

    return SimpleNamespace(prepare_ray=prepare_ray, next_sample=next_sample)
