"""A loss on the colours of samples: smooth L1 for squares."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import warp as wp

from warpnerf.model.interface import Load
from warpnerf.model.models import PerSample, Rgb


@cache
def smooth_l1(load: Load) -> Any:
    """factor sum_i w_i sum_c h(c_i - target), h(d) = d^2 / (2 beta) up to beta, |d| - beta / 2 on.

    Weights are constants. Factor and beta are known when kernels run.
    """
    types = load("base.types")
    real, vec3 = types.real, types.vec3

    @wp.struct
    class Numbers:
        factor: real
        beta: real

    @wp.struct
    class Total:
        sum: real

    @wp.func
    def add(params: Numbers, state: Total, weight: real, rgb: vec3, target_rgb: vec3) -> Total:
        out = Total()
        out.sum = state.sum
        for c in range(3):
            d = wp.abs(rgb[c] - target_rgb[c])
            near = wp.min(d, params.beta)
            out.sum += weight * (real(0.5) * near * near / params.beta + d - near)
        return out

    @wp.func
    def value(params: Numbers, total: Total, rgb: vec3, target_rgb: vec3) -> real:
        return params.factor * total.sum

    @wp.func
    def adj_channels(params: Numbers, rgb: vec3, target_rgb: vec3, adj_value: real) -> vec3:
        adj = vec3()
        for c in range(3):
            d = wp.clamp(rgb[c] - target_rgb[c], -params.beta, params.beta)
            adj[c] = adj_value * params.factor * d / params.beta
        return adj

    return load("base.parts").SampleLoss(Numbers, Total, add, value, adj_channels)


@dataclass(frozen=True, kw_only=True)
class SmoothRgb(Rgb):
    """rgb with this loss."""

    name: ClassVar[str] = "smooth-rgb"
    factor: float = 0.5
    beta: float = 0.3

    def parts(self, load: Load) -> Any:
        parts = super().parts(load)
        return parts._replace(losses=parts.losses._replace(on_samples=smooth_l1(load)))

    def sample_loss_params(self, load: Load) -> Any:
        params = super().sample_loss_params(load)
        params.factor, params.beta = self.factor, self.beta
        return params


@dataclass(frozen=True, kw_only=True)
class SmoothFeatures(PerSample):
    """features with it: only samples of some weight have a colour."""

    name: ClassVar[str] = "smooth-features"

    def parts(self, load: Load) -> Any:
        parts = super().parts(load)
        return parts._replace(losses=parts.losses._replace(on_samples=smooth_l1(load)))

    def sample_loss_params(self, load: Load) -> Any:
        params = super().sample_loss_params(load)
        params.factor, params.beta = 0.5, 0.3
        return params
