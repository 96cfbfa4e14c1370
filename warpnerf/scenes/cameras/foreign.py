"""Lens models of other programs: COLMAP's that are not OpenCV's, and Metashape's.

Each maps directions in OpenCV axes to image positions, in focal lengths from the principal point.
Kernels have OpenCV's lenses only: ``fitted`` finds the one that is nearest to such a lens.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import distorted_angle, largest_angle
from warpnerf.scenes.cameras.undistort import has_invertible_distortion

N_AZIMUTHS = 8
"""Directions around the axis along which a lens is looked at, besides those of the corners."""
N_ANGLES = 512
"""Angles to the axis, along each of them."""
PLANE_LIMIT = math.radians(89.0)
"""Largest angle to the axis of lenses that are defined on the plane Z = 1."""
PLANE_FIT = math.radians(80.0)
"""Up to which angle a lens on the plane Z = 1 is tried."""
PLANE_LAST = math.radians(55.0)
"""Up to which angle a pinhole camera stands where no fit is any good."""
MARGIN = 0.02
"""Beyond the image's edges, in its longer side, where the fit still counts."""
EXACT = 1e-3
"""Pixels by which a simpler lens may be off for no other to be tried."""
DIVISIONS = 8
"""Fits of a rational lens, each weighted by the divisor of the one before."""
MIN_DIVISOR = 1e-3
MIN_RISE = 0.02
"""Of the distance from the principal point by the angle: where it is less, no more is seen."""
MIN_POINTS = 64
TOLERANCE = 0.2
"""Pixels by which the nearest lens may be off for photographs to be used as they are: less than
what calibrations are off."""


@dataclass(frozen=True)
class ForeignLens:
    """A lens of another program, without its focal lengths and principal point."""

    model: str
    """One of ``MODELS``."""
    parameters: tuple[float, ...]
    """In the order of the model's formula."""
    skew: float = 0.0
    """Of y', added to x' times this."""

    def project(self, directions: np.ndarray) -> np.ndarray:
        """Image positions of directions.

        Args:
            directions: [n, 3] of any length, OpenCV axes: x right, y down, z into the scene.

        Returns:
            [n, 2] in focal lengths from the principal point; NaN where the lens sees nothing.
        """
        model = MODELS[self.model]
        x, y, z = np.asarray(directions, np.float64).T
        with np.errstate(all="ignore"):
            if model.fisheye:
                across = np.hypot(x, y)
                scale = np.where(across > 0.0, np.arctan2(across, z) / across, 1.0 / z)
            else:
                scale = np.where(z > 0.0, 1.0 / z, np.nan)
            u, v = model.distort(x * scale, y * scale, self.parameters)
        return np.stack([u + self.skew * v, v], axis=-1)

    @property
    def wrong(self) -> str:
        """What makes the parameters none of the model's; empty where nothing does."""
        if not all(math.isfinite(value) for value in (*self.parameters, self.skew)):
            return f"a parameter of its {self.model} lens is not a finite number"
        if self.model == "FOV" and not 0.0 <= self.parameters[0] < math.pi:
            return f"omega is {self.parameters[0]:g}, not radians from 0 to below pi"
        if self.model == "EUCM" and not 0.0 <= self.parameters[0] <= 1.0:
            return f"alpha is {self.parameters[0]:g}, not between 0 and 1"
        if self.model == "EUCM" and not self.parameters[1] > 0.0:
            return f"beta is {self.parameters[1]:g}, not above 0"
        return ""

    @property
    def limit(self) -> float:
        """The largest angle to the axis that the model is defined for, radians."""
        return math.pi if MODELS[self.model].fisheye else PLANE_LIMIT

    @property
    def tangential(self) -> tuple[float, float]:
        """OpenCV's p1 and p2, where the model has them on the plane Z = 1."""
        model = MODELS[self.model]
        return (0.0, 0.0) if model.tangential is None else model.tangential(self.parameters)


Distort = Callable[[Any, Any, tuple[float, ...]], tuple[Any, Any]]


@dataclass(frozen=True)
class Model:
    """A formula of distortion."""

    distort: Distort
    """From a point, and parameters, to the distorted point; focal lengths."""
    n: int
    """How many parameters it has."""
    fisheye: bool = False
    """Whether the point is the angle to the axis in its direction, and not (X/Z, Y/Z)."""
    tangential: Callable[[tuple[float, ...]], tuple[float, float]] | None = None
    """OpenCV's p1 and p2, of a lens on the plane Z = 1."""


def _fov(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Devernay and Faugeras: r' = atan(2 r tan(omega / 2)) / omega."""
    (omega,) = p
    if abs(omega) < 1e-6:
        return x, y
    r = np.maximum(np.hypot(x, y), 1e-12)
    factor = np.arctan(2.0 * r * math.tan(0.5 * omega)) / (r * omega)
    return x * factor, y * factor


def _thin_prism(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    k1, k2, p1, p2, k3, k4, s1, s2 = p
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + s1 * r2,
        y * radial + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y) + s2 * r2,
    )


def _rad_tan_thin_prism(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Tangential and prism terms are of the point that the radial ones have moved."""
    k, (p0, p1, s0, s1, s2, s3) = p[:6], p[6:]
    t2 = x * x + y * y
    radial = np.zeros_like(t2)
    for coefficient in reversed(k):
        radial = t2 * (coefficient + radial)
    x, y = x * (1.0 + radial), y * (1.0 + radial)
    r2 = x * x + y * y
    return (
        x + p0 * (r2 + 2.0 * x * x) + 2.0 * p1 * x * y + r2 * (s0 + r2 * s1),
        y + p1 * (r2 + 2.0 * y * y) + 2.0 * p0 * x * y + r2 * (s2 + r2 * s3),
    )


def _division(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Fitzgibbon: x = x' / (1 + k r'^2), of whose two solutions it is the one near x."""
    (k,) = p
    factor = 2.0 / (1.0 + np.sqrt(1.0 - 4.0 * k * (x * x + y * y)))
    return x * factor, y * factor


def _eucm(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Khomutenko, Garcia and Martinet, the enhanced unified camera model."""
    alpha, beta = p
    depth = alpha * np.sqrt(beta * (x * x + y * y) + 1.0) + (1.0 - alpha)
    factor = np.where(depth > 0.0, 1.0 / depth, np.nan)
    return x * factor, y * factor


def _brown(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Brown's polynomial up to r^8, with the tangential terms of Metashape and RealityCapture."""
    k1, k2, k3, k4, p1, p2, p3, p4 = p
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    grown = 1.0 + r2 * (p3 + r2 * p4)
    return (
        x * radial + grown * (p1 * (r2 + 2.0 * x * x) + 2.0 * p2 * x * y),
        y * radial + grown * (p2 * (r2 + 2.0 * y * y) + 2.0 * p1 * x * y),
    )


def _equisolid(x: Any, y: Any, p: tuple[float, ...]) -> tuple[Any, Any]:
    """Brown's polynomial of 2 sin(theta / 2) in place of theta."""
    theta = np.hypot(x, y)
    scale = np.where(theta > 0.0, 2.0 * np.sin(0.5 * theta) / np.maximum(theta, 1e-300), 1.0)
    return _brown(x * scale, y * scale, p)


MODELS = {
    "FOV": Model(_fov, 1),
    "THIN_PRISM_FISHEYE": Model(_thin_prism, 8, fisheye=True),
    "RAD_TAN_THIN_PRISM_FISHEYE": Model(_rad_tan_thin_prism, 12, fisheye=True),
    "SIMPLE_DIVISION": Model(_division, 1),
    "DIVISION": Model(_division, 1),
    "EUCM": Model(_eucm, 2),
    "BROWN": Model(_brown, 8, tangential=lambda p: (p[5], p[4])),
    "BROWN_FISHEYE": Model(_brown, 8, fisheye=True),
    "BROWN_EQUISOLID": Model(_equisolid, 8, fisheye=True),
}


@dataclass(frozen=True)
class ImagePlane:
    """An image plane: its size, focal lengths and principal point, pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Image positions [n, 2] of points in focal lengths from the principal point."""
        return points * [self.fx, self.fy] + [self.cx, self.cy]


@functools.lru_cache(maxsize=4096)
def fitted(lens: ForeignLens, plane: ImagePlane) -> tuple[Camera, float] | None:
    """The lens of OpenCV's that is nearest to another one, fitted by least squares.

    Args:
        lens: The other one.
        plane: Of its images.

    Returns:
        A camera at the origin whose distortion can be undone, and the most that it is off anywhere
        in the image, pixels; None where the other lens shows nearly nothing of the image.
    """
    seen = _seen(lens, plane)
    if seen is None:
        return None
    directions, positions, angles, distances = seen
    best: tuple[Camera, float] | None = None
    with np.errstate(all="ignore"):
        for camera in _candidates(lens, plane, angles, distances):
            off = _off(camera, directions, positions)
            if (best is None or off < best[1]) and has_invertible_distortion(camera):
                best = camera, off
                if off < EXACT:
                    break
    return best


def _candidates(
    lens: ForeignLens, plane: ImagePlane, angles: np.ndarray, distances: np.ndarray
) -> Iterator[Camera]:
    """Cameras fitted to distances from the principal point, the simplest first."""
    if angles.max() < PLANE_FIT:
        yield from _on_plane(lens, plane, np.tan(angles), distances)
    yield _of_angles(plane, angles, distances)
    yield _camera(plane, fisheye=bool(angles.max() > PLANE_LAST))


def _seen(
    lens: ForeignLens, plane: ImagePlane
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Directions [n, 3] that the image shows and where, pixels; and angles to the axis [m] with the
    mean distance from the principal point at each, focal lengths."""
    theta = np.linspace(0.0, lens.limit, N_ANGLES + 1)[1:]
    # Over these, what tangential and prism terms and a skew add is 0 in the mean.
    phi = 2.0 * math.pi * (np.arange(N_AZIMUTHS) + 0.5) / N_AZIMUTHS
    right, down = (
        np.array([-middle, side - middle]) / focal
        for side, focal, middle in (
            (plane.width, plane.fx, plane.cx),
            (plane.height, plane.fy, plane.cy),
        )
    )
    corners = [math.atan2(y, x) for x in right for y in down]
    phi = np.concatenate([phi, corners])
    across = np.stack([np.cos(phi), np.sin(phi)], axis=1)
    # Angles as dense near the axis for a long focal length: up to the corner, however far it is.
    for _ in range(6):
        grid = np.empty((len(phi), len(theta), 3))
        grid[..., :2] = across[:, None] * np.sin(theta)[:, None]
        grid[..., 2] = np.cos(theta)
        points = lens.project(grid.reshape(-1, 3)).reshape(len(phi), -1, 2)
        out = (points * across[:, None]).sum(axis=2)
        step = np.diff(theta, prepend=0.0)
        rises = np.diff(out, axis=1, prepend=0.0) > MIN_RISE * step
        with np.errstate(all="ignore"):
            pixels = plane.pixels(points)
        margin = MARGIN * max(plane.width, plane.height)
        inside = (pixels > -margin).all(axis=2) & (
            pixels < np.array([plane.width, plane.height]) + margin
        ).all(axis=2)
        kept = np.logical_and.accumulate(rises, axis=1) & inside
        last = int(kept.any(axis=0).sum())
        if last > len(theta) // 2 or last == 0:
            break
        theta = np.linspace(0.0, theta[last - 1] * 1.25, N_ANGLES + 1)[1:]
    if kept.sum() < MIN_POINTS:
        return None
    whole = np.logical_and.accumulate(rises, axis=1).all(axis=0) & kept.any(axis=0)
    if whole.sum() < MIN_POINTS:
        return None
    return grid[kept], pixels[kept], theta[whole], out[:N_AZIMUTHS, whole].mean(axis=0)


def _on_plane(
    lens: ForeignLens, plane: ImagePlane, r: np.ndarray, distorted: np.ndarray
) -> Iterator[Camera]:
    """OpenCV's lens with k1 to k3, then some with k1 to k6, whose radii are near the given ones."""
    r2, factor = r * r, distorted / r
    powers = [r2**power for power in (1, 2, 3)]
    p1, p2 = lens.tangential
    k = _least_squares([power * r for power in powers], (factor - 1.0) * r)
    yield _camera(plane, k1=k[0], k2=k[1], k3=k[2], p1=p1, p2=p2)
    # What is linear in the coefficients is the error times the divisor: divided by the last one,
    # it is nearly the error (Sanathanan and Koerner).
    weight = r
    for _ in range(DIVISIONS):
        columns = [*powers, *(-factor * power for power in powers)]
        k = _least_squares([column * weight for column in columns], (factor - 1.0) * weight)
        k1, k2, k3, k4, k5, k6 = k
        yield _camera(plane, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2, k4=k4, k5=k5, k6=k6)
        divisor = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        if not (divisor > MIN_DIVISOR).all():
            return
        weight = r / divisor


def _of_angles(plane: ImagePlane, theta: np.ndarray, distorted: np.ndarray) -> Camera:
    """A fisheye lens whose distances are the given ones; its focal lengths are fitted, too."""
    t2 = theta * theta
    s, *k = _least_squares([theta * t2**power for power in range(5)], distorted)
    if not s > 0.0:
        s, k = 1.0, [math.nan] * 4
    scaled = ImagePlane(plane.width, plane.height, plane.fx * s, plane.fy * s, plane.cx, plane.cy)
    k1, k2, k3, k4 = (value / s for value in k)
    return _camera(scaled, fisheye=True, k1=k1, k2=k2, k3=k3, k4=k4)


def _least_squares(columns: list[np.ndarray], target: np.ndarray) -> list[float]:
    matrix = np.stack(columns, axis=1)
    size = np.linalg.norm(matrix, axis=0)
    if not (np.isfinite(matrix).all() and np.isfinite(target).all() and (size > 0.0).all()):
        return [0.0] * len(columns)
    return [float(v) for v in np.linalg.lstsq(matrix / size, target, rcond=None)[0] / size]


def _camera(plane: ImagePlane, **lens: Any) -> Camera:
    finite = all(math.isfinite(value) for value in lens.values())
    return Camera(
        width=plane.width,
        height=plane.height,
        fx=plane.fx,
        fy=plane.fy,
        cx=plane.cx,
        cy=plane.cy,
        c2w=np.eye(3, 4),
        **(lens if finite else {}),
    )


def _off(camera: Camera, directions: np.ndarray, positions: np.ndarray) -> float:
    """The most that a camera's image positions of directions are off, pixels."""
    across = np.maximum(np.hypot(directions[:, 0], directions[:, 1]), 1e-300)
    if camera.fisheye:
        theta = np.arctan2(across, directions[:, 2])
        if theta.max() > largest_angle(camera.radial):
            return math.inf
        points = directions[:, :2] * (distorted_angle(camera.radial, theta)[0] / across)[:, None]
    else:
        points = camera.distort(directions[:, :2] / directions[:, 2:])[0]
    off = points * [camera.fx, camera.fy] + [camera.cx, camera.cy] - positions
    worst = float(np.linalg.norm(off, axis=1).max())
    return worst if math.isfinite(worst) else math.inf
