"""A head: one channel, which is the colour."""

from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import warp as wp

from warpnerf.model.interface import Load, Model
from warpnerf.model.models import register


@cache
def head(load: Load) -> Any:
    rgb, types = load("heads.rgb"), load("base.types")
    real, vec3, Channels = types.real, types.vec3, types.vector(1)
    decode, adj_decode = rgb.decode_of(1)

    @wp.func
    def shade(params: Any, direction: vec3, channels: Channels, opacity: real) -> vec3:
        return vec3(channels[0], channels[0], channels[0])

    @wp.func
    def adj_shade(
        params: Any, direction: vec3, channels: Channels, opacity: real, adj_rgb: vec3, g: Any
    ):
        return Channels(adj_rgb[0] + adj_rgb[1] + adj_rgb[2]), real(0.0)

    return rgb.rgb().replace(
        n_channels=1, decode=decode, adj_decode=adj_decode, shade=shade, adj_shade=adj_shade
    )


@register
@dataclass(frozen=True, kw_only=True)
class Grey(Model):
    """Density and brightness."""

    name: ClassVar[str] = "grey"

    @property
    def n_features(self) -> int:
        return 1

    def parts(self, load: Load) -> Any:
        return load("launch.assembly").Parts(head=head(load))
