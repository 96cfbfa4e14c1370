"""Floaters, measured without truth: what a field holds close to the cameras that trained it.

As a rule, nothing that was photographed is nearer to a camera than a small share of the content
distance; what a trained field holds there was put there by training. Where a scene can be
photographed again, views from further back show as well what hangs in front of the cameras.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.evaluation.metrics import psnr
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene

if TYPE_CHECKING:
    from warpnerf.rendering.composite import AnyField
    from warpnerf.rendering.field import Rendering

NEAR_SHARE = 0.1
"""What counts as near, in content distances of the scene."""

PULLED_SHARE = 0.2
"""How far cameras are pulled back, in content distances."""

MAX_PIXELS = 1024
"""Rays of a camera that are looked along, about; larger images are looked at coarsely."""

MAX_PULLED = 16
"""Cameras that are pulled back, at most, spread evenly over the training views."""

MIN_TRANSMITTANCE = 1e-6
"""Least light that is told from none: an optical depth counts as 13.8 at most."""


@dataclass(frozen=True, kw_only=True)
class NearField:
    """Floater metrics: what a field holds close to the training cameras."""

    within: float
    """What counts as close, scene units: NEAR_SHARE times the scene's content distance."""
    near_mass: float
    """Mean over rays of the optical depth up to there, the integral of sigma; 0 is empty."""
    near_rays: float
    """Share of rays that end there: at least half opaque, and expected depth below ``within``."""
    pulled_back: float | None = None
    """How far cameras were pulled back, scene units; None: there is no truth to hold them to."""
    pulled_psnr: float | None = None
    """Mean PSNR of the views from there, dB."""
    pulled_views: int | None = None
    """How many they are."""

    def to_dict(self) -> dict[str, float]:
        """What is known, by name."""
        return {name: value for name, value in vars(self).items() if value is not None}

    def __str__(self) -> str:
        """A line or two."""
        said = (
            f"within {self.within:.3g} scene units of the training cameras: mean optical depth "
            f"{self.near_mass:.4f}, {self.near_rays:.2%} of rays end there"
        )
        if self.pulled_psnr is not None:
            said += (
                f"\npulled back by {self.pulled_back:.3g} scene units: PSNR "
                f"{self.pulled_psnr:.2f} over {self.pulled_views} views"
            )
        return said


def measure_near_field(
    field: AnyField, scene: Scene, masses: Sequence[tuple[float, int]] | None = None
) -> NearField:
    """Measure floaters: what hangs in front of the training cameras.

    near_mass = mean over rays of the integral of sigma dt over t < within = mean of -log T(within)
    near_rays = share of rays with opacity >= 1/2 and (sum_i w_i t_i) / opacity < within

    over the pixels' rays of all training cameras. Neither needs truth. The truth of the first is 0
    where nothing was photographed from so close.

    Args:
        field: A trained field.
        scene: Its training views and content distance are those of the field's training; a scene
            that can be photographed again also gives PSNR of cameras pulled back.
        masses: What ``near_masses`` has found, if it has been called.
    """
    within = NEAR_SHARE * scene.content_distance
    mass, near, n_rays = 0.0, 0, 0
    found = near_masses(field, scene) if masses is None else masses
    for camera, (of_camera, n) in zip(scene.training_cameras, found, strict=True):
        mass += of_camera
        seen = field.render(_coarse(camera))
        near += int(ends_within(seen, within).sum())
        n_rays += n
    pulled = pulled_psnr(field, scene)
    return NearField(
        within=within,
        near_mass=mass / n_rays,
        near_rays=near / n_rays,
        pulled_back=PULLED_SHARE * scene.content_distance if pulled else None,
        pulled_psnr=float(np.mean(pulled)) if pulled else None,
        pulled_views=len(pulled) or None,
    )


def near_masses(field: AnyField, scene: Scene) -> Iterator[tuple[float, int]]:
    """Optical depth before each training camera up to NEAR_SHARE content distances.

    Returns:
        The sum over a camera's rays of the integral of sigma, and how many rays these are.
    """
    within = NEAR_SHARE * scene.content_distance
    close_by = field.up_to(within)
    for camera in scene.training_cameras:
        transmittance = 1.0 - close_by.render(_coarse(camera)).opacity
        depths = np.log(np.maximum(transmittance, MIN_TRANSMITTANCE))
        yield 0.0 - float(depths.sum(dtype=np.float64)), transmittance.size


def _coarse(camera: Camera) -> Camera:
    """The camera with about MAX_PIXELS pixels, at most."""
    return camera.downscaled(camera.block_for(MAX_PIXELS))


def ends_within(seen: Rendering, distance: float) -> np.ndarray:
    """Which rays of a rendering end within a distance, scene units: half opaque or more, and
    (sum_i w_i t_i) / opacity below it; bool, of the rendering's shape.
    """
    return np.asarray((seen.opacity >= 0.5) & (seen.depth < distance * seen.opacity))


def pulled_psnr(field: AnyField, scene: Scene) -> list[float]:
    """PSNR of training cameras moved straight back, where the scene can be photographed from there.

    Returns:
        dB, one for each view; none where the scene cannot be photographed again.
    """
    if scene.photograph is None:
        return []
    values = []
    cameras = scene.training_cameras
    for camera in cameras[:: math.ceil(len(cameras) / MAX_PULLED)]:
        moved = camera.moved_back(PULLED_SHARE * scene.content_distance)
        image = scene.photograph(moved)
        if image is not None:
            values.append(psnr(np.clip(field.render(moved).rgb, 0.0, 1.0), image / 255.0))
    return values
