"""Empty-space skipping: which steps of a ray are samples, by box, contraction and free space."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..base.parts import Sampler, Space
from ..base.simd import VECTORS
from ..base.types import Box, FreeSpace, Ray, Sample, real, vec2, vec3

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
def straight_length(free: FreeSpace, ray: Ray, m: vec3, distance: int) -> real:
    """A distance along the ray through which nothing but free cells is met; c is q."""
    rings = real(distance - 1)
    speed = wp.cw_mul(ray.q_direction, free.to_cells)
    return wp.min(
        block_exit(m[0], speed[0], rings),
        wp.min(block_exit(m[1], speed[1], rings), block_exit(m[2], speed[2], rings)),
    )


@wp.func
def contracted_length(free: FreeSpace, ray: Ray, m: vec3, distance: int, stretch: real) -> real:
    """The same where space is contracted, and no displacement stretched by more than this.

    Whatever its direction, the ray stays in the block for so long.
    """
    rings = real(distance - 1)
    widest = wp.max(wp.max(free.to_cells[0], free.to_cells[1]), free.to_cells[2])
    margin = wp.min(wp.min(cell_margin(m[0]), cell_margin(m[1])), cell_margin(m[2]))
    return (rings + margin) / (stretch * wp.length(ray.q_direction) * widest)


PLACES = r"""
auto& pack = packs.data[slot];
vec t = load(pack.t);
vec qx = ray.q_origin.c[0] + t * ray.q_direction.c[0];
vec qy = ray.q_origin.c[1] + t * ray.q_direction.c[1];
vec qz = ray.q_origin.c[2] + t * ray.q_direction.c[2];
ivec active = load_int(pack.active);
vec det_jacobian = splat(1.0f);
"""

CELLS = r"""
if (free.distance.shape[0] > 1) {
    ivec i = clamp(truncate(qx * free.to_cells.c[0] + 0.5f * free.size.c[0]), free.size.c[0]);
    ivec j = clamp(truncate(qy * free.to_cells.c[1] + 0.5f * free.size.c[1]), free.size.c[1]);
    ivec l = clamp(truncate(qz * free.to_cells.c[2] + 0.5f * free.size.c[2]), free.size.c[2]);
    ivec cell = (i * free.size.c[1] + j) * free.size.c[2] + l;
    ivec distance;
    for (int n = 0; n < LANES; ++n) distance[n] = free.distance.data[cell[n]];
    active &= distance == 0;
}
"""

FOUND = r"""
store_int(pack.active, active);
store(pack.t, active ? t : splat(0.0f));
store(pack.det_jacobian, det_jacobian);
store(pack.x, qx);
store(pack.y, qy);
store(pack.z, qz);
"""

LENGTHS = r"""
auto& pack = packs.data[slot];
const vec t = load(pack.t);
vec length = load(pack.dt);
OF_SPACE
store(pack.length, length);
"""


@cache
def pack_traversal(space: Space) -> SimpleNamespace:
    """The vector form of what a space does with steps.

    Args:
        space: Which has a vector form.

    Returns:
        locate_pack(box, free, ray, packs, slot), measure_pack(ray, packs, slot).
    """
    own = space.vectors

    @wp.func_native(VECTORS + PLACES + own.locate + CELLS + own.distance + FOUND)
    def locate_pack(box: Box, free: FreeSpace, ray: Ray, packs: wp.array(dtype=Any), slot: int):
        """What next_sample does with a step, for sixteen: where they are, and which are samples."""
        ...

    @wp.func_native(VECTORS + LENGTHS.replace("OF_SPACE", own.length))
    def measure_pack(ray: Ray, packs: wp.array(dtype=Any), slot: int):
        """length_of each sample of a pack, for losses."""
        ...

    return SimpleNamespace(locate_pack=locate_pack, measure_pack=measure_pack)


@cache
def traversal(sampler: Sampler, space: Space) -> SimpleNamespace:
    """The functions that ask the sampler where a step lies, and the space what is there.

    Args:
        sampler: Where steps lie.
        space: In which coordinates.

    Returns:
        clip_ray(box, near and far, index, origin, direction, offset) -> Ray, interval of t,
        prepare_ray(box, march, index, origin, direction, offset) -> Ray,
        next_sample(box, free, march, ray, first) -> Sample.
    """
    Steps = sampler.Params
    interval_of, steps_within, step_after = (
        sampler.interval,
        sampler.steps_within,
        sampler.step_after,
    )
    contracts, stretch = space.contracts, space.stretch
    enter, contract, det_jacobian = space.enter, space.contract, space.det_jacobian
    distance_of, ends = space.distance_of, space.ends

    @wp.func
    def clip_ray(
        box: Box,
        between: vec2,  # near and far
        index: int,
        origin: vec3,
        direction: vec3,  # unit
        offset: real,
    ):
        """A ray without its steps, and which interval of t may hold samples.

        That ends before it begins where there is none: where the ray misses the box, is not finite
        or has no direction, of a lens that folds over.
        """
        ray = Ray()
        ray.index = index
        ray.offset = offset
        ray.direction = direction
        ray, interval = enter(box, ray, origin, between)
        if wp.static(not contracts):
            interval = slab(ray.q_origin[0], ray.q_direction[0], interval)
            interval = slab(ray.q_origin[1], ray.q_direction[1], interval)
            interval = slab(ray.q_origin[2], ray.q_direction[2], interval)
        finite = wp.isfinite(ray.q_origin) and wp.isfinite(ray.q_direction)
        if not (finite and wp.length_sq(ray.q_direction) > real(0.0)):
            interval = vec2(real(1.0), real(0.0))
        return ray, interval

    @wp.func
    def prepare_ray(
        box: Box,
        march: Steps,
        index: int,
        origin: vec3,
        direction: vec3,  # unit
        offset: real,
    ) -> Ray:
        """Clip a ray to the box and to [near, far]; it may have no steps there."""
        ray, interval = clip_ray(box, vec2(march.near, march.far), index, origin, direction, offset)
        ray.begin = int(0)
        ray.end = int(0)
        if interval[0] <= interval[1]:
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
            if inside or wp.static(contracts):
                c = contract(box, q)
                m = wp.cw_mul(c, free.to_cells) + real(0.5) * vec3(
                    real(free.size[0]), real(free.size[1]), real(free.size[2])
                )
                distance = free_distance(free, m)
                if distance == 0:
                    sample.t = distance_of(ray, t)
                    if ends(box, sample.t):
                        return sample
                    sample.step = step
                    sample.dt = dt
                    sample.det_jacobian = det_jacobian(box, q)
                    sample.position = c
                    return sample
                leap = real(0.0)
                if wp.static(contracts):
                    leap = contracted_length(free, ray, m, distance, real(stretch))
                else:
                    leap = straight_length(free, ray, m, distance)
                step = step_after(march, ray, t + leap, step)
            else:
                step += 1
        return sample

    return SimpleNamespace(clip_ray=clip_ray, prepare_ray=prepare_ray, next_sample=next_sample)
