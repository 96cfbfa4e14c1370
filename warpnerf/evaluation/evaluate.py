"""Evaluation: rendering a field through a scene's cameras, and its image metrics."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError
from warpnerf.evaluation.metrics import (
    SSIM_WINDOW,
    alike_where_masked,
    colour_corrected,
    flip,
    has_flip,
    psnr,
    ssim,
    truth,
)
from warpnerf.evaluation.near_field import (
    NEAR_SHARE,
    NearField,
    ends_within,
    measure_near_field,
    near_masses,
)
from warpnerf.runtime.terminal import table_text
from warpnerf.scenes.scene import Scene, View, require_split

if TYPE_CHECKING:
    from warpnerf.evaluation.measures import Measures
    from warpnerf.evaluation.sight import SurfaceVisibility
    from warpnerf.rendering.composite import CompositeField
    from warpnerf.rendering.field import Field, Rendering


Distance = Callable[[np.ndarray, np.ndarray], float]
"""Of a rendering and a photograph, both [H, W, 3] in [0, 1]."""

HEADINGS = {
    "psnr": ("PSNR", ".2f"),
    "cc_psnr": ("cc-PSNR", ".2f"),
    "ssim": ("SSIM", ".4f"),
    "flip": ("FLIP", ".4f"),
    "lpips": ("LPIPS", ".4f"),
    "depth_error": ("depth error", ".4f"),
}
"""Heading and format of each figure in a table."""


NOTABLE_CORRECTION = 0.3
"""dB of PSNR by which colours that are corrected come closer, on average, for tables to say so."""

FOG_PSNR = 20.0
"""dB, below which a view whose rays end close to its camera counts as fog, not as a close-up."""


@dataclass(frozen=True, kw_only=True)
class ImageMetrics:
    """Image metrics of a view, over the pixels that its mask keeps."""

    name: str
    """The view's."""
    psnr: float
    """dB."""
    cc_psnr: float
    """dB, with each channel of the rendering mapped affinely to the photograph's: what is left
    where exposures differ."""
    ssim: float | None
    """At most 1; None where a mask leaves no window of it."""
    flip: float | None = None
    """0 for equal images, at most 1; where the package flip-evaluator is installed."""
    lpips: float | None = None
    """0 for equal images; where its weights were given. Of the whole image: pixels that do not
    count are taken to be alike."""
    depth_error: float | None = None
    """Mean |depth - true depth|, scene units, over the pixels whose true depth is known."""
    near_rays: float | None = None
    """Share of all its rays that end close to the camera, as of ``NearField``."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Image metrics of all views of a split, PSNR, SSIM and others, and floater metrics before the
    training cameras."""

    split: str
    """Of which: test, train, val or all."""
    images: tuple[ImageMetrics, ...]
    """In the scene's order."""
    near_field: NearField
    """Of floaters."""
    measures: Measures | None = None
    """What takes longer; None: it was not measured."""

    @property
    def mean(self) -> dict[str, float]:
        """Mean image metrics over the images that have one, by name."""
        means = {}
        for name in HEADINGS:
            values = [getattr(image, name) for image in self.images]
            known = [value for value in values if value is not None]
            if known:
                means[name] = float(np.mean(known))
        return means

    def to_json(self) -> str:
        """Metrics as JSON: {"split": "test", "mean": {"psnr": ..., ...}, "floaters": {...},
        "images": [{"name": ..., ...}, ...], "measures": {...}}, the last where they were
        measured."""
        images = [
            {key: value for key, value in vars(image).items() if value is not None}
            for image in self.images
        ]
        content: dict[str, Any] = {
            "split": self.split,
            "mean": self.mean,
            "floaters": self.near_field.to_dict(),
            "images": images,
        }
        if self.measures is not None:
            content["measures"] = self.measures.to_dict()
        return json.dumps(content, indent=2) + "\n"

    def __str__(self) -> str:
        """A table, the means last, and what is known of floaters."""
        mean = self.mean
        if mean.get("cc_psnr", 0.0) < mean["psnr"] + NOTABLE_CORRECTION:
            mean.pop("cc_psnr", None)

        def cells(name: str, figures: Callable[[str], float | None]) -> list[str]:
            values = ((figures(key), HEADINGS[key][1]) for key in mean)
            return [name, *("" if value is None else format(value, how) for value, how in values)]

        rows = [cells(image.name, partial(getattr, image)) for image in self.images]
        rows.append(cells("mean", mean.get))
        table = table_text(["image", *(HEADINGS[key][0] for key in mean)], rows)
        more = [] if self.measures is None else ["", str(self.measures)]
        return "\n".join([table, str(self.near_field), *self._fog(), *more])

    def _fog(self) -> list[str]:
        """That views are fog: what the field has close to their cameras hides what they show."""
        fog = [i for i in self.images if (i.near_rays or 0.0) >= 0.5 and i.psnr < FOG_PSNR]
        if not fog:
            return []
        return [
            f"fog: {len(fog)} of {len(self.images)} views look into density within "
            f"{self.near_field.within:.3g} scene units (first: {fog[0].name}, "
            f"{fog[0].near_rays:.0%} of its rays), where no training camera shows that space is "
            "free; add photographs from there, train with a larger --near, or leave the views out"
        ]


@checked_arguments
def evaluate(
    field: Field | CompositeField,
    scene: Scene,
    split: str = "test",
    on_image: Callable[[View, np.ndarray, Rendering], None] | None = None,
    lpips: Distance | None = None,
    on_progress: Callable[[float, str], None] = lambda done, words: None,
    measures: bool | SurfaceVisibility = False,
) -> Evaluation:
    """Evaluate a field: render a split's views and compare them with the photographs.

    Args:
        field: A trained scene.
        scene: Photographs in the field's coordinates.
        split: train, val, test, or all.
        on_image: Called with each view, its truth [H, W, 3] in [0, 1] over the field's background,
            and its rendering.
        lpips: A ``warpnerf.evaluation.lpips.Lpips``, if LPIPS is wanted.
        on_progress: Called with the share that is done, in (0, 1], and what was last, in words.
        measures: Whether to measure what takes longer as well: see ``Measures``. The scene's
            ``SurfaceVisibility`` says so too, where several of its fields are measured.

    Returns:
        Figures of each image and their means, and what hangs in front of the training cameras.

    Raises:
        InputError: Field or scene is none, or the scene has no such split.
    """

    images = []
    within = NEAR_SHARE * scene.content_distance
    views = [scene.views[index] for index in require_split(scene, split)]
    measuring = None
    if measures:  # loads Warp
        from warpnerf.evaluation.measures import Measuring

        measuring = Measuring(field, scene, split, None if measures is True else measures)
    for number, view in enumerate(views, 1):
        rendering = field.render(view.camera)
        target = truth(view, field.background)
        rgb = np.clip(rendering.rgb, 0.0, 1.0)
        depth_error = None
        mask, depth = view.mask, view.depth
        if depth is not None:
            known = np.isfinite(depth) & (True if mask is None else mask)
            if known.any():
                depth_error = float(np.mean(np.abs(rendering.depth - depth)[known]))
        alike = alike_where_masked(rgb, target, mask)
        images.append(
            ImageMetrics(
                name=view.name,
                psnr=psnr(rgb, target, mask),
                cc_psnr=psnr(colour_corrected(rgb, target, mask), target, mask),
                ssim=ssim(rgb, target, mask),
                flip=flip(rgb, target, mask) if has_flip() else None,
                lpips=None if lpips is None else lpips(alike, target),
                depth_error=depth_error,
                near_rays=float(np.mean(ends_within(rendering, within))),
            )
        )
        if on_image is not None:
            on_image(view, target, rendering)
        if measuring is not None:
            measuring.add(view, target, rendering)
        on_progress(number / (len(views) + 1), f"view {number} of {len(views)}")
    masses = list(near_masses(field, scene))
    near_field = measure_near_field(field, scene, masses)
    so_far = len(views) / (len(views) + 1)
    found = None
    if measuring is not None:
        found = measuring.finish(masses, lambda words: on_progress(so_far, words))
    on_progress(1.0, "what is near the cameras")
    return Evaluation(split=split, images=tuple(images), near_field=near_field, measures=found)


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
                f"needs {SSIM_WINDOW} x {SSIM_WINDOW}; use larger images, or no --downscale."
            )
