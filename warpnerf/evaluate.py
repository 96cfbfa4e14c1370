"""Held-out views: how a field looks from where photographs were taken, in numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.metrics import SSIM_WINDOW, psnr, ssim
from warpnerf.scene import Scene, View, require_split

if TYPE_CHECKING:
    from warpnerf.field import Field, Rendering

OnImage = Callable[[View, np.ndarray, "Rendering"], None]
"""Called with a view, the true rgb [H, W, 3] over the field's background, and what was rendered."""


@dataclass(frozen=True, kw_only=True)
class ImageMetrics:
    """How one view compares with its photograph."""

    name: str
    """The view's."""
    psnr: float
    """dB."""
    ssim: float
    """At most 1."""
    depth_error: float | None = None
    """Mean |depth - true depth| over pixels whose depth is known, scene units; None: none is."""

    def values(self) -> dict[str, float]:
        """The metrics that are known, by name."""
        known = {"psnr": self.psnr, "ssim": self.ssim}
        if self.depth_error is not None:
            known["depth_error"] = self.depth_error
        return known


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """How the views of a split compare with their photographs."""

    images: list[ImageMetrics]
    """In the order of the split; at least one."""

    @property
    def mean(self) -> dict[str, float]:
        """Each metric's mean over the images that have it: "psnr", "ssim", "depth_error"."""
        rows = [image.values() for image in self.images]
        names = dict.fromkeys(name for row in rows for name in row)
        return {name: float(np.mean([r[name] for r in rows if name in r])) for name in names}

    def to_json(self) -> str:
        """{"mean": {"psnr": ..., "ssim": ...}, "images": [{"name": ..., "psnr": ..., ...}, ...]}."""
        images = [{"name": image.name, **image.values()} for image in self.images]
        content = msgspec.json.encode({"mean": self.mean, "images": images})
        return msgspec.json.format(content, indent=2).decode() + "\n"

    def __str__(self) -> str:
        """A table: a line per image, then their mean."""
        mean = self.mean
        titles = {"psnr": "PSNR dB", "ssim": "SSIM", "depth_error": "depth error"}
        last = f"mean of {len(self.images)}"
        rows = [(image.name, image.values()) for image in self.images] + [(last, mean)]
        width = max(len(name) for name, _ in (*rows, ("image", {})))
        lines = [f"{'image':{width}}" + "".join(f"  {titles[m]:>11}" for m in mean)]
        for name, values in rows:
            cells = (f"{values[m]:11.{2 if m == 'psnr' else 4}f}" if m in values else "" for m in mean)
            lines.append(f"{name:{width}}" + "".join(f"  {cell:>11}" for cell in cells))
        return "\n".join(lines)


def evaluate(
    field: Field, scene: Scene, split: str = "test", on_image: OnImage | None = None
) -> Evaluation:
    """Render a split's views and compare them with their photographs.

    Photographs with alpha are seen over the field's background.

    Args:
        field: The trained scene.
        scene: Photographs in the field's coordinates.
        split: "test", "train", "val", or "all" views.
        on_image: Called after each view.

    Raises:
        InputError: The scene has no such split, or an image is too small for SSIM.
    """
    images = []
    for view in require_measurable(scene, split):
        truth = composite(view.image, field.background)
        rendering = field.render(view.camera)
        images.append(
            ImageMetrics(
                name=view.name,
                psnr=psnr(rendering.rgb, truth),
                ssim=ssim(rendering.rgb, truth),
                depth_error=_depth_error(rendering.depth, view.depth),
            )
        )
        if on_image is not None:
            on_image(view, truth, rendering)
    return Evaluation(images=images)


def require_measurable(scene: Scene, split: str) -> Sequence[View]:
    """The views of a split.

    Raises:
        InputError: The scene has no such split, or an image is too small for SSIM.
    """
    views = [scene.views[i] for i in require_split(scene, split)]
    for view in views:
        if min(view.image.shape[:2]) < SSIM_WINDOW:
            raise InputError(
                f"{scene.name}: {view.name} has {view.camera.width} x {view.camera.height} pixels, "
                f"but SSIM needs at least {SSIM_WINDOW} x {SSIM_WINDOW}; use a smaller downscale."
            )
    return views


def composite(image: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Put a photograph over a background: rgb alpha + background (1 - alpha).

    Args:
        image: [H, W, 3] or [H, W, 4] uint8, straight alpha.
        background: rgb in [0, 1].

    Returns:
        [H, W, 3] float64 in [0, 1].
    """
    values = image / 255.0
    if image.shape[2] == 3:
        return values
    alpha = values[..., 3:]
    return values[..., :3] * alpha + np.array(background) * (1.0 - alpha)


def _depth_error(depth: np.ndarray, true_depth: np.ndarray | None) -> float | None:
    if true_depth is None:
        return None
    known = np.isfinite(true_depth)
    if not known.any():
        return None
    return float(np.abs(depth - true_depth, dtype=np.float64)[known].mean())
