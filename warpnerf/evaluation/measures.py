"""Measures where they count: over what training views see, and along rays to the true surface.

docs/metrics.md has the formula, unit and source of each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warpnerf.evaluation.floater_metrics import near_density
from warpnerf.evaluation.light import Light, measure_light
from warpnerf.evaluation.metrics import psnr, ssim, truth
from warpnerf.evaluation.sight import NO_SURFACE, SurfaceVisibility, goes_by_points, true_depths
from warpnerf.runtime.terminal import table_text
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View

if TYPE_CHECKING:
    from warpnerf.rendering.composite import AnyField
    from warpnerf.rendering.field import Rendering

SEEN_BY = (1, 2)
"""Training views, at least, that see the surfaces of the pixels that are measured."""

TRAINING_VIEWS = 8
"""That are rendered, at most."""

NEAREST = 0.01
"""In content distances: a rendered depth counts as no nearer than this, for its inverse."""

WIDTH = 15.0
"""Degrees of a class of views, by their angle to the nearest training camera."""


@dataclass(frozen=True, kw_only=True)
class SeenFigures:
    """Figures over the pixels whose true surface enough training views see; means over views."""

    share: float
    """Of all pixels whose true depth is known, those that are measured; a view may have none."""
    coverage: float
    """Of those that are measured, the share at which the field is at least half opaque."""
    psnr: float
    """dB."""
    ssim: float | None
    """At most 1; None where the pixels leave no window, or show single points."""
    depth_error: float
    """Mean |depth - true depth|, scene units."""
    relative_depth_error: float
    """Mean |depth - true depth| / true depth."""
    inverse_depth_error: float
    """Mean |1 / depth - 1 / true depth|, 1 / scene unit."""


@dataclass(frozen=True, kw_only=True)
class ViewAngle:
    """How far a view is turned from what was trained on."""

    name: str
    """The view's."""
    angle: float
    """Degrees between its optical axis and the nearest of a training camera."""
    psnr: float
    """dB."""


@dataclass(frozen=True, kw_only=True)
class Measures:
    """What is measured besides image metrics, on request."""

    light: dict[str, Light]
    """Front, hit, behind and transmitted, by split: the one that is measured, and train."""
    points_only: bool
    """Whether these are of pixels that show a point of structure from motion, as nothing else tells
    where surfaces are."""
    seen: dict[str, SeenFigures]
    """By how many training views, at least, see a pixel's surface, as text."""
    near_mass: dict[str, float]
    """Optical depth before each training camera up to a tenth of the content distance, by name."""
    near_density: float | None
    """Mean optical depth around the training cameras where no surface is; None: not known."""
    angles: tuple[ViewAngle, ...]
    """Of each view."""
    training_psnr: float
    """Mean PSNR of up to TRAINING_VIEWS training views, spread, dB: what only these saw may rise in
    it while test views fall."""
    left_out: tuple[str, ...]
    """What could not be measured, a sentence each."""

    def to_dict(self) -> dict[str, Any]:
        """For JSON: what is known, by name."""
        content = asdict(self)
        for figures in content["seen"].values():
            if figures["ssim"] is None:
                del figures["ssim"]
        if self.near_density is None:
            del content["near_density"]
        return content

    def __str__(self) -> str:
        """Tables."""
        parts = []
        if self.light:
            rows = [
                [f"{split} rays", *(f"{share:.4f}" for share in _shares(light))]
                for split, light in self.light.items()
            ]
            parts.append(table_text(["light", *_SHARES], rows))
        if self.seen:
            rows = [
                [
                    f"{least} or more",
                    f"{found.share:.1%}",
                    f"{found.coverage:.1%}",
                    f"{found.psnr:.2f}",
                    "" if found.ssim is None else f"{found.ssim:.4f}",
                    f"{found.depth_error:.4f}",
                    f"{found.relative_depth_error:.4f}",
                    f"{found.inverse_depth_error:.4f}",
                ]
                for least, found in self.seen.items()
            ]
            heads = ("pixels", "coverage", "PSNR", "SSIM", "depth error", "relative", "inverse")
            parts.append(table_text(["seen by training views", *heads], rows))
        rows = [
            [f"{low:.0f} to {low + WIDTH:.0f} degrees", f"{len(group)}", f"{np.mean(group):.2f}"]
            for low, group in self._classes().items()
        ]
        parts.append(table_text(["angle to the nearest training camera", "views", "PSNR"], rows))
        parts.append(f"PSNR of training views: {self.training_psnr:.2f}")
        masses = sorted(self.near_mass.items(), key=lambda pair: -pair[1])
        worst = ", ".join(f"{name} {mass:.4f}" for name, mass in masses[:3])
        parts.append(f"most optical depth near training cameras: {worst}")
        if self.near_density is not None:
            parts.append(f"optical depth where no surface is near them: {self.near_density:.4f}")
        return "\n".join([*parts, *self.left_out])

    def _classes(self) -> dict[float, list[float]]:
        """PSNR of views by the lower end of their class of angles."""
        classes: dict[float, list[float]] = {}
        for view in sorted(self.angles, key=lambda view: view.angle):
            classes.setdefault(view.angle // WIDTH * WIDTH, []).append(view.psnr)
        return classes


_SHARES = ("front", "hit", "behind", "transmitted")


def _shares(light: Light) -> list[float]:
    return [getattr(light, name) for name in _SHARES]


class Measuring:
    """Gathers measures while the views of a split are rendered."""

    def __init__(
        self, field: AnyField, scene: Scene, split: str, visibility: SurfaceVisibility | None = None
    ) -> None:
        """Begin.

        Args:
            field: A trained field.
            scene: Its training views are those of the field's training.
            split: Whose views will be added.
            visibility: Of the scene, where other fields of it are measured as well.
        """
        self._field, self._scene, self._split = field, scene, split
        self._visibility = SurfaceVisibility(scene) if visibility is None else visibility
        self._seen: dict[int, list[dict[str, float | None]]] = {least: [] for least in SEEN_BY}
        self._angles: list[ViewAngle] = []

    def add(self, view: View, target: np.ndarray, rendering: Rendering) -> None:
        """Add a view.

        Args:
            view: One of the split.
            target: Its photograph over the field's background, [H, W, 3] in [0, 1].
            rendering: Of its camera.
        """
        rgb = np.clip(rendering.rgb, 0.0, 1.0)
        self._angles.append(
            ViewAngle(
                name=view.name,
                angle=angle_to_nearest(view.camera, self._scene.training_cameras),
                psnr=psnr(rgb, target, view.mask),
            )
        )
        counts = self._visibility.counts(view, self._field.workers)
        truths = true_depths(self._scene, view)
        if counts is None or truths is None:
            return
        sparse = goes_by_points(self._scene)
        known = counts != NO_SURFACE
        if not known.any():
            return
        nearest = NEAREST * self._scene.content_distance
        for least, found in self._seen.items():
            mask = counts >= least
            if not mask.any():
                found.append({"share": 0.0})
            else:
                depths = rendering.depth[mask].astype(np.float64), truths[mask]
                found.append(
                    {
                        "share": float(mask.sum() / known.sum()),
                        "coverage": float(np.mean(rendering.opacity[mask] >= 0.5)),
                        "psnr": psnr(rgb, target, mask),
                        "ssim": None if sparse else ssim(rgb, target, mask),
                        **depth_errors(*depths, nearest),
                    }
                )

    def finish(
        self,
        masses: Sequence[tuple[float, int]],
        on_progress: Callable[[str], None] = lambda words: None,
    ) -> Measures:
        """Measure what is not of rendered views.

        Args:
            masses: What ``near_masses`` has found.
            on_progress: Told what is being measured.
        """
        field, scene = self._field, self._scene
        left_out, light = [], {}
        for split in dict.fromkeys((self._split, "train")):
            on_progress(f"light of {split} rays")
            found = measure_light(field, scene, split)
            if found is not None:
                light[split] = found
        if not light:
            left_out.append(
                "front, hit and behind: left out, as they need true depths, or points of structure "
                "from motion with tracks, and rays that are cut at distances, which those in "
                "normalised device coordinates are not"
            )
        seen = {
            str(least): _mean(found)
            for least, found in self._seen.items()
            if any(figures["share"] for figures in found)
        }
        if not seen:
            left_out.append(
                "pixels that training views see: left out, as true depths, or points of structure "
                "from motion with tracks, say which they are"
            )
        names = [scene.views[index].name for index in scene.splits["train"]]
        depths = [mass / n for mass, n in masses]
        on_progress("training views")
        fits = training_psnr(field, scene)
        density = None
        if scene.first_hit is not None:
            density = near_density(field, scene.training_cameras, scene.first_hit)
        return Measures(
            light=light,
            points_only=bool(seen or light) and goes_by_points(scene),
            seen=seen,
            near_mass=dict(zip(names, depths, strict=True)),
            near_density=density,
            angles=tuple(self._angles),
            training_psnr=fits,
            left_out=tuple(left_out),
        )


def training_psnr(field: AnyField, scene: Scene) -> float:
    """Mean PSNR of up to TRAINING_VIEWS training views, spread, dB."""
    indices = scene.splits["train"]
    found = []
    for index in indices[:: -(-len(indices) // TRAINING_VIEWS)]:
        view = scene.views[index]
        rgb = np.clip(field.render(view.camera).rgb, 0.0, 1.0)
        found.append(psnr(rgb, truth(view, field.background), view.mask))
    return float(np.mean(found))


def depth_errors(depth: np.ndarray, truth: np.ndarray, nearest: float) -> dict[str, float]:
    """Mean absolute, relative and inverse error of depths.

    Args:
        depth: [n] rendered, scene units.
        truth: [n] above 0, scene units.
        nearest: A rendered depth counts as no less, for its inverse; scene units.

    Returns:
        By field of ``SeenFigures``.
    """
    error = np.abs(depth - truth)
    inverse = np.abs(1.0 / np.maximum(depth, nearest) - 1.0 / truth)
    return {
        "depth_error": float(error.mean()),
        "relative_depth_error": float((error / truth).mean()),
        "inverse_depth_error": float(inverse.mean()),
    }


def angle_to_nearest(camera: Camera, others: list[Camera]) -> float:
    """Degrees between a camera's optical axis and the nearest of others', at least one."""
    cosines = np.array([other.forward for other in others]) @ camera.forward
    return float(np.degrees(np.arccos(np.clip(cosines.max(), -1.0, 1.0))))


def _mean(found: list[dict[str, float | None]]) -> SeenFigures:
    """Means over the views that have a figure; None where none has. All have a share."""
    means: dict[str, Any] = {}
    for name in SeenFigures.__dataclass_fields__:
        values = [value for figures in found if (value := figures.get(name)) is not None]
        means[name] = float(np.mean(np.array(values, float))) if values else None
    return SeenFigures(**means)
