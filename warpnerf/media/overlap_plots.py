"""Plots of how cameras share what they see: why space near a camera fills with floaters."""

from __future__ import annotations

import numpy as np

from warpnerf.media.plots import line_plot
from warpnerf.scenes.cameras.overlap import overlap_along_rays
from warpnerf.scenes.scene import Scene


def overlap_plots(scene: Scene) -> dict[str, np.ndarray]:
    """Plot how many training cameras see a point, and how densely they sample it, by its distance.

    After Philip & Deschaintre 2023, figure 4, of one capture; both axes are logarithmic.

    Args:
        scene: Its cameras; no photograph is read.

    Returns:
        [H, W, 3] uint8 each, by name of the file.
    """
    found = overlap_along_rays(scene.training_cameras, scene.content_distance)
    n = len(scene.splits["train"])
    along = "distance from the camera [scene units]"
    both = (True, True)
    counts = {"": (found.distances, found.cameras)}
    density = {"": (found.distances, found.density)}
    return {
        "cameras.png": line_plot(
            counts, f"{scene.name}: cameras that see a point, of {n}", (along, "cameras"), both
        ),
        "sampling.png": line_plot(
            density,
            f"{scene.name}: density of rays, all photographs",
            (along, "rays per area [1 / scene unit^2]"),
            both,
        ),
    }
