"""The frustum of a forward-facing capture: the space before its cameras, as a box.

Coordinates in it are normalised device coordinates, those of ``warpnerf_kernels.space.ndc``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.grid_config import Contraction
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.scene import Scene

MAX_ANGLE = math.radians(45.0)
"""Between the axis of a training camera and their mean: a camera looks 25 to 35 degrees to each
side of its axis, and the grid ends at MAX_TANGENT."""

ALIKE = math.radians(30.0)
"""The same, of captures that are trained in such coordinates without being asked."""

MAX_TANGENT = 4.0
"""Rays further from the mean axis, 76 degrees, may leave the grid at its sides."""

MARGIN = 0.8
"""Depth of the near plane, in that of the nearest content."""

NEAREST = 0.4
"""The nearest content, in content distances, where neither bounds nor points tell."""

FARTHEST = 1000.0
"""Depth of the far plane, in near planes; that of the kernels."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Frustum:
    """A centre of projection, and normalised device coordinates e = (x/w, y/w, depth (1 - n/w)).

    (x, y, w) is a point in the frustum's axes, n the depth of the near plane.
    """

    origin: np.ndarray
    """[3] centre of projection, scene units."""
    axes: np.ndarray
    """[3, 3] unit vectors in rows: right, down, forward."""
    near: float
    """n, scene units."""
    depth: float = 1.0
    """e_z of what is infinitely far; that of the near plane is 0."""

    def to_ndc(self, points: np.ndarray) -> np.ndarray:
        """Coordinates of points.

        Args:
            points: [..., 3] scene units.

        Returns:
            [..., 3]; not finite where a point does not lie in front of the centre.
        """
        x, y, w = np.moveaxis((np.asarray(points, np.float64) - self.origin) @ self.axes.T, -1, 0)
        w = np.where(w > 0.0, w, np.nan)
        return np.stack([x / w, y / w, self.depth * (1.0 - self.near / w)], axis=-1)

    def to_scene(self, coordinates: np.ndarray) -> np.ndarray:
        """Points of coordinates, the inverse of ``to_ndc``.

        Args:
            coordinates: [..., 3]

        Returns:
            [..., 3] scene units; not finite from the depth of what is infinitely far on.
        """
        e = np.asarray(coordinates, np.float64)
        with np.errstate(divide="ignore"):
            w = self.near / np.maximum(1.0 - e[..., 2] / self.depth, 0.0)
        with np.errstate(invalid="ignore"):
            local = np.stack([e[..., 0] * w, e[..., 1] * w, w], axis=-1)
            return self.origin + local @ self.axes

    def depths(self, points: np.ndarray) -> np.ndarray:
        """w of points [..., 3], scene units."""
        return (points - self.origin) @ self.axes[2]


def faces_forward(scene: Scene) -> bool:
    """Whether a capture was made for normalised device coordinates.

    Its file gives bounds of depth, as LLFF's does, and its training cameras look the same way. Such
    captures are of a small area; others may look the same way from places far apart, before which
    a frustum is mostly empty.

    Raises:
        InputError: They look the same way, but bounds make no sense.
    """
    if scene.bounds is None:
        return False
    forward = np.array([camera.forward for camera in scene.training_cameras])
    mean = forward.mean(axis=0)
    cosines = forward @ mean / max(float(np.linalg.norm(mean)), 1e-9)
    if float(cosines.min()) < math.cos(ALIKE):
        return False
    _require_bounds(scene)
    try:
        fit_frustum(scene, 2, 8)
    except InputError:  # content beside the cameras or behind them
        return False
    return True


def _require_bounds(scene: Scene) -> None:
    assert scene.bounds is not None
    for index in scene.splits["train"]:
        near, far = scene.bounds[index]
        if not 0.0 < near < far < math.inf:
            raise InputError(
                f"{scene.name}: the bounds of {scene.views[index].name}, the last two numbers of "
                "its row in poses_bounds.npy, must be two depths above 0, the nearer first, not "
                f"{near:g} and {far:g}; correct them, or train with --contraction linf, which does "
                "not need them."
            )


def contraction_of(scene: Scene, config: TrainConfig) -> Contraction:
    """How space outside the box is mapped: what is configured, auto decided for a scene."""
    if config.grid.contraction != "auto":
        return config.grid.contraction
    if not scene.unbounded:
        return "none"
    return "ndc" if config.jacobian == "none" and faces_forward(scene) else "linf"


def fit_frustum(
    scene: Scene, planes: int, voxels: int
) -> tuple[Frustum, tuple[np.ndarray, np.ndarray]]:
    """The frustum that holds what the training cameras of a scene see, and its box.

    Its frame is the mean of the cameras'. The near plane lies before the nearest content, as the
    capture's bounds say, its points, or else its content distance.

    Args:
        scene: Forward-facing.
        planes: Nodes along its depth.
        voxels: Nodes in all; those of the box are as far apart along each axis.

    Returns:
        The frustum; lower and upper corner [3] of the box in its coordinates, which all rays of the
        cameras enter by the near plane and leave by the far one.

    Raises:
        InputError: The scene is not forward-facing, its bounds make no sense, or content lies
            beside the cameras or behind them.
    """
    cameras = scene.training_cameras
    forward = _unit(np.mean([c.forward for c in cameras], axis=0))
    for index in scene.splits["train"]:
        view = scene.views[index]
        cosine = float(np.clip(view.camera.forward @ forward, -1.0, 1.0))
        if not cosine > math.cos(MAX_ANGLE):
            raise InputError(
                f"grid.contraction is ndc, which is for cameras that look the same way, but that "
                f"of {view.name} looks {math.degrees(math.acos(cosine)):.0f} degrees away from "
                "the mean of all; use --contraction auto."
            )
    up = np.mean([c.c2w[:, 1] for c in cameras], axis=0)
    up = _unit(up - (up @ forward) * forward)
    frustum = Frustum(
        origin=np.mean([c.position for c in cameras], axis=0),
        axes=np.stack([np.cross(forward, up), -up, forward]),
        near=1.0,
    )
    frustum = replace(frustum, near=MARGIN * _nearest(scene, frustum))
    low, high = _sides(cameras, frustum)
    planes = max(2, min(planes, voxels // 4))
    edge = math.sqrt(float(np.prod(high - low)) * planes / voxels)
    extent = edge * (planes - 1)
    frustum = replace(frustum, depth=extent / (1.0 - 1.0 / FARTHEST))
    return frustum, (np.append(low, 0.0), np.append(high, extent))


def _unit(vector: np.ndarray) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    if length < 1e-6:
        raise InputError(
            "grid.contraction is ndc, which is for cameras that look the same way, but those for "
            "training look to all sides; use --contraction auto."
        )
    return vector / length


def _nearest(scene: Scene, frustum: Frustum) -> float:
    """Depth of the nearest content in the frustum's frame, scene units."""
    cameras = scene.training_cameras
    places = frustum.depths(np.array([c.position for c in cameras]))
    facing = np.array([c.forward for c in cameras]) @ frustum.axes[2]
    if scene.bounds is not None:
        _require_bounds(scene)
        away = scene.bounds[list(scene.splits["train"]), 0]
    elif scene.near_content is not None:
        away = np.full(len(cameras), scene.near_content)
    else:
        away = np.full(len(cameras), NEAREST * scene.content_distance)
    nearest = float((places + facing * away).min())
    if nearest <= 0.0:
        raise InputError(
            f"grid.contraction is ndc, which is for content in front of all cameras, but the "
            f"nearest lies {-nearest:.3g} scene units behind the middle of {scene.name}'s training "
            "cameras; use --contraction auto."
        )
    return nearest


def _sides(cameras: list[Camera], frustum: Frustum) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest (x/w, y/w) of the cameras' rays between near and far plane, [2] each."""
    found = []
    for camera in cameras:
        u, v = np.linspace(0.0, camera.width, 9), np.linspace(0.0, camera.height, 9)
        pixels = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
        rays = directions(camera, pixels) @ camera.c2w[:, :3].T @ frustum.axes.T
        rays = rays[np.isfinite(rays).all(axis=1)]
        begin = frustum.axes @ (camera.position - frustum.origin)
        tangents = rays[:, :2] / np.maximum(rays[:, 2:], 1e-6)
        tangents = np.clip(tangents, -MAX_TANGENT, MAX_TANGENT)
        for w in (max(frustum.near, begin[2]), FARTHEST * frustum.near):
            found.append((begin[:2] + (w - begin[2]) * tangents) / w)
    sides = np.concatenate(found)
    return sides.min(axis=0), sides.max(axis=0)
