"""Extent of a scene that brings no points: by the depths at which photographs show the same.

A plane sweep (``photo_consistency``) finds patches of each photograph again in its neighbours.
Where one depth is clearly the best there is a surface, and what points tell, these places tell
(``points.observed_extent``).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpnerf.scenes.extent.patches import LEAST_SIDE
from warpnerf.scenes.extent.photo_consistency import PhotoConsistency
from warpnerf.scenes.extent.points import ObservedExtent, observed_extent
from warpnerf.scenes.scene import Scene

MOST_PHOTOGRAPHS = 256
"""Whose patches are looked for; of more every n-th."""
OUTSIDE = 0.05
"""Share of what cameras see that may lie outside the box at each face: depths are rougher than
matched points, whether photographs or a short training tell them."""

NEARER = 0.03
"""Share of it that is nearer than the near content, likewise."""


def extent_by_sweep(scene: Scene) -> ObservedExtent | None:
    """What the training cameras of a scene see, by its photographs alone.

    Args:
        scene: Any; its poses are taken to be right.

    Returns:
        Distances, box and some of the places; None where photographs are too few, too small or
        without texture, do not fit their poses, or tell it to too few cameras.
    """
    cameras = scene.cameras
    large = [
        index
        for index in scene.splits["train"]
        if min(cameras[index].width, cameras[index].height) >= LEAST_SIDE
    ]
    chosen = large[:: max(1, -(-len(large) // MOST_PHOTOGRAPHS))]
    views = [scene.views[index] for index in chosen]
    poses = np.array([view.camera.c2w for view in views])
    photographs = PhotoConsistency(views=views, poses=poses)
    if not photographs.tell_depths:
        return None
    seen = [np.empty((0, 3))] * len(scene.views)
    for number, index in enumerate(chosen):
        seen[index] = photographs.surfaces(number)
    observed = observed_extent(cameras, seen, chosen, OUTSIDE, NEARER)
    return None if observed is None else replace(observed, found_by="comparing the photographs")
