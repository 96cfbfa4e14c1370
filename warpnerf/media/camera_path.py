"""Paths for a camera to fly: around a scene, through its cameras, or backing away from them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_one_of, require_positive, require_whole, said
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.fisheye import angle_of
from warpnerf.scenes.cameras.focus import MIN_SHARE_AIMED, find_focus, share_aimed_at, up_direction
from warpnerf.scenes.files import by_number
from warpnerf.scenes.scene import Scene

PathKind = Literal["orbit", "through", "back"]

FULL_CIRCLE_GAP = np.radians(100.0)
"""Largest angle without a camera around an object that an orbit still crosses."""

FRAMES_PER_CAMERA = 15
"""At least so many frames from one camera of a path to the next: the rest is left out."""

LEAPS = 0.7
"""Cameras whose neighbours are further apart than this share of any two are in no order."""

MAX_SIDE = 8000
"""Pixels of a picture's side: two of them side by side are what H.264 can hold."""

BACK_SHARE = 0.5
"""How far a path backs away, in content distances, unless told otherwise."""


def natural_path(scene: Scene) -> PathKind:
    """The path that suits a scene: an orbit where the training cameras look at one thing."""
    cameras = scene.training_cameras
    aimed = share_aimed_at(cameras, find_focus(cameras).point)
    return "orbit" if aimed >= MIN_SHARE_AIMED else "through"


MAX_FRAMES = 1_000_000
"""Of a path: nine hours of film."""


def require_frames(n: int) -> None:
    """Raise InputError unless a film can have so many frames."""
    require_whole("the number of frames", n, 1)
    if n > MAX_FRAMES:
        raise InputError(f"the number of frames must be at most {MAX_FRAMES}, not {said(n)}.")


@checked_arguments
def camera_path(
    scene: Scene,
    kind: PathKind | None = None,
    n_frames: int = 240,
    *,
    size: tuple[int, int] | None = None,
    distance: float | None = None,
) -> list[Camera]:
    """A camera path: a smooth trajectory without distortion, as wide as the photographs see.

    orbit    around what the training cameras look at, as far away and as high as they are; all the
             way round, or to and fro where they leave a side out
    through  through the training cameras in their order, or from neighbour to neighbour where
             that leaps about; in a short film through every n-th
    back     the same, but backing away from them, up to ``distance``: where floaters show

    Args:
        scene: Its training cameras lead the way.
        kind: None: what ``natural_path`` says.
        n_frames: How many cameras.
        size: Width and height, pixels; None: those of the first training camera.
        distance: How far "back" backs away, scene units; None: ``BACK_SHARE`` content distances.

    Returns:
        n_frames cameras, in the order of the film.

    Raises:
        InputError: An unknown path, a size or distance that is not above zero, or too few cameras.
    """
    kind = natural_path(scene) if kind is None else kind
    require_one_of("the path", kind, get_args(PathKind))
    require_frames(n_frames)
    if distance is not None:
        require_positive("the distance of the path", distance)
    cameras = scene.training_cameras
    lens = path_lens(cameras, size)
    if kind == "orbit":
        poses = _orbit(cameras, n_frames)
    else:
        training = (scene.views[index] for index in scene.splits["train"])
        in_order = sorted(training, key=lambda view: by_number(view.name))
        poses = _through([v.camera for v in in_order], n_frames, scene.content_distance)
    path = [replace(lens, c2w=pose) for pose in poses]
    if kind == "back":
        end = BACK_SHARE * scene.content_distance if distance is None else distance
        shares = _eased(n_frames)
        path = [camera.moved_back(end * s) for camera, s in zip(path, shares, strict=True)]
    return path


def backing_away(camera: Camera, distance: float, n_frames: int) -> list[Camera]:
    """A camera that backs away from where it stands, slowly at both ends.

    Args:
        camera: Where it begins.
        distance: How far it gets, scene units.
        n_frames: How many cameras.
    """
    return [camera.moved_back(distance * share) for share in _eased(n_frames)]


def path_lens(cameras: Sequence[Camera], size: tuple[int, int] | None) -> Camera:
    """A lens without distortion, whose shorter side sees what that of the photographs sees.

    Through fisheye lenses that may be more than fits a plane: then it sees 90 degrees.

    Args:
        cameras: Of the photographs; the result stands where the first does.
        size: Width and height, pixels; None: those of the first camera.

    Raises:
        InputError: The size is not above zero, or too large.
    """
    width, height = size or (cameras[0].width, cameras[0].height)
    for name, side in (("width", width), ("height", height)):
        require_whole(f"the {name}", side, 1)
        if side > MAX_SIDE:
            raise InputError(f"the {name} is {side} pixels; choose one of at most {MAX_SIDE}.")
    focal = float(np.median([_focal_share(camera) for camera in cameras])) * min(width, height)
    return Camera(
        width=width,
        height=height,
        fx=focal,
        fy=focal,
        cx=0.5 * width,
        cy=0.5 * height,
        c2w=cameras[0].c2w,
    )


def _focal_share(camera: Camera) -> float:
    """Focal length of ``path_lens`` for one camera, in shorter sides of its image."""
    shorter = min(camera.width, camera.height)
    if camera.fisheye:
        angle = angle_of(camera.radial, np.array(0.5 * shorter / camera.fx))
        return 0.5 / math.tan(min(float(angle), 0.25 * math.pi))
    return camera.fx / shorter


def look_at(position: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The pose c2w [3, 4] of a camera that looks at a target.

    Args:
        position: [3] scene units.
        target: [3] scene units, elsewhere.
        up: [3] what is upright in the picture; not the direction of view.
    """
    back = position - target
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, position], axis=1)


def _eased(n: int) -> np.ndarray:
    """From 0 to 1, [n], at rest at both ends."""
    x = np.linspace(0.0, 1.0, n)
    return x * x * (3.0 - 2.0 * x)


def _orbit(cameras: Sequence[Camera], n_frames: int) -> list[np.ndarray]:
    """Around the focus; radius and height are those of the cameras nearest by angle."""
    focus, up = find_focus(cameras).point, up_direction(cameras)
    aside = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    aside /= np.linalg.norm(aside)
    ahead = np.cross(up, aside)
    offsets = np.array([camera.position for camera in cameras]) - focus
    heights = offsets @ up
    radii = np.hypot(offsets @ aside, offsets @ ahead)
    angles = np.arctan2(offsets @ ahead, offsets @ aside)
    least = 1e-3 * float(np.linalg.norm(offsets, axis=1).max())  # never straight above

    poses = []
    for angle in _orbit_angles(angles, n_frames):
        weights = np.exp(4.0 * (np.cos(angles - angle) - 1.0))  # some 30 degrees to each side
        weights /= weights.sum()
        radius, height = max(float(weights @ radii), least), weights @ heights
        outward = np.cos(angle) * aside + np.sin(angle) * ahead
        poses.append(look_at(focus + radius * outward + height * up, focus, up))
    return poses


def _orbit_angles(angles: np.ndarray, n_frames: int) -> np.ndarray:
    """A circle, or an arc to and fro that stays where cameras were; [n_frames] radians."""
    turn = 2.0 * np.pi * np.arange(n_frames) / n_frames
    ordered = np.sort(angles)
    gaps = np.diff(ordered, append=ordered[0] + 2.0 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] < FULL_CIRCLE_GAP:
        return ordered[0] + turn
    begin, half = ordered[widest] + gaps[widest], np.pi - 0.5 * gaps[widest]
    return begin + half + half * np.sin(turn)


def _through(cameras: Sequence[Camera], n_frames: int, content_distance: float) -> list[np.ndarray]:
    """A Catmull-Rom spline through poses, at even speed; rotations are the nearest to its own."""
    poses = _in_order(np.stack([camera.c2w for camera in cameras]), content_distance)
    n_keys = min(len(poses), max(2, n_frames // FRAMES_PER_CAMERA + 1))
    keys = poses[np.round(np.linspace(0, len(poses) - 1, n_keys)).astype(int)]
    if len(keys) < 2:
        raise InputError("a path through the cameras needs 2 of them; use --path orbit.")
    fine = np.linspace(0.0, len(keys) - 1.0, 64 * len(keys))
    poses = spline(keys, fine)
    travelled = np.cumsum(_between(poses[:-1], poses[1:], content_distance))
    even = np.linspace(0.0, travelled[-1], n_frames)
    return list(spline(keys, np.interp(even, [0.0, *travelled], fine)))


def _in_order(poses: np.ndarray, content_distance: float) -> np.ndarray:
    """Poses [n, 3, 4] in an order that does not leap: theirs, or each followed by its nearest."""
    distances = _between(poses[:, None], poses[None], content_distance)
    n = len(poses)
    one_by_one = np.mean(distances[np.arange(n - 1), np.arange(1, n)]) if n > 1 else 0.0
    if n < 3 or one_by_one < LEAPS * distances.sum() / (n * (n - 1)):
        return poses
    order, left = [0], set(range(1, n))
    while left:
        order.append(min(left, key=lambda other: distances[order[-1], other]))
        left.remove(order[-1])
    return poses[order]


def _between(a: np.ndarray, b: np.ndarray, content_distance: float) -> np.ndarray:
    """How far poses [..., 3, 4] are apart, [...]: moved, and turned times the content distance."""
    moved, turned = b[..., 3] - a[..., 3], b[..., :3] - a[..., :3]
    return np.hypot(
        np.linalg.norm(moved, axis=-1),
        content_distance * np.linalg.norm(turned, axis=(-2, -1)) / np.sqrt(2.0),
    )


def spline(keys: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The Catmull-Rom spline through poses [k, 3, 4], at places [n] from 0 to k - 1; [n, 3, 4].

    Rotations are those nearest to its own, which are none: U V^T of the singular values.
    """
    first = np.clip(at.astype(int), 0, len(keys) - 2)
    x = (at - first)[:, None, None]
    before, a, b, after = (
        keys[np.clip(first + offset, 0, len(keys) - 1)] for offset in (-1, 0, 1, 2)
    )
    slope_a, slope_b = 0.5 * (b - before), 0.5 * (after - a)
    poses = (
        (2 * x**3 - 3 * x**2 + 1) * a
        + (x**3 - 2 * x**2 + x) * slope_a
        + (3 * x**2 - 2 * x**3) * b
        + (x**3 - x**2) * slope_b
    )
    u, _, vt = np.linalg.svd(poses[:, :, :3])
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    poses[:, :, :3] = u @ vt
    return poses
