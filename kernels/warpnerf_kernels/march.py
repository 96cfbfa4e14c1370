"""Where a ray is sampled: the box interval, the placing of steps, and the skipping of free space.

Sample k sits at edge(k) + offset (edge(k + 1) - edge(k)). Neither the box nor free space moves a
sample: they only decide which ones are visited. So skipping is exact, and a ray walked twice visits
the same samples twice.
"""

import warp as wp

from .contraction import NONE
from .types import FreeSpace, Grid, March, Ray, real, vec2, vec3


@wp.func
def step_edge(march: March, k: int) -> real:
    """Distance at which step k begins: equal steps, then geometrically growing ones."""
    if k <= march.n_linear or march.growth == real(0.0):
        return march.near + real(k) * march.step
    linear = march.near + real(march.n_linear) * march.step
    return linear * wp.pow(real(1.0) + march.growth, real(k - march.n_linear))


@wp.func
def step_length(march: March, k: int) -> real:
    """Length of step k, not by a difference of edges, which would lose digits."""
    if k < march.n_linear or march.growth == real(0.0):
        return march.step
    return step_edge(march, k) * march.growth


@wp.func
def steps_before(march: March, t: real) -> real:
    """The (fractional) number of steps from near to distance t; inverse of step_edge."""
    k = (t - march.near) / march.step
    if march.growth == real(0.0) or k <= real(march.n_linear):
        return k
    linear = march.near + real(march.n_linear) * march.step
    return real(march.n_linear) + wp.log(t / linear) / wp.log(real(1.0) + march.growth)


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
def prepare_ray(
    grid: Grid,
    march: March,
    origin: vec3,
    direction: vec3,  # unit
    offset: real,
    contraction: int,
) -> Ray:
    """Clip a ray to the box and to [near, far]; one step of slack at both ends absorbs rounding.

    A ray that is not finite or has no direction, of a lens that folds over, meets nothing.
    """
    ray = Ray()
    ray.offset = offset
    ray.q_origin = wp.cw_div(origin - grid.centre, grid.half)
    ray.q_direction = wp.cw_div(direction, grid.half)
    interval = vec2(march.near, march.far)
    if contraction == NONE:
        interval = slab(ray.q_origin[0], ray.q_direction[0], interval)
        interval = slab(ray.q_origin[1], ray.q_direction[1], interval)
        interval = slab(ray.q_origin[2], ray.q_direction[2], interval)
    ray.begin = int(0)
    ray.end = int(0)
    finite = wp.isfinite(ray.q_origin) and wp.isfinite(ray.q_direction)
    if interval[0] <= interval[1] and finite and wp.length_sq(ray.q_direction) > real(0.0):
        most = real(1.0e9)  # counts stay within int
        ray.begin = wp.max(0, int(wp.min(steps_before(march, interval[0]), most)) - 1)
        ray.end = int(wp.min(steps_before(march, interval[1]), most)) + 2
    return ray


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
    if contraction == NONE:
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
def step_after(march: March, ray: Ray, t: real, step: int) -> int:
    """First step after `step` whose sample may lie at t or beyond, a little early for rounding."""
    return wp.max(step + 1, int(steps_before(march, t) - ray.offset - real(1.0e-3)))
