"""Losses on a ray's weights, and on where its samples lie."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import warp as wp

from warpnerf.model.interface import Load, Model


@cache
def around_two(load: Load, factor: float) -> Any:
    """factor sum_i w_i (t_i - 2)^2: matter is drawn to a distance of 2."""
    real = load("base.types").real

    @wp.struct
    class Total:
        sum: real

    @wp.func
    def cost(t: real) -> real:
        return real(factor) * (t - real(2.0)) * (t - real(2.0))

    @wp.func
    def add(state: Total, weight: real, t: real, dt: real) -> Total:
        out = Total()
        out.sum = state.sum + weight * cost(t)
        return out

    @wp.func
    def value(total: Total) -> real:
        return total.sum

    @wp.func
    def adj_weight(total: Total, before: Total, weight: real, t: real, dt: real) -> real:
        return cost(t)

    @wp.func
    def bound(total: Total, t_end: real) -> real:
        return wp.max(cost(real(0.0)), cost(t_end))

    return load("base.parts").RayLoss(Total, add, value, value, adj_weight, bound)


@cache
def distortion(load: Load, factor: float) -> Any:
    """factor sum_ij w_i w_j |t_i - t_j| + factor / 3 sum_i w_i^2 dt_i: weights come together.

    Source: Barron et al. 2022 (mip-NeRF 360), eq. 15, with sums over the samples before as in Sun
    et al. 2022: L = sum_i w_i^2 dt_i / 3 + 2 w_i (t_i W_i - M_i).
    """
    real = load("base.types").real

    @wp.struct
    class Sums:
        loss: real
        weight: real  # W
        moment: real  # M, of weight times t

    @wp.func
    def add(state: Sums, weight: real, t: real, dt: real) -> Sums:
        out = Sums()
        spread = weight * weight * dt / real(3.0)
        apart = real(2.0) * weight * (t * state.weight - state.moment)
        out.loss = state.loss + real(factor) * (spread + apart)
        out.weight = state.weight + weight
        out.moment = state.moment + weight * t
        return out

    @wp.func
    def value(total: Sums) -> real:
        return total.loss

    @wp.func
    def weighted(total: Sums) -> real:
        return real(2.0) * total.loss  # of degree two in the weights

    @wp.func
    def adj_weight(total: Sums, before: Sums, weight: real, t: real, dt: real) -> real:
        nearer = real(2.0) * before.weight + weight - total.weight
        moments = real(2.0) * before.moment + weight * t - total.moment
        apart = real(2.0) * (t * nearer - moments)
        return real(factor) * (apart + real(2.0) / real(3.0) * weight * dt)

    @wp.func
    def bound(total: Sums, t_end: real) -> real:
        return real(3.0) * real(factor) * t_end

    return load("base.parts").RayLoss(Sums, add, value, weighted, adj_weight, bound)


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
            losses.append(distortion(load, self.together))
        loss = losses[0] if len(losses) == 1 else load("volume.ray_loss").sum_of(*losses)
        return load("launch.assembly").Parts(
            encoding=load("fields.dense").dense(self.n_floats),
            head=load("heads.rgb").rgb(),
            loss=loss,
        )
