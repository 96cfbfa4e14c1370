"""Which of a view's surfaces training views see as well: others no training can know."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.scene import Scene, View

if TYPE_CHECKING:
    from warpnerf.runtime.parallel import Workers

TOLERANCE = 0.02
"""Share by which a view's depth may fall short of the distance to a place that it sees."""

SLACK = 1e-6
"""In the cosine of the angle to the axis, within which a ray is that of a picture's corner."""

NO_SURFACE = -1
"""Stands for a count at pixels whose true surface is not known, or which do not count."""


class SurfaceVisibility:
    """How many training views see the surfaces of a scene's views; each is looked at once.

    Cameras and true depths say so, or tracks of points, whatever was trained.
    """

    def __init__(self, scene: Scene) -> None:
        """Of a scene; nothing is counted yet."""
        self._scene = scene
        self._counts: dict[str, np.ndarray] = {}

    def counts(self, view: View, workers: Workers) -> np.ndarray | None:
        """How many training views see the surface of each of a view's pixels.

        Args:
            view: One of the scene's.
            workers: On which its rays are made.

        Returns:
            [H, W] int16, NO_SURFACE where none is known; None where nothing tells.
        """
        scene = self._scene
        depths = true_depths(scene, view)
        if depths is None or not (can_tell_sight(scene) or goes_by_points(scene)):
            return None
        if view.name not in self._counts:
            known = np.isfinite(depths)
            counts = np.full(known.shape, NO_SURFACE, np.int16)
            if goes_by_points(scene):
                counts[known] = _shown(scene, view)[1][known]
            elif known.any():
                _, rays = camera_rays(view.camera, workers)
                points = surfaces(view, rays.numpy())[known.ravel()]
                counts[known] = training_views_that_see(scene, points)
            self._counts[view.name] = counts
        return self._counts[view.name]


def true_depths(scene: Scene, view: View) -> np.ndarray | None:
    """True distances along a view's rays, as far as they are known of pixels that count.

    They are those of the view, or, where the scene has none of any view, the distances of the
    points of structure from motion that its photograph shows, each at its pixel.

    Args:
        scene: The view's.
        view: Any of its views.

    Returns:
        [H, W] scene units, NaN where none is known; None where that is everywhere so.
    """
    if view.depth is not None:
        depths = np.where(np.isfinite(view.depth) & (view.depth > 0.0), view.depth, np.nan)
    elif goes_by_points(scene):
        depths = _shown(scene, view)[0]
    else:
        return None
    return depths if view.mask is None else np.where(view.mask, depths, np.nan)


def goes_by_points(scene: Scene) -> bool:
    """Whether only points of structure from motion tell where surfaces are, and who sees them."""
    dense = scene.first_hit is not None or any(view.depth is not None for view in scene.views)
    return scene.tracks is not None and not dense


def _shown(scene: Scene, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Distances of the points that a view's photograph shows, NaN elsewhere, and how many training
    views show each: [H, W] both; of several in a pixel the nearest."""
    tracks = scene.tracks
    assert tracks is not None
    chosen = tracks.of(view.name)
    points = tracks.positions[chosen]
    inside, (columns, rows) = _in_picture(view.camera, points)
    away = np.linalg.norm(points[inside] - view.camera.position, axis=1)
    training = (scene.views[index].name for index in scene.splits["train"])
    counts = tracks.counts(training)[chosen[inside]]
    far_first = np.argsort(-away, kind="stable")
    size = (view.camera.height, view.camera.width)
    depths, of_pixels = np.full(size, np.nan), np.zeros(size, int)
    depths[rows[far_first], columns[far_first]] = away[far_first]
    of_pixels[rows[far_first], columns[far_first]] = counts[far_first]
    return depths, of_pixels


def can_tell_sight(scene: Scene) -> bool:
    """Whether it is known what hides surfaces from training views: by tracing, or by depths."""
    views = (scene.views[index] for index in scene.splits["train"])
    return scene.first_hit is not None or any(view.depth is not None for view in views)


def training_views_that_see(scene: Scene, points: np.ndarray) -> np.ndarray:
    """How many training views see each of some places on true surfaces.

    A view sees a place that falls on one of its pixels that count, with nothing before it: no
    surface that the scene's tracer meets, or else none in the view's true depths, to TOLERANCE.
    Views of which neither is known count as if they saw nothing.

    Args:
        scene: Its training views.
        points: [n, 3] scene units.

    Returns:
        [n] int.
    """
    counts = np.zeros(len(points), int)
    for index in scene.splits["train"]:
        counts += _sees(scene, scene.views[index], points)
    return counts


def surfaces(view: View, rays: np.ndarray) -> np.ndarray:
    """True surfaces at a view's pixels, [n, 3] scene units; not finite where the depth is not.

    Args:
        view: With true depths.
        rays: [n, 3] directions of its pixels' rays, unit vectors.
    """
    assert view.depth is not None
    with np.errstate(invalid="ignore"):
        depth = view.depth.reshape(-1, 1).astype(np.float64)
        return np.asarray(view.camera.position + depth * rays)


def _sees(scene: Scene, view: View, points: np.ndarray) -> np.ndarray:
    """Which places one view sees, [n] bool."""
    candidates, (columns, rows) = _in_picture(view.camera, points)
    apart = points[candidates] - view.camera.position
    distances = np.linalg.norm(apart, axis=1)
    depths = np.zeros(len(candidates))
    if scene.first_hit is not None:
        origins = np.broadcast_to(view.camera.position, apart.shape)
        depths = scene.first_hit(origins, apart / distances[:, None])
    elif view.depth is not None:
        depths = view.depth[rows, columns]
        depths = np.where(np.isfinite(depths), depths, 0.0)
    found = depths >= (1.0 - TOLERANCE) * distances
    if view.mask is not None:
        found &= view.mask[rows, columns]
    seen = np.zeros(len(points), bool)
    seen[candidates[found]] = True
    return seen


def _in_picture(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points fall into a camera's picture, [n] indices, and columns and rows there, [2, n].

    Points farther off the axis than any corner of the picture do not, where a lens folds them back.
    """
    x, y, z = ((points - camera.position) @ camera.c2w[:, :3]).T
    right, down = float(camera.width), float(camera.height)
    corners = directions(camera, np.array([[0.0, 0.0], [right, 0.0], [0.0, down], [right, down]]))
    with np.errstate(invalid="ignore", over="ignore"):
        widest = corners[:, 2].max() + SLACK
        before = np.flatnonzero((z < 0.0) & (z <= widest * np.sqrt(x * x + y * y + z * z)))
    x, y, z = x[before], y[before], z[before]
    on_plane, _ = camera.distort(np.stack([-x / z, y / z], axis=1))
    u, v = camera.cx + camera.fx * on_plane[:, 0], camera.cy + camera.fy * on_plane[:, 1]
    inside = (u >= 0.0) & (u < right) & (v >= 0.0) & (v < down)
    return before[inside], np.floor(np.stack([u, v])[:, inside]).astype(int)
