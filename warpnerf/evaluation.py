"""Looking at a field through a scene's cameras and measuring how well it does."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.checks import InputError
from warpnerf.metrics import SSIM_WINDOW, psnr, ssim
from warpnerf.scene import Scene, View, require_split

if TYPE_CHECKING:
    from warpnerf.field import Field, Rendering


@dataclass(frozen=True, kw_only=True)
class ImageMetrics:
    """One view's figures."""

    name: str
    """The view's."""
    psnr: float
    """dB."""
    ssim: float
    """At most 1."""
    depth_error: float | None = None
    """Mean |depth - true depth|, scene units, over the pixels whose true depth is known."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The figures of all views of a split."""

    images: tuple[ImageMetrics, ...]
    """In the scene's order."""

    @property
    def mean(self) -> dict[str, float]:
        """Means over the images, by name."""
        means = {
            "psnr": float(np.mean([image.psnr for image in self.images])),
            "ssim": float(np.mean([image.ssim for image in self.images])),
        }
        errors = [image.depth_error for image in self.images if image.depth_error is not None]
        if errors:
            means["depth_error"] = float(np.mean(errors))
        return means

    def to_json(self) -> str:
        """{"mean": {"psnr": ..., "ssim": ...}, "images": [{"name": ..., ...}, ...]}."""
        images = [
            {key: value for key, value in vars(image).items() if value is not None}
            for image in self.images
        ]
        return json.dumps({"mean": self.mean, "images": images}, indent=2) + "\n"

    def __str__(self) -> str:
        """A table, the means last."""
        width = max(len("mean"), *(len(image.name) for image in self.images))
        with_depth = "depth_error" in self.mean
        lines = [f"{'image':{width}}   PSNR    SSIM" + ("  depth error" if with_depth else "")]
        for image in self.images:
            lines.append(f"{image.name:{width}}  {image.psnr:5.2f}  {image.ssim:6.4f}")
            if image.depth_error is not None:
                lines[-1] += f"  {image.depth_error:11.4f}"
        mean = self.mean
        lines.append(f"{'mean':{width}}  {mean['psnr']:5.2f}  {mean['ssim']:6.4f}")
        if with_depth:
            lines[-1] += f"  {mean['depth_error']:11.4f}"
        return "\n".join(lines)


def evaluate(
    field: Field,
    scene: Scene,
    split: str = "test",
    on_image: Callable[[View, np.ndarray, Rendering], None] | None = None,
) -> Evaluation:
    """Render a split's views and hold them against the photographs.

    Args:
        field: A trained scene.
        scene: Photographs in the field's coordinates.
        split: train, val, test, or all.
        on_image: Called with each view, its truth [H, W, 3] in [0, 1] over the field's background,
            and its rendering.

    Raises:
        InputError: The scene has no such split.
    """
    images = []
    for index in require_split(scene, split):
        view = scene.views[index]
        rendering = field.render(view.camera)
        target = truth(view, field.background)
        rgb = np.clip(rendering.rgb, 0.0, 1.0)
        depth_error = None
        if view.depth is not None:
            error = np.abs(rendering.depth - view.depth)
            depth_error = float(np.mean(error[np.isfinite(view.depth)]))
        images.append(
            ImageMetrics(
                name=view.name,
                psnr=psnr(rgb, target),
                ssim=ssim(rgb, target),
                depth_error=depth_error,
            )
        )
        if on_image is not None:
            on_image(view, target, rendering)
    return Evaluation(images=tuple(images))


def require_measurable(scene: Scene, split: str) -> None:
    """Raise InputError unless a split's views are large enough to be measured: SSIM sets the least.

    Raises:
        InputError: The split is missing, or an image is too small.
    """
    for index in require_split(scene, split):
        camera = scene.views[index].camera
        if min(camera.width, camera.height) < SSIM_WINDOW:
            raise InputError(
                f"{scene.views[index].name} is {camera.width} x {camera.height} pixels, but SSIM "
                f"needs {SSIM_WINDOW} x {SSIM_WINDOW}; use larger images, or a smaller --downscale."
            )


def truth(view: View, background: tuple[float, float, float]) -> np.ndarray:
    """A view's photograph over a background, [H, W, 3] float64 in [0, 1]."""
    image = view.image.astype(np.float64) / 255.0
    if image.shape[2] == 3:
        return image
    alpha = image[..., 3:]
    return alpha * image[..., :3] + (1.0 - alpha) * np.array(background)
