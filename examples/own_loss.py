"""A loss of your own on the samples of a ray, without touching the package.

    python examples/own_loss.py builtin:room-sparse --distance 0.8 --weight 0.01

The loss is sum_i w_i max(0, 1 - t_i / distance)^2: density before a camera costs the more, the
nearer it is. It is written as Warp functions that the training launch compiles in: how much one
more sample adds, and the derivative by a sample's weight. Without a vector form, as here, packs of
samples call these for one sample after the other. CONTRIBUTING.md says what each function promises.
Trains twice, without and with the loss, and says how much density is near the cameras.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import warp as wp

import warpnerf as wn
from warpnerf.model.interface import Load


@cache
def nearness(load: Load) -> Any:
    """The loss, made of the kernels' modules that ``load`` gives, in float32 or float64."""
    real = load("base.types").real

    @wp.struct
    class Nearness:
        distance: real  # from which on density costs nothing, scene units
        weight: real

    @wp.struct
    class Total:
        sum: real

    @wp.func
    def cost(params: Nearness, t: real) -> real:
        """Of a unit of weight at distance t."""
        closeness = wp.max(real(0.0), real(1.0) - t / params.distance)
        return params.weight * closeness * closeness

    @wp.func
    def add(
        params: Nearness, state: Total, weight: real, t: real, dt: real, raw_density: real
    ) -> Total:
        out = Total()
        out.sum = state.sum + weight * cost(params, t)
        return out

    @wp.func
    def value(params: Nearness, total: Total, transmittance: real) -> real:
        return total.sum

    @wp.func
    def weighted(params: Nearness, total: Total) -> real:
        """Sum of weight times dL/dweight: of a loss that is linear in the weights, itself."""
        return total.sum

    @wp.func
    def adj_weight(
        params: Nearness, total: Total, before: Total, weight: real, t: real, dt: real
    ) -> real:
        return cost(params, t)

    @wp.func
    def bound(params: Nearness, total: Total, t_end: real) -> real:
        """What |dL/dweight| never exceeds."""
        return params.weight

    return load("base.parts").RayLoss(Nearness, Total, add, value, weighted, adj_weight, bound)


@dataclass(frozen=True, kw_only=True)
class ClearRgb(wn.Rgb):
    """The model rgb, which clears the space before the cameras."""

    name: ClassVar[str] = "clear-rgb"
    distance: float = 0.8
    """From which on density costs nothing, scene units."""
    weight: float = 0.01
    """Of the loss, beside the squared error of a pixel."""

    def parts(self, load: Load) -> Any:
        """Those of rgb, with the loss."""
        parts = super().parts(load)
        return parts._replace(losses=parts.losses._replace(on_ray=nearness(load)))

    def loss_params(self, load: Load) -> Any:
        """Numbers that are known when kernels run, so that other ones compile nothing."""
        params = super().loss_params(load)
        params.distance, params.weight = self.distance, self.weight
        return params


def main(words: Sequence[str] | None = None) -> dict[str, wn.Evaluation]:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Train with a loss of your own.")
    parser.add_argument("scene", nargs="?", default="builtin:room-sparse")
    parser.add_argument("--distance", type=float, default=0.8, help="scene units")
    parser.add_argument("--weight", type=float, default=0.01)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--downscale", type=int, default=1, help="of the photographs")
    args = parser.parse_args(words)
    wp.config.log_level = wp.LOG_ERROR  # Warp would name each kernel that it loads

    scene = wn.load_scene(args.scene, downscale=args.downscale)
    models = {
        "without": wn.Rgb(),
        "with the loss": ClearRgb(distance=args.distance, weight=args.weight),
    }
    found = {}
    for name, model in models.items():
        config = replace(
            wn.PRESETS["fast"], model=model, loss=wn.LossConfig(), steps=args.steps, scaling="none"
        )
        found[name] = wn.evaluate(wn.train(scene, config).field, scene)
        near = found[name].near_field
        print(
            f"{name:13}  PSNR {found[name].mean['psnr']:5.2f} dB, optical depth within "
            f"{near.within:.2g} of the cameras {near.near_mass:.4f}"
        )
    return found


if __name__ == "__main__":
    main()
