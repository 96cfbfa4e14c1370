"""How wide voxels are in the photographs, in words that say what to do about it."""

from __future__ import annotations

from dataclasses import dataclass

from warpnerf.scenes.cameras.observations import guessed, quantiles
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.scene import Scene

BLURRED = 3.0
"""Pixels: a voxel as wide as this or wider shows in renderings."""
FINE = 0.6
"""Pixels: narrower voxels hold nothing that photographs show."""


@dataclass(frozen=True, kw_only=True)
class Sharpness:
    """How many pixels wide a voxel of the final grid is where cameras look."""

    low: float
    """A quarter of the pixels see narrower ones."""
    median: float
    """Half of them."""
    high: float
    """Three quarters."""
    until: str = ""
    """Why training will have other ones; empty: it will not."""

    def __str__(self) -> str:
        """The width, and what to do where it is too large or too small."""
        text = f"{self.median:.2g} pixels wide where cameras look"
        if self.high > 1.2 * self.low:
            text += f" (half of the pixels: {self.low:.2g} to {self.high:.2g})"
        if self.until:
            return f"about {text}, {self.until}"
        if self.median >= BLURRED:
            way_out = "use more --voxels, a smaller --box, or smaller photographs (--downscale 2)"
            return f"blurred: {text}; {way_out}"
        if self.median <= FINE:
            return f"finer than the photographs: {text}; fewer --voxels are faster"
        return text


def sharpness(scene: Scene, space: Space, voxels: int, box_is_fixed: bool = False) -> Sharpness:
    """How wide voxels are where the cameras of a scene look.

    Args:
        scene: What its cameras see, as points tell, or its content distance.
        space: That the grid fills.
        voxels: Nodes of the grid.
        box_is_fixed: Whether training keeps to the box of a bounded space.
    """
    seen, until = scene.observations, ""
    if space.kind.bounded and not box_is_fixed:
        until = "until training tightens the box"
    if seen is None:
        seen = guessed(scene.training_cameras, scene.content_distance)
        if space.border > 0.0:
            until = "unless training finds a better box first"
    widths = space.voxel_widths(seen, voxels)
    low, median, high = map(float, quantiles(widths, seen.weights, (0.25, 0.5, 0.75)))
    return Sharpness(low=low, median=median, high=high, until=until)


def in_words(space: Space, held: str) -> str:
    """A space as ``inspect`` and ``train`` print it.

    Args:
        space: Any.
        held: What of space outside its box becomes, in words.
    """
    box = " x ".join(f"{edge:.4g}" for edge in space.box_max - space.box_min)
    text = f"{box} scene units"
    if space.content is not None:
        content = " x ".join(f"{edge:.4g}" for edge in space.content[1] - space.content[0])
        text += f" of {content} that cameras see"
    text += f", {held}"
    return text if space.border == 0.0 else f"{text}, border {space.border:.2g}"
