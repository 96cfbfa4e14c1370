"""Steps of another sampler, cut to a part of each ray: between two distances of its own.

A step that reaches over an end is shortened, and its sample stays where it is. So what lies before
and behind an end are, with the same steps, together the whole ray: a step that is cut in two has
one sample, and the two transmittances multiply to that of the whole step.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Sampler
from ..base.simd import VECTORS
from ..base.types import Ray, real, vec2

wp.set_module_options({"enable_backward": False})

CLIP = r"""
auto& pack = packs.data[slot];
const auto& ends = params.ends.data[ray.index];
const vec t = load(pack.t), dt = load(pack.dt), none = splat(0.0f);
const vec begin = t - ray.offset * dt;
const vec length = dt - max(ends.c[0] - begin, none) - max(begin + dt - ends.c[1], none);
store(pack.dt, max(length, none));
store_int(pack.active, load_int(pack.active) & (length > 0.0f));
"""


@cache
def clipped(sampler: Sampler) -> Sampler:
    """A sampler between two distances of each ray; for rendering, not for training.

    Args:
        sampler: Whose steps are cut.
    """
    Steps = sampler.Params
    whole_interval, edge_of, longest_of = sampler.interval, sampler.edge, sampler.longest
    steps_within_of, step_after_of = sampler.steps_within, sampler.step_after

    @wp.struct
    class Clipped:
        steps: Steps
        ends: wp.array(dtype=vec2)  # [n_rays] scene units; the first above the second: no step
        near: real
        far: real
        transmittance_min: real

    @wp.func
    def interval(params: Clipped, ray: Ray, k: int) -> vec2:
        """Where step k begins, and its length, so that its sample stays where it is."""
        whole = whole_interval(params.steps, ray, k)
        ends = params.ends[ray.index]
        before = wp.max(ends[0] - whole[0], real(0.0))
        behind = wp.max(whole[0] + whole[1] - ends[1], real(0.0))
        length = wp.max(whole[1] - before - behind, real(0.0))
        return vec2(whole[0] + ray.offset * (whole[1] - length), length)

    @wp.func
    def edge(params: Clipped, ray: Ray, k: int) -> real:
        """Where step k would begin uncut."""
        return edge_of(params.steps, ray, k)

    @wp.func
    def steps_within(params: Clipped, ray: Ray, interval: vec2) -> wp.vec2i:
        """Those of the sampler that reach between the ends."""
        ends = params.ends[ray.index]
        begin = wp.max(interval[0], ends[0])
        end = wp.min(interval[1], ends[1])
        if begin >= end:
            return wp.vec2i(0, 0)
        return steps_within_of(params.steps, ray, vec2(begin, end))

    @wp.func
    def step_after(params: Clipped, ray: Ray, t: real, step: int) -> int:
        """As the sampler has it: samples stay where they are."""
        return step_after_of(params.steps, ray, t, step)

    @wp.func
    def longest(params: Clipped, boxes_out: real) -> real:
        """No step is longer than uncut."""
        return longest_of(params.steps, boxes_out)

    whole = Sampler(
        Params=Clipped,
        interval=interval,
        edge=edge,
        steps_within=steps_within,
        step_after=step_after,
        longest=longest,
    )
    place_whole = sampler.place_pack
    if place_whole is None:
        return whole

    @wp.func_native(VECTORS + CLIP)
    def clip_pack(params: Clipped, ray: Ray, packs: wp.array(dtype=Any), slot: int):
        """Cut the steps of a pack."""
        ...

    @wp.func
    def place_pack(params: Clipped, ray: Ray, step: int, packs: wp.array(dtype=Any), slot: int):
        """Sixteen steps of the sampler, cut."""
        place_whole(params.steps, ray, step, packs, slot)
        clip_pack(params, ray, packs, slot)

    return whole._replace(place_pack=place_pack)
