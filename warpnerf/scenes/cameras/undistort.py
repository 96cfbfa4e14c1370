"""Lens undistortion: from image positions back to directions, and whether that is possible."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import angle_of, distorted_angle, largest_angle

COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
"""Of a lens, by their names."""

LENS = ("width", "height", "fx", "fy", "cx", "cy", *COEFFICIENTS, "fisheye")
"""The fields of a camera that are not its pose."""

MIN_DETERMINANT = 0.01
N_GRID = 9
N_STRIDES = 32
N_NEWTON = 6
MAX_RESIDUAL = 1e-6

N_KNOTS = 65
"""Along each side of an image, where ``axis_cosines`` undoes the distortion."""

MIN_SEEN = 0.25
"""Share of a fisheye's image that must come from a direction: the rest may lie around a circle."""


def has_invertible_distortion(camera: Camera) -> bool:
    """Whether every point of the image comes from one direction, so distortion can be undone.

    Follows the straight lines from the principal point to a grid over the image and undoes the
    distortion on the way by Newton's method. The distortion folds over where the determinant of
    its Jacobian reaches 0; less than ``MIN_DETERMINANT`` on the way is refused already. Of a
    fisheye's image only a share of ``MIN_SEEN`` has to come from a direction.
    """
    if camera.fisheye:
        return _share_seen(camera) >= MIN_SEEN
    return _is_invertible(*(getattr(camera, name) for name in LENS))


@functools.lru_cache(maxsize=64)
def _is_invertible(*lens: Any) -> bool:
    camera = posed(lens)
    targets = (_grid(camera) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return _undistorted(camera, targets, N_STRIDES) is not None


def posed(lens: tuple[Any, ...]) -> Camera:
    """A camera of a lens that is given by its fields ``LENS``; its pose does not matter."""
    return Camera(**dict(zip(LENS, lens, strict=True)), c2w=np.eye(3, 4))


def _grid(camera: Camera, n: int = N_GRID) -> np.ndarray:
    """Image positions [n^2, 2] from corner to corner, row by row, pixels."""
    u, v = np.linspace(0.0, camera.width, n), np.linspace(0.0, camera.height, n)
    return np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)


def _undistorted(camera: Camera, targets: np.ndarray, n_strides: int) -> np.ndarray | None:
    """Points on the plane Z = 1 whose distorted ones are given, [n, 2]; None where there are none.

    For lenses that are no fisheye. The targets move out from the principal point in strides.
    """
    points = np.zeros_like(targets)
    with np.errstate(all="ignore"):
        for share in np.linspace(0.0, 1.0, n_strides + 1)[1:]:
            for _ in range(N_NEWTON):
                distorted, jacobian = camera.distort(points)
                if not _keeps_orientation(jacobian):
                    return None
                residual = share * targets - distorted
                points = points + np.linalg.solve(jacobian, residual[:, :, None])[:, :, 0]
            distorted, jacobian = camera.distort(points)
            if not _keeps_orientation(jacobian):
                return None
            if not np.abs(share * targets - distorted).max() < MAX_RESIDUAL:
                return None
    return points


def _radii(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Distances of image positions [n, 2] from the principal point, in focal lengths."""
    targets = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.asarray(np.linalg.norm(targets, axis=-1))


def _last_radius(camera: Camera) -> float:
    """How far from the principal point a fisheye's image comes from a direction, focal lengths."""
    return float(distorted_angle(camera.radial, largest_angle(camera.radial))[0])


def _share_seen(camera: Camera) -> float:
    return float(np.mean(_radii(camera, _grid(camera)) <= _last_radius(camera)))


def seen_pixels(camera: Camera) -> np.ndarray | None:
    """The pixels of an image that come from a direction: all, but for corners of a fisheye's.

    Args:
        camera: Of the image.

    Returns:
        [H, W] bool; None where all do.
    """
    if not camera.fisheye:
        return None
    last = _last_radius(camera)
    if (_radii(camera, _grid(camera)) <= last).all():  # the grid holds the corners
        return None
    across, along = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    x, y = (across - camera.cx) / camera.fx, (along - camera.cy) / camera.fy
    return np.asarray(x * x + (y * y)[:, None] <= last * last)


def directions(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    """Which way image positions look, in the camera's own axes.

    Args:
        camera: Its pose does not matter.
        pixels: [n, 2] (u, v), pixels from the left and the top edge.

    Returns:
        [n, 3] unit vectors, OpenGL axes: x right, y up, the camera looks along -z.
    """
    targets = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.fisheye:
        radii = np.maximum(np.linalg.norm(targets, axis=1), 1e-12)
        angles = angle_of(camera.radial, radii)
        x, y = (targets * (np.sin(angles) / radii)[:, None]).T
        return np.stack([x, -y, -np.cos(angles)], axis=1)
    distorted = any(getattr(camera, name) for name in COEFFICIENTS)
    points = _undistorted(camera, targets, N_STRIDES // 4) if distorted else targets
    x, y = (targets if points is None else points).T
    rays = np.stack([x, -y, -np.ones_like(x)], axis=1)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def axis_cosines(camera: Camera) -> np.ndarray:
    """Cosine of the angle between each pixel's ray and the optical axis, [H, W].

    With distortion it is interpolated linearly, to about 1e-4.
    """
    across, along = np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5
    if not camera.fisheye and not any(getattr(camera, name) for name in COEFFICIENTS):
        x, y = (across - camera.cx) / camera.fx, (along - camera.cy) / camera.fy
        return np.asarray(1.0 / np.sqrt(1.0 + x * x + (y * y)[:, None]))
    knots = _knot_cosines(*(getattr(camera, name) for name in LENS))
    shares = (along * ((N_KNOTS - 1) / camera.height), across * ((N_KNOTS - 1) / camera.width))
    down, right = (np.maximum(0.0, 1.0 - np.abs(s[:, None] - np.arange(N_KNOTS))) for s in shares)
    return np.asarray(down @ knots @ right.T)


@functools.lru_cache(maxsize=16)
def _knot_cosines(*lens: Any) -> np.ndarray:
    """Of a lens with the fields ``LENS``, from corner to corner, [N_KNOTS, N_KNOTS]."""
    camera = posed(lens)
    return -directions(camera, _grid(camera, N_KNOTS))[:, 2].reshape(N_KNOTS, N_KNOTS)


def _keeps_orientation(jacobian: np.ndarray) -> bool:
    """Whether [n, 2, 2] matrices are all positive definite; false where they are not finite."""
    determinant = np.linalg.det(jacobian)
    trace = jacobian[:, 0, 0] + jacobian[:, 1, 1]
    return bool((determinant > MIN_DETERMINANT).all() and (trace > 0.0).all())
