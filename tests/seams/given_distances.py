"""A sampler: steps between distances from a list."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
import warp as wp

from warpnerf.model.interface import Load, Model


@cache
def params_type(real: Any) -> Any:
    @wp.struct
    class Distances:
        edges: wp.array(dtype=real)  # [n + 1] in rising order, scene units
        near: real  # where the first step begins
        far: real  # where the last one ends
        longest: real  # of the steps
        transmittance_min: real

    return Distances


@cache
def sampler(load: Load) -> Any:
    types = load("base.types")
    real, vec2, Ray = types.real, types.vec2, types.Ray
    Distances = params_type(real)

    @wp.func
    def interval(params: Distances, ray: Ray, step: int) -> vec2:
        return vec2(params.edges[step], params.edges[step + 1] - params.edges[step])

    @wp.func
    def edge(params: Distances, ray: Ray, step: int) -> real:
        return params.edges[step]

    @wp.func
    def steps_within(params: Distances, ray: Ray, span: vec2) -> wp.vec2i:
        """Steps that reach into the interval."""
        n = params.edges.shape[0] - 1
        begin = int(0)
        while begin < n and params.edges[begin + 1] <= span[0]:
            begin += 1
        end = int(begin)
        while end < n and params.edges[end] < span[1]:
            end += 1
        return wp.vec2i(begin, end)

    @wp.func
    def step_after(params: Distances, ray: Ray, t: real, step: int) -> int:
        n = params.edges.shape[0] - 1
        k = int(step + 1)
        while k < n and params.edges[k + 1] < t:
            k += 1
        return k

    @wp.func
    def longest(params: Distances, boxes_out: real) -> real:
        return params.longest

    return load("base.parts").Sampler(Distances, interval, edge, steps_within, step_after, longest)


@dataclass(frozen=True, kw_only=True)
class AtDistances(Model):
    """rgb, sampled between given distances."""

    name: ClassVar[str] = "rgb-at-distances"
    edges: tuple[float, ...]
    """Where steps begin, and the last one ends, scene units."""

    @property
    def n_features(self) -> int:
        return 3

    def parts(self, load: Load) -> Any:
        return load("launch.assembly").Parts(
            head=load("heads.rgb").rgb(),
            sampler=sampler(load),
        )

    def march(self, load: Load, steps: Any, device: Any) -> Any:
        real = load("base.types").real
        params = params_type(real)()
        params.edges = wp.array(self.edges, dtype=real, device=device)
        params.near, params.far = self.edges[0], self.edges[-1]
        params.longest = float(np.diff(self.edges).max())
        params.transmittance_min = steps.transmittance_min
        return params

    def most_steps(self, steps: Any, length: float) -> int:
        return len(self.edges) - 1
