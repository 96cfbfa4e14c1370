"""What cameras tell of a scene's extent: where they look, how far that is, and a box around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import angle_of

UNBOUNDED_BOX_SHARE = 0.75
"""Half edge of the box of photographs, in content distances."""

MIN_AXIS_SPREAD = 1e-4
"""Mean squared sine of the axes to their mean, below which they count as parallel: 0.6 degrees."""

NEARLY_PARALLEL = 0.1
"""The same, below which axes meet at small angles, 18 degrees: whether they do is looked into."""

MIN_CONVERGENCE = 0.75
"""Share of the cameras' spread across nearly parallel axes that must be gone where these meet. With
a share c, the distance lies between that of least squares and 1 / c of it: what axes point to at
random draws it nearer (errors in variables)."""

MIN_LEVEL_SPREAD = 0.02
"""Mean squared sine of the horizontal axes to their main direction, for their plane to be known."""

MIN_SHARE_IN_FRONT = 0.75
"""Share of cameras that must have the focus in front of them for it to be what they look at."""

MIN_SHARE_AIMED = 0.75
"""Share of cameras that must have the focus in the middle of their image, for it to be a common
one."""

MAX_HALF_ANGLE = math.radians(60.0)
"""Of a fisheye lens, for the box of what its images show: their rims are mostly background."""

FAR_OFF = 10.0
"""A camera this many times the median distance away from the median place is far from all others,
and likely a mistake."""

MAX_SHARE_FAR_OFF = 0.25
"""Of the cameras: more that are far off are another place that was photographed, and count."""

NO_UP = 0.45
"""Length of the mean of the cameras' own up axes, below which it tells no direction."""
ONE_WAY = 0.8
"""Length of the mean of their optical axes, from which on they look one way."""
SPLIT = 0.95
"""Share of cameras whose up axes must be within 60 degrees of one line, either way."""

MAX_OFFSET = 1e4
"""Largest distance from the origin, in spreads of the cameras, that single precision resolves."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Focus:
    """What the cameras look at, and from how far."""

    point: np.ndarray
    """[3] scene units."""
    distance: float
    """The content distance, scene units."""
    how: str
    """How they were found: the second half of a sentence."""
    guessed: bool = False
    """Whether the cameras look at no common point, and the distance is a guess."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Extent:
    """The fields of Scene that are estimated from its calibration."""

    box_min: np.ndarray
    """[3] scene units."""
    box_max: np.ndarray
    """[3] scene units."""
    content_distance: float
    """Scene units."""
    notes: tuple[str, ...]
    """How each was found, one sentence each."""
    guessed: bool = False
    """As of ``Focus``."""


def far_off(cameras: Sequence[Camera]) -> np.ndarray:
    """Outliers of camera centres, [n] bool: those that are far away from all others.

    Args:
        cameras: At least one.
    """
    places = np.array([camera.position for camera in cameras])
    away = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    return np.asarray(away > FAR_OFF * float(np.median(away)))


def find_focus(cameras: Sequence[Camera]) -> Focus:
    """Find the point closest to all optical axes, and its median depth.

    point = argmin_p sum_i |(I - d_i d_i^T)(p - o_i)|^2, with centres o_i and unit axes d_i, so
    sum_i (I - d_i d_i^T) p = sum_i (I - d_i d_i^T) o_i;  distance = median_i d_i . (point - o_i)

    Where the axes are parallel, or nearly and do not meet, or the point lies behind
    many cameras because they look outward, distance = mean_i |o_i - mean o| and
    point = mean o + distance * mean d, and ``how`` says so.
    Where they look in and out, few have the point in the middle of their image: see ``guessed``.

    A few cameras that are far away from all others are left out: see ``far_off``.

    Args:
        cameras: The training cameras, at least two, not all in one place.

    Raises:
        InputError: Fewer cameras, all in one place, or too far from the origin for their spread.
    """
    if len(cameras) < 2:
        raise InputError(
            f"the content distance needs at least 2 training cameras, not {len(cameras)} besides "
            "those for testing; add photographs taken from other places."
        )
    centres = np.array([camera.position for camera in cameras])
    near = ~far_off(cameras)
    if near.mean() >= 1.0 - MAX_SHARE_FAR_OFF and np.ptp(centres[near], axis=0).any():
        cameras = [camera for camera, kept in zip(cameras, near, strict=True) if kept]
        centres = centres[near]
    axes = np.array([camera.forward for camera in cameras])
    middle = centres.mean(axis=0)
    spread = float(np.linalg.norm(centres - middle, axis=1).mean())
    _check_spread(spread, float(np.abs(centres).max()))

    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # removes what lies along an axis
    system = across.mean(axis=0)
    least = float(np.linalg.eigvalsh(system)[0])
    if least < MIN_AXIS_SPREAD:
        reason = "the training cameras look in parallel directions"
    else:
        # Relative to the middle, so that a far origin costs no digits.
        right = np.einsum("nij,nj->i", across, centres - middle) / len(cameras)
        point = middle + np.linalg.solve(system, right)
        depths = np.einsum("ni,ni->n", axes, point - centres)
        if least < NEARLY_PARALLEL and _convergence(centres, axes, point) < MIN_CONVERGENCE:
            reason = "the training cameras look in nearly parallel directions that do not meet"
        elif np.mean(depths > 0.0) >= MIN_SHARE_IN_FRONT:
            how = "median depth of the point that the training cameras look at"
            few = share_aimed_at(cameras, point) < MIN_SHARE_AIMED
            if few:
                how += ", though few of them have it in the middle of their image"
            return Focus(point=point, distance=float(np.median(depths)), how=how, guessed=few)
        else:
            reason = "the training cameras look outward"
    return Focus(
        point=middle + spread * axes.mean(axis=0),
        distance=spread,
        how=f"mean distance of the training cameras from their centre, because {reason}; "
        "set the content distance if you know it",
        guessed=True,
    )


def _convergence(centres: np.ndarray, axes: np.ndarray, point: np.ndarray) -> float:
    """Convergence of nearly parallel axes: which share of their spread is gone at a point.

    1 - sum_i |miss of axis i at the point|^2 / sum_i |centre i across the mean axis|^2, the
    coefficient of determination R^2 of the axes' meeting there.

    Args:
        centres: [n, 3] scene units.
        axes: [n, 3] unit vectors.
        point: [3] nearest to all axes, scene units.

    Returns:
        1 where all meet there, about 0 where they point anywhere.
    """
    mean = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    misses = _reject(point - centres, axes)
    spread = _reject(centres - centres.mean(axis=0), mean[None])
    return 1.0 - float((misses**2).sum() / max((spread**2).sum(), 1e-300))


def _reject(vectors: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Vectors [n, 3] without what lies along unit axes [n or 1, 3]."""
    return vectors - (vectors * axes).sum(axis=1, keepdims=True) * axes


def _check_spread(spread: float, farthest: float) -> None:
    if spread <= 1e-12 * farthest:  # also where both are 0
        raise InputError(
            "all training cameras are at one point, so nothing tells distances; add photographs "
            "taken from other places, or check the translations in the poses."
        )
    if farthest > MAX_OFFSET * spread:
        raise InputError(
            f"the training cameras lie {farthest:.4g} from the origin but only {spread:.4g} apart, "
            "which single precision cannot resolve; subtract their mean from the translations."
        )


def share_aimed_at(cameras: Sequence[Camera], point: np.ndarray) -> float:
    """The share of cameras that have a point in the middle of what they see, [0, 1].

    The middle is half of the image's width and height; distortion is left out of account.

    Args:
        cameras: At least one.
        point: [3] scene units.
    """
    return float(np.mean([_is_aimed_at(camera, point) for camera in cameras]))


def _is_aimed_at(camera: Camera, point: np.ndarray) -> bool:
    x, y, z = camera.c2w[:, :3].T @ (point - camera.position)
    u, v = abs(x) * camera.fx, abs(y) * camera.fy
    return bool(z < 0.0 and u < -0.25 * camera.width * z and v < -0.25 * camera.height * z)


def up_direction(cameras: Sequence[Camera]) -> np.ndarray:
    """Estimate which way is up, a unit vector [3].

    Most photographs are taken upright, and their horizontal axes x_i lie in one plane, the level
    one: up = argmin_u sum_i (u . x_i)^2 over unit u. Where that is not clear, or far from the
    cameras' own up axes, it is the mean of those.

    Args:
        cameras: At least one.
    """
    poses = np.stack([camera.c2w for camera in cameras])
    across, mean = poses[:, :, 0], poses[:, :, 1].mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-6:  # looking straight down, from all sides
        return np.array([0.0, 0.0, 1.0])
    mean /= length
    spread, directions = np.linalg.eigh(across.T @ across / len(cameras))
    normal = directions[:, 0] * np.sign(directions[:, 0] @ mean)
    level = spread[1] > MIN_LEVEL_SPREAD and spread[0] < 0.1 * spread[1]
    return normal if level and normal @ mean > 0.5 else mean


def upside_down(cameras: Sequence[Camera]) -> np.ndarray:
    """Cameras that stand on their heads against the most, [n] bool.

    Where as many stand on their heads as do not, the mean of their own up axes is no direction, and
    these are split along their principal one, but for cameras that all look the same way: a drone
    that flies to and fro looks down however it is turned.

    Args:
        cameras: At least one.
    """
    ups = np.stack([camera.c2w[:, 1] for camera in cameras])
    axes = np.stack([camera.c2w[:, 2] for camera in cameras])
    if np.linalg.norm(ups.mean(axis=0)) < NO_UP and np.linalg.norm(axes.mean(axis=0)) < ONE_WAY:
        along = ups @ np.linalg.eigh(ups.T @ ups)[1][:, -1]
        if np.mean(np.abs(along) > 0.5) >= SPLIT:
            most = 1.0 if np.mean(along > 0.0) >= 0.5 else -1.0
            return np.asarray(most * along < 0.0)
    return np.asarray(ups @ up_direction(cameras) < -0.3)


def horizontal_axes(cameras: Sequence[Camera]) -> tuple[int, int]:
    """Axes of the scene that a plan from above has to the right and ahead.

    These are the two besides the axis nearest to ``up_direction``, in the order that is not
    mirrored from there.
    """
    direction = up_direction(cameras)
    up = int(np.abs(direction).argmax())
    right, ahead = (up + 1) % 3, (up + 2) % 3
    return (right, ahead) if direction[up] >= 0.0 else (ahead, right)


def estimate_extent(cameras: Sequence[Camera], *, unbounded: bool) -> Extent:
    """Estimate content distance and box, a cube around what the cameras look at, and say how.

    half edge = content_distance * tan(half the larger field of view)   for objects,
    half edge = content_distance * UNBOUNDED_BOX_SHARE                  for photographs.

    Args:
        cameras: The training cameras.
        unbounded: Whether content continues outside the box.

    Raises:
        InputError: As ``find_focus``.
    """
    focus = find_focus(cameras)
    if unbounded:
        half = focus.distance * UNBOUNDED_BOX_SHARE
        how = f"{UNBOUNDED_BOX_SHARE:g} of the content distance to each side of that point"
    else:
        half = focus.distance * float(np.median([_half_tangent(camera) for camera in cameras]))
        how = "what the larger field of view spans at the content distance"
    return Extent(
        box_min=focus.point - half,
        box_max=focus.point + half,
        content_distance=focus.distance,
        notes=(
            f"content distance {focus.distance:.3g}: {focus.how}",
            f"box of edge {2.0 * half:.3g}: {how}",
        ),
        guessed=focus.guessed,
    )


def _half_tangent(camera: Camera) -> float:
    """Tangent of half the larger field of view; of at most MAX_HALF_ANGLE through a fisheye."""
    half = max(camera.width / camera.fx, camera.height / camera.fy) / 2
    if camera.fisheye:
        angle = angle_of(camera.radial, np.array(half))
        return math.tan(min(float(angle), MAX_HALF_ANGLE))
    return half
