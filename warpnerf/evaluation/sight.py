"""Which of a view's surfaces training views see as well: others no training can know."""

from __future__ import annotations

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.overlap import in_picture
from warpnerf.scenes.scene import Scene, View

TOLERANCE = 0.02
"""Share by which a view's depth may fall short of the distance to a place that it sees."""


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


def surfaces(view: View, directions: np.ndarray) -> np.ndarray:
    """True surfaces at a view's pixels, [n, 3] scene units; not finite where the depth is not.

    Args:
        view: With true depths.
        directions: [n, 3] of its pixels' rays, unit vectors.
    """
    assert view.depth is not None
    with np.errstate(invalid="ignore"):
        depth = view.depth.reshape(-1, 1).astype(np.float64)
        return np.asarray(view.camera.position + depth * directions)


def _sees(scene: Scene, view: View, points: np.ndarray) -> np.ndarray:
    """Which places one view sees, [n] bool."""
    seen = in_picture(view.camera, points)
    columns, rows = _pixels(view.camera, points[seen])
    inside = (columns >= 0) & (columns < view.camera.width)
    inside &= (rows >= 0) & (rows < view.camera.height)
    columns, rows = columns[inside], rows[inside]
    candidates = np.flatnonzero(seen)[inside]
    apart = points[candidates] - view.camera.position
    distances = np.linalg.norm(apart, axis=1)
    depths = np.zeros(len(candidates))
    if scene.first_hit is not None:
        directions = apart / distances[:, None]
        depths = scene.first_hit(np.broadcast_to(view.camera.position, apart.shape), directions)
    elif view.depth is not None:
        depths = np.nan_to_num(view.depth[rows, columns])
    found = depths >= (1.0 - TOLERANCE) * distances
    if view.mask is not None:
        found &= view.mask[rows, columns]
    seen[:] = False
    seen[candidates[found]] = True
    return seen


def _pixels(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column and row of the pixel that each point before a camera falls on."""
    x, y, z = ((points - camera.position) @ camera.c2w[:, :3]).T
    on_plane, _ = camera.distort(np.stack([-x / z, y / z], axis=1))
    u, v = camera.cx + camera.fx * on_plane[:, 0], camera.cy + camera.fy * on_plane[:, 1]
    return np.floor(u).astype(int), np.floor(v).astype(int)
