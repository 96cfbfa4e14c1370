"""Render outputs as pictures: colour, depth, opacity and normals, alone or side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from warpnerf.checks import InputError
from warpnerf.media.pictures import above_legend, depth_colours, depth_picture, to_bytes
from warpnerf.rendering.composite import AnyField, CompositeField
from warpnerf.rendering.field import Field, Rendering
from warpnerf.rendering.normals import normal_map
from warpnerf.scenes.cameras.camera import Camera

Output = Literal["colour", "depth", "opacity", "normals"]

USUAL: tuple[Output, ...] = ("colour", "depth")

CLEAR = 1e-4
"""Opacity, up to which a pixel has no colour of its own."""


@dataclass(frozen=True, kw_only=True)
class Panels:
    """Which outputs of a rendering a picture shows, from left to right."""

    field: AnyField
    """What is looked at."""
    outputs: Sequence[Output] = USUAL
    """At least one, all different."""
    near: float = 0.0
    """Depth of the first colour, scene units."""
    far: float = 1.0
    """Depth of the last."""
    transparent: bool = False
    """Whether pixels have an alpha channel, the opacity of what is seen, and no background."""

    def __post_init__(self) -> None:
        """Refuse unknown outputs, and ones that are given twice."""
        known = get_args(Output)
        if not self.outputs or not {*self.outputs} <= {*known}:
            raise InputError(
                f"what is shown must be some of {', '.join(known)}, not "
                f"{' '.join(map(str, self.outputs)) or 'nothing'}."
            )
        if len({*self.outputs}) < len(self.outputs):
            raise InputError("what is shown is given twice; name each output once.")
        if "normals" in self.outputs and isinstance(self.field, CompositeField):
            raise InputError("normals are of one field, not of blocks; show those of a block.")

    @cached_property
    def _raw(self) -> np.ndarray:
        assert isinstance(self.field, Field)
        return self.field.storage.raw_densities(self.field.workers)

    def picture(self, camera: Camera) -> np.ndarray:
        """Render a camera's picture.

        Args:
            camera: Any.

        Returns:
            [H, n W + 4 (n - 1), 3] uint8, 4 channels where it is transparent, the last one alpha,
            not premultiplied. Below depth there is a legend of its colours.
        """
        rendering = self.field.render(camera)
        panels = [self._panel(output, camera, rendering) for output in self.outputs]
        if "depth" in self.outputs:
            return above_legend(panels, self.near, self.far)
        return above_legend(panels)

    def _panel(self, output: Output, camera: Camera, rendering: Rendering) -> np.ndarray:
        """[H, W, 3 or 4] uint8."""
        opacity = rendering.opacity[..., None]
        surface = rendering.depth / np.maximum(rendering.opacity, 1e-6)
        if output == "colour":
            shown = rendering.rgb
            if self.transparent:
                behind = (1.0 - opacity) * np.array(self.field.background, np.float32)
                shown = np.where(opacity > CLEAR, (shown - behind) / np.maximum(opacity, CLEAR), 0)
        elif output == "depth":
            shown = depth_picture(rendering, self.near, self.far)
            if self.transparent:
                shown = depth_colours(surface, self.near, self.far)
        elif output == "opacity":
            shown = np.repeat(opacity, 3, axis=-1)
        else:
            assert isinstance(self.field, Field)
            towards = 0.5 + 0.5 * normal_map(self.field, self._raw, camera, rendering)
            shown = towards if self.transparent else opacity * towards + (1.0 - opacity)
        if not self.transparent:
            return to_bytes(shown)
        alpha = np.ones_like(opacity) if output == "opacity" else opacity
        return to_bytes(np.concatenate([shown, alpha], axis=-1))
