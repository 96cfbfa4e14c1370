"""A head of your own, from what a ray accumulates to its colour, without touching the package.

    python examples/own_head.py builtin:room --output duotone.png

A node holds a density and one brightness, and a ray is printed in two inks: rgb = opacity * dark +
brightness * (light - dark). Below the forward function stands its adjoint, as everywhere: what
flows back to brightness and to opacity. The head has no vector form, so the CPU takes the scalar
walk on one thread; that is slow, but enough to try a head out. CONTRIBUTING.md says more.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
import warp as wp
from PIL import Image

import warpnerf as wn
from warpnerf.model.interface import Load
from warpnerf.model.models import register

Ink = tuple[float, float, float]
DARK, LIGHT = (0.12, 0.08, 0.25), (1.0, 0.92, 0.72)  # r, g, b in [0, 1]


@cache
def two_inks(load: Load, dark: Ink, light: Ink) -> Any:
    """The head, made of the kernels' modules that ``load`` gives; inks are compiled in."""
    rgb, types = load("heads.rgb"), load("base.types")
    real, vec3, Channels = types.real, types.vec3, types.vector(1)
    decode, adj_decode = rgb.decode_of(1)  # a sigmoid of the one raw feature
    dark_r, dark_g, dark_b = dark
    r, g, b = (bright - dim for bright, dim in zip(light, dark, strict=True))

    @wp.func
    def shade(params: Any, direction: vec3, channels: Channels, opacity: real) -> vec3:
        base = vec3(real(dark_r), real(dark_g), real(dark_b))
        return opacity * base + channels[0] * vec3(real(r), real(g), real(b))

    @wp.func
    def adj_shade(
        params: Any,
        direction: vec3,
        channels: Channels,
        opacity: real,
        adj_rgb: vec3,
        gradient: Any,
    ):
        base = vec3(real(dark_r), real(dark_g), real(dark_b))
        return (
            Channels(wp.dot(adj_rgb, vec3(real(r), real(g), real(b)))),
            wp.dot(adj_rgb, base),
        )

    return rgb.rgb().replace(
        n_channels=1, decode=decode, adj_decode=adj_decode, shade=shade, adj_shade=adj_shade
    )


@register  # so that files which name the model are read back
@dataclass(frozen=True, kw_only=True)
class Duotone(wn.Model):
    """Density and brightness, printed in two inks."""

    name: ClassVar[str] = "duotone"

    @property
    def n_features(self) -> int:
        """The brightness."""
        return 1

    def parts(self, load: Load) -> Any:
        """A dense grid, and the head."""
        return load("launch.assembly").Parts(head=two_inks(load, DARK, LIGHT))


def main(words: Sequence[str] | None = None) -> wn.Field:
    """Run the example with these words of a command line."""
    parser = argparse.ArgumentParser(description="Train with a head of your own.")
    parser.add_argument("scene", nargs="?", default="builtin:room")
    parser.add_argument("--output", default="duotone.png")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--downscale", type=int, default=4, help="of the photographs")
    args = parser.parse_args(words)
    wp.config.log_level = wp.LOG_ERROR  # Warp would name each kernel that it loads

    scene = wn.load_scene(args.scene, downscale=args.downscale)
    config = replace(
        wn.PRESETS["fast"], model=Duotone(), loss=wn.LossConfig(), steps=args.steps, threads=1
    )
    field = wn.train(scene, config).field
    view = scene.views[scene.splits["test"][0]]
    picture = (255.0 * np.clip(field.render(view.camera).rgb, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(np.hstack([view.image[..., :3], picture])).save(args.output)
    print(f"photograph and duotone: {args.output}")
    return field


if __name__ == "__main__":
    main()
