"""Depths that a capture gives, checked against its photographs: bounds of LLFF, and depth maps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.extent.photo_consistency import DEPTHS, PhotoConsistency
from warpnerf.scenes.scene import View

SUPPORTED = 0.7
"""Support of bounds and of depth maps in some unit that are believed, at least; right ones have
0.95 and more, those in other units less than 0.6."""
REFUTED = 0.5
"""Support below which depth maps are doubted, whatever unit fits."""
UNITS = (1e-3, 1e3, 1e-2, 1e2, 0.1, 10.0, 0.2, 5.0, 0.3048, 1.0 / 0.3048)
"""That depths may be in, in those of the file: metres for millimetres, 1 / 5000 m, feet."""
OBLIQUE = 1.5
"""How many times as far as along the optical axis content is, at a picture's corners."""


def believed_bounds(
    photographs: PhotoConsistency, views: Sequence[View], bounds: np.ndarray | None
) -> tuple[np.ndarray | None, list[str]]:
    """Depth bounds, unless the photographs refute them: what they show is found at other depths.

    Args:
        photographs: Of the training, as they are posed.
        views: All.
        bounds: [n_views, 2] nearest and farthest depth, scene units; None: not known.

    Returns:
        The bounds, or None; and a warning of those that are left out.
    """
    if bounds is None:
        return None, []
    of = {view.name: pair for view, pair in zip(views, bounds, strict=True)}

    def between(view: View, middles: np.ndarray, most: float) -> np.ndarray:
        near, far = of[view.name]
        low = 1.0 / (OBLIQUE * far)
        # Nearer than the sweep only where all of it is: else the steps were too wide.
        high = max(min(1.0 / near, most), low)
        return np.tile(np.linspace(low, high, DEPTHS)[:, None], len(middles))

    if not photographs.tell_depths:
        return bounds, []
    support = photographs.support_of(between)
    if support is None or support >= SUPPORTED:
        return bounds, []
    near, far = np.median(bounds, axis=0)
    return None, [
        f"bounds of depth are not used: what the photographs show is not found between them, "
        f"{near:.4g} and {far:.4g} scene units by their median, but at other depths; they are "
        "likely in other units than the poses, so export both together"
    ]


def doubted_depths(photographs: PhotoConsistency) -> list[str]:
    """Detect depth maps that the photographs refute, and the unit in which they would fit.

    Args:
        photographs: That have depth, as they are posed.

    Returns:
        A warning, or none.
    """
    if not photographs.tell_depths:
        return []
    sampled: dict[str, np.ndarray] = {}

    def support(unit: float) -> float:
        def given(view: View, middles: np.ndarray, most: float) -> np.ndarray:
            if view.name not in sampled:
                assert view.depth is not None
                sampled[view.name] = view.depth[pixels_of(view.camera, middles)].astype(np.float64)
            return np.asarray(1.0 / (unit * sampled[view.name])[None])

        found = photographs.support_of(given)
        return SUPPORTED if found is None else found

    own = support(1.0)
    if own >= SUPPORTED:
        return []
    unit = max(UNITS, key=support)
    if support(unit) >= SUPPORTED:
        return [
            f"depth maps do not fit the photographs, but times {unit:.4g} they do, so depth_error "
            "is of no use: correct their unit, as by depth_unit_scale_factor"
        ]
    if own >= REFUTED:
        return []
    return [
        "depth maps do not fit the photographs in any unit, so depth_error is of no use: they may "
        "be inverse depths, or of other photographs"
    ]


def pixels_of(camera: Camera, middles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of a photograph that show what its undistorted picture does.

    Args:
        camera: Of the photograph.
        middles: [m, 2] in the undistorted picture, in [0, 1] of width and height.

    Returns:
        [m] rows and [m] columns, inside.
    """
    size, centre = np.array([camera.width, camera.height]), np.array([camera.cx, camera.cy])
    focal = np.array([camera.fx, camera.fy])
    pixels = camera.distort((middles * size - centre) / focal)[0] * focal + centre
    column, row = np.clip(pixels, 0, size - 1).astype(int).T
    return row, column
