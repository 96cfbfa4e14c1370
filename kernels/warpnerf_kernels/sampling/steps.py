"""Ray marching: equal steps along a ray, then geometrically growing ones. A sampler.

Sample k sits at edge(k) + offset (edge(k + 1) - edge(k)). Neither the box nor free space moves a
sample: they only decide which ones are visited. So skipping is exact, and a ray walked twice visits
the same samples twice.

This is the sampler that models use; base.parts.Sampler says what one is.
"""

from typing import Any

import warp as wp

from ..base.parts import INFINITELY_FAR, Sampler
from ..base.simd import VECTORS
from ..base.types import Ray, real, vec2

wp.set_module_options({"enable_backward": False})


@wp.struct
class March:
    """How rays are stepped. Edge k of the steps lies at ``edge(march, k)``."""

    near: real  # where step 0 begins
    far: real  # no sample at or beyond it
    step: real  # step length up to edge ``n_linear``
    growth: real  # from there on each step is (1 + growth) times the one before; 0: never
    n_linear: int  # steps of equal length
    transmittance_min: real  # nothing is sampled once less light than this passes


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
def edge(march: March, ray: Ray, k: int) -> real:
    """step_edge: steps are the same for all rays."""
    return step_edge(march, k)


@wp.func
def interval(march: March, ray: Ray, k: int) -> vec2:
    """Where step k begins, and its length."""
    return vec2(step_edge(march, k), step_length(march, k))


@wp.func
def steps_before(march: March, t: real) -> real:
    """The (fractional) number of steps from near to distance t; inverse of step_edge."""
    k = (t - march.near) / march.step
    if march.growth == real(0.0) or k <= real(march.n_linear):
        return k
    linear = march.near + real(march.n_linear) * march.step
    return real(march.n_linear) + wp.log(t / linear) / wp.log(real(1.0) + march.growth)


@wp.func
def steps_within(march: March, ray: Ray, interval: vec2) -> wp.vec2i:
    """The first step that can lie in an interval of t, and one past the last.

    One step of slack at both ends absorbs rounding.
    """
    most = real(1.0e9)  # counts stay within int
    begin = wp.max(0, int(wp.min(steps_before(march, interval[0]), most)) - 1)
    return wp.vec2i(begin, int(wp.min(steps_before(march, interval[1]), most)) + 2)


@wp.func
def step_after(march: March, ray: Ray, t: real, step: int) -> int:
    """First step after `step` whose sample may lie at t or beyond, a little early for rounding."""
    return wp.max(step + 1, int(steps_before(march, t) - ray.offset - real(1.0e-3)))


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const ivec lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
const ivec k = step + lane;
vec begin = march.near + to_float(k) * march.step;
vec dt = splat(march.step);
if (march.growth != 0.0f) {
    ivec n = k - (step > march.n_linear ? step : march.n_linear);
    vec power = splat(1.0f);
    float g = 1.0f + march.growth;
    for (int bit = 1; bit < LANES; bit *= 2, g *= g) {
        power *= (n & bit) != 0 ? splat(g) : splat(1.0f);
    }
    begin = n < 0 ? begin : edge * power;
    dt = n < 0 ? dt : begin * march.growth;
}
vec t = begin + ray.offset * dt;
pack.step = step;
store_int(pack.active, (k < ray.end) & (t < march.far));
store(pack.t, t);
store(pack.dt, dt);
"""
)
def place_steps_at(
    march: March,
    ray: Ray,
    step: int,  # of the first lane
    edge: wp.float32,  # where step max(step, n_linear) begins
    packs: wp.array(dtype=Any),
    slot: int,
):
    """Sixteen steps in a row, from where the first growing one begins.

    Equal steps are rounded as in the scalar form, so that both visit the same samples.
    """
    ...


@wp.func
def place_steps(march: March, ray: Ray, step: int, packs: wp.array(dtype=Any), slot: int):
    """Sixteen steps in a row: t and dt, and which of them lie before the ray's end."""
    place_steps_at(march, ray, step, step_edge(march, wp.max(step, march.n_linear)), packs, slot)


@wp.func
def longest_step(march: March, boxes_out: real) -> real:
    """How long steps can be at so many half boxes from the middle.

    A point n boxes out is at most n times as far from a training camera as equal steps reach: these
    go from all of them to the farthest corner of the box.
    """
    if boxes_out == real(0.0) or march.growth == real(0.0):
        return march.step
    t = march.far
    if boxes_out < real(wp.static(INFINITELY_FAR)):
        t = wp.min(t, boxes_out * step_edge(march, march.n_linear))
    return wp.max(march.step, march.growth * t)


STEPS = Sampler(
    Params=March,
    interval=interval,
    edge=edge,
    steps_within=steps_within,
    step_after=step_after,
    longest=longest_step,
    place_pack=place_steps,
)
"""The sampler."""
