"""Where floaters are, from above: density around the training cameras as a plan."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from warpnerf.evaluation.near_field import MIN_TRANSMITTANCE, NEAR_SHARE
from warpnerf.scenes.cameras.focus import horizontal_axes
from warpnerf.scenes.scene import Scene

if TYPE_CHECKING:
    from warpnerf.rendering.field import Field

MAX_CELLS = 320
"""Of a plan along each side, at most."""

ACROSS = 32
"""Cells across the ball around a camera, at most."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearPlan:
    """Optical depth around training cameras, seen from above."""

    depths: np.ndarray
    """[n, n] the optical depth of the vertical line through each cell, as far as it lies within
    NEAR_SHARE content distances of a camera, the one of which it is most; NaN where none is near.
    The first index goes along axes[0], the second along axes[1]."""
    axes: tuple[int, int]
    """Of the scene, to the right and ahead."""
    middle: np.ndarray
    """[3] of the plan, scene units."""
    extent: float
    """Of each side, scene units."""


def near_plan(field: Field, scene: Scene) -> NearPlan | None:
    """Measure the density around the training cameras as a plan.

    A vertical line meets the ball of radius r = NEAR_SHARE content distances around a camera in a
    part of length 2 sqrt(r^2 - d^2), d its distance from the camera in the plan. The optical depth
    of that part is -log(1 - opacity), at most 13.8. Its true value is 0 where nothing is so close.

    Args:
        field: A trained field.
        scene: Its training views and content distance are those of the field's training.

    Returns:
        The plan; None in normalised device coordinates, whose rays are not cut at distances.
    """
    if field.in_ndc:
        return None
    cameras = scene.training_cameras
    right, ahead = axes = horizontal_axes(cameras)
    radius = NEAR_SHARE * scene.content_distance
    places = np.array([camera.position for camera in cameras])
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    extent = 1.05 * (float(np.ptp(places[:, axes], axis=0).max()) + 2.0 * radius)
    n = int(np.clip(math.ceil(extent * ACROSS / (2.0 * radius)), 1, MAX_CELLS))
    cells = (np.arange(n) + 0.5) * extent / n - 0.5 * extent
    depths = np.full((n, n), np.nan)
    whole = field.up_to(math.inf)  # marched: also densities that hardly any light reaches
    near = whole.steps.near
    for place in places:
        apart = np.hypot(
            (middle[right] + cells - place[right])[:, None], middle[ahead] + cells - place[ahead]
        )
        rows, columns = np.nonzero(apart < radius)
        origins = np.repeat(place[None], max(1, len(rows)), axis=0)
        if len(rows) == 0:  # a ball smaller than a cell: the line through the camera
            rows, columns = (np.array([k]) for k in np.unravel_index(apart.argmin(), apart.shape))
            half = np.array([radius])
        else:
            half = np.sqrt(radius**2 - apart[rows, columns] ** 2)
            origins[:, right] = middle[right] + cells[rows]
            origins[:, ahead] = middle[ahead] + cells[columns]
        up = 3 - right - ahead
        origins[:, up] -= half + near
        directions = np.repeat(np.eye(3)[None, up], len(rows), axis=0)
        ends = near + np.stack([np.zeros_like(half), 2.0 * half], axis=1)
        light = 1.0 - whole.render_between(origins, directions, ends).opacity.astype(np.float64)
        found = -np.log(np.maximum(light, MIN_TRANSMITTANCE))
        depths[rows, columns] = np.fmax(depths[rows, columns], found)
    return NearPlan(depths=depths, axes=axes, middle=middle, extent=extent)
