"""Losses on a ray's weights, and on where its samples lie."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import warp as wp

from warpnerf.model.interface import Load, Model


@cache
def around_two(load: Load, factor: float) -> Any:
    """factor sum_i w_i (t_i - 2)^2: density is drawn to a distance of 2.

    The factor is known when kernels are compiled.
    """
    real, Nothing = load("base.types").real, load("base.types").Nothing

    @wp.struct
    class Total:
        sum: real

    @wp.func
    def cost(t: real) -> real:
        return real(factor) * (t - real(2.0)) * (t - real(2.0))

    @wp.func
    def add(
        params: Nothing, state: Total, weight: real, t: real, dt: real, raw_density: real
    ) -> Total:
        out = Total()
        out.sum = state.sum + weight * cost(t)
        return out

    @wp.func
    def value(params: Nothing, total: Total, transmittance: real) -> real:
        return total.sum

    @wp.func
    def weighted(params: Nothing, total: Total) -> real:
        return total.sum

    @wp.func
    def adj_weight(
        params: Nothing, total: Total, before: Total, weight: real, t: real, dt: real
    ) -> real:
        return cost(t)

    @wp.func
    def bound(params: Nothing, total: Total, t_end: real) -> real:
        return wp.max(cost(real(0.0)), cost(t_end))

    return load("base.parts").RayLoss(Nothing, Total, add, value, weighted, adj_weight, bound)


@cache
def spread(load: Load) -> Any:
    """factor sum_ij w_i w_j (t_i - t_j)^2: weights come together.

    By sums of weight, weight times t and weight times t^2, a loss of degree two in the weights. The
    factor is known when kernels run.
    """
    real = load("base.types").real

    @wp.struct
    class Factor:
        factor: real

    @wp.struct
    class Sums:
        weight: real
        moment: real  # of weight times t
        square: real  # of weight times t^2

    @wp.func
    def add(
        params: Factor, state: Sums, weight: real, t: real, dt: real, raw_density: real
    ) -> Sums:
        out = Sums()
        out.weight = state.weight + weight
        out.moment = state.moment + weight * t
        out.square = state.square + weight * t * t
        return out

    @wp.func
    def value(params: Factor, total: Sums, transmittance: real) -> real:
        both = total.weight * total.square - total.moment * total.moment
        return real(2.0) * params.factor * both

    @wp.func
    def weighted(params: Factor, total: Sums) -> real:
        return real(2.0) * value(params, total, real(0.0))

    @wp.func
    def adj_weight(
        params: Factor, total: Sums, before: Sums, weight: real, t: real, dt: real
    ) -> real:
        both = total.square - real(2.0) * t * total.moment + t * t * total.weight
        return real(2.0) * params.factor * both

    @wp.func
    def bound(params: Factor, total: Sums, t_end: real) -> real:
        return real(2.0) * params.factor * t_end * t_end

    return load("base.parts").RayLoss(Factor, Sums, add, value, weighted, adj_weight, bound)


@dataclass(frozen=True, kw_only=True)
class WithLosses(Model):
    """rgb with one of these losses, or their sum."""

    name: ClassVar[str] = "rgb-with-losses"
    near_two: float = 0.0
    """Factor on the first."""
    together: float = 0.0
    """Factor on the other."""

    @property
    def n_features(self) -> int:
        return 3

    def parts(self, load: Load) -> Any:
        losses = []
        if self.near_two:
            losses.append(around_two(load, self.near_two))
        if self.together:
            losses.append(spread(load))
        loss = losses[0] if len(losses) == 1 else load("volume.ray_loss").sum_of(*losses)
        return load("launch.assembly").Parts(
            head=load("heads.rgb").rgb(),
            losses=load("volume.loss").PHOTOMETRIC_ONLY._replace(on_ray=loss),
        )

    def loss_params(self, load: Load) -> Any:
        params = super().loss_params(load)
        if self.near_two and self.together:
            params.b.factor = self.together
        elif self.together:
            params.factor = self.together
        return params
