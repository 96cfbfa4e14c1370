"""A scene: posed photographs, their split, and what their calibration says about its extent."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol, overload

import numpy as np

from warpnerf.checks import InputError, require_positive
from warpnerf.config import SceneKind
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.fisheye import angle_of

UNBOUNDED_BOX_SHARE = 0.75
"""Half edge of the box of photographs, in content distances."""

MIN_AXIS_SPREAD = 1e-4
"""Mean squared sine of the axes to their mean, below which they count as parallel: 0.6 degrees."""

MIN_LEVEL_SPREAD = 0.02
"""Mean squared sine of the horizontal axes to their main direction, for their plane to be known."""

MIN_SHARE_IN_FRONT = 0.75
"""Share of cameras that must have the focus in front of them for it to be what they look at."""

MIN_SHARE_AIMED = 0.75
"""Share of cameras that must have the focus in the middle of their image, for it to be a common
one."""

MAX_HALF_ANGLE = math.radians(60.0)
"""Of a fisheye lens, for the box of what its images show: their rims are mostly background."""

MAX_OFFSET = 1e4
"""Largest distance from the origin, in spreads of the cameras, that single precision resolves."""


class ImageFile(Protocol):
    """A photograph that is not kept in memory."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """H, W, channels."""

    def read(self) -> np.ndarray:
        """Its pixels, [H, W, channels] uint8."""


class _Image:
    """The field ``View.image``. One that is not kept in memory is read whenever it is looked at."""

    @overload
    def __get__(self, view: None, owner: type) -> _Image: ...
    @overload
    def __get__(self, view: View, owner: type) -> np.ndarray: ...
    def __get__(self, view: View | None, owner: type) -> np.ndarray | _Image:
        if view is None:
            raise AttributeError("image")  # so a dataclass knows that there is no default
        image = view.__dict__["image"]
        return image if isinstance(image, np.ndarray) else image.read()

    def __set__(self, view: View, image: np.ndarray | ImageFile) -> None:
        view.__dict__["image"] = image


class PackedArray(Protocol):
    """An array of a view's size in less memory."""

    @property
    def shape(self) -> tuple[int, ...]:
        """H, W."""

    def read(self) -> np.ndarray:
        """The array."""


class _Packed:
    """The fields ``View.depth`` and ``View.mask``. A packed one is unpacked at each look."""

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, view: View | None, owner: type) -> np.ndarray | None:
        if view is None:
            return None  # what a dataclass takes for the default
        kept = view.__dict__[self._name]
        return kept if kept is None or isinstance(kept, np.ndarray) else kept.read()

    def __set__(self, view: View, kept: np.ndarray | PackedArray | None) -> None:
        view.__dict__[self._name] = kept


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """One photograph and the camera that took it."""

    name: str
    """Unique within the scene; the image's path relative to the scene's folder, or made up."""
    camera: Camera
    """Its width and height are those of ``image``."""
    image: _Image = _Image()
    """[H, W, 3] uint8 rgb, or [H, W, 4] uint8 rgb with straight (not premultiplied) alpha. Given as
    an ``ImageFile`` it is read whenever it is looked at."""
    depth: _Packed = _Packed()
    """[H, W] float32, true distance along each pixel's ray in scene units; not finite where it is
    not known. None: not known. It may be given as a ``PackedArray``."""
    mask: _Packed = _Packed()
    """[H, W] bool, true where a pixel counts; where it is false the pixel is neither trained on nor
    measured. None: all count. It may be given as a ``PackedArray``."""

    def __post_init__(self) -> None:
        """Refuse a photograph that is not its camera's.

        Raises:
            InputError: Shapes or types do not fit.
        """
        size = (self.camera.height, self.camera.width)
        image = self.__dict__["image"]
        dtype = image.dtype if isinstance(image, np.ndarray) else np.dtype(np.uint8)
        if dtype != np.uint8 or image.shape[:2] != size or image.shape[2:] not in ((3,), (4,)):
            raise InputError(
                f"{self.name}: image must be uint8 [{size[0]}, {size[1]}, 3 or 4] as its camera "
                f"is, not {dtype} {list(image.shape)}."
            )
        depth = self.__dict__["depth"]
        if depth is not None and depth.shape != size:
            raise InputError(
                f"{self.name}: depth must be {list(size)} as its camera is, not "
                f"{list(depth.shape)}."
            )
        mask = self.mask
        if mask is not None:
            if mask.shape != size or mask.dtype != np.bool_:
                raise InputError(
                    f"{self.name}: mask must be bool {list(size)} as its camera is, not "
                    f"{mask.dtype} {list(mask.shape)}."
                )
            if not mask.any():
                raise InputError(f"{self.name}: its mask leaves no pixel; leave out the view.")

    @property
    def channels(self) -> int:
        """Of its image: 3, or 4 with alpha."""
        return int(self.__dict__["image"].shape[2])


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """Views, their split, and the extent estimated from their cameras. Lengths are the file's."""

    name: str
    """The folder's name, or a built-in scene's."""
    views: Sequence[View]
    """All views, sorted by name."""
    splits: dict[str, tuple[int, ...]]
    """Indices into ``views``: "train" and "test" always, "val" where the file has one."""
    box_min: np.ndarray
    """[3] float64, lower corner of the box that the content fills, scene units."""
    box_max: np.ndarray
    """[3] float64, upper corner."""
    unbounded: bool
    """Whether content goes on outside the box (photographs), or not (objects with alpha, rooms)."""
    content_distance: float
    """Median distance from a camera to what it sees, or to what all look at, scene units. What a
    short training finds takes its place, see ``TrainConfig.coarse_steps``."""
    content_distances: np.ndarray | None = None
    """[n_views] float64, median distance of the points that each camera sees, scene units; None
    where the capture brings no points."""
    guessed: bool = False
    """Whether box and content distance are guesses, because the cameras look at no common point;
    training then looks for a better box first, too, and not only for the content distance."""
    near_content: float | None = None
    """Distance from the cameras within which 1 in 100 of these points lies, scene units."""
    points: np.ndarray | None = None
    """[n, 3] float64, some of these points, scene units."""
    bounds: np.ndarray | None = None
    """[n_views, 2] float64, depth of the nearest and of the farthest content that each camera sees,
    scene units, as the file gives them: not checked. None where it gives none."""
    notes: tuple[str, ...] = field(default=())
    """How the scene was understood: its split, what was estimated; a line each."""
    warnings: tuple[str, ...] = field(default=())
    """What is odd and may be a mistake: missing files, duplicates, unused keys; a line each."""
    photograph: Callable[[Camera], np.ndarray | None] | None = None
    """What another camera sees, [H, W, 3] uint8 rgb, or None where it cannot stand; for scenes that
    can be photographed anew."""

    def __post_init__(self) -> None:
        """Refuse what nothing can be trained on.

        Raises:
            InputError: An empty box, no distance, or a split of views that are not there.
        """
        box = np.stack([self.box_min, self.box_max])
        if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
            raise InputError(
                f"{self.name}: box_min must lie below box_max on every axis, both finite, not "
                f"{self.box_min} and {self.box_max}."
            )
        require_positive(f"{self.name}: content_distance", self.content_distance)
        distances = self.content_distances
        if distances is not None and (
            distances.shape != (len(self.views),) or not (distances > 0.0).all()
        ):
            raise InputError(
                f"{self.name}: content_distances must be one above 0 for each of "
                f"{len(self.views)} views."
            )
        if self.bounds is not None and self.bounds.shape != (len(self.views), 2):
            raise InputError(
                f"{self.name}: bounds must be two for each of {len(self.views)} views."
            )
        if len({view.name for view in self.views}) < len(self.views):
            raise InputError(f"{self.name}: two views have one name; give each its own.")
        for split, indices in self.splits.items():
            if not all(0 <= index < len(self.views) for index in indices):
                raise InputError(
                    f"{self.name}: splits[{split!r}] must be indices of {len(self.views)} views."
                )
        if not self.splits.get("train"):
            raise InputError(f"{self.name}: splits['train'] must name at least one view.")

    @property
    def cameras(self) -> list[Camera]:
        """The camera of every view, in the order of ``views``."""
        return [view.camera for view in self.views]

    @property
    def has_alpha(self) -> bool:
        """Whether any training photograph has an alpha channel, opaque or not."""
        return any(self.views[index].channels == 4 for index in self.splits["train"])

    @property
    def kind(self) -> SceneKind:
        """What the default schedule of updates goes by."""
        if self.unbounded:
            return "unbounded"
        return "object" if self.has_alpha else "bounded"

    @property
    def training_cameras(self) -> list[Camera]:
        """The cameras of the training split."""
        return [self.views[index].camera for index in self.splits["train"]]


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


def focus_point(cameras: Sequence[Camera]) -> np.ndarray:
    """Return the point that the cameras look at, [3] scene units; see ``find_focus``."""
    return find_focus(cameras).point


def estimate_content_distance(cameras: Sequence[Camera]) -> float:
    """Return the median distance from a camera to what all look at; see ``find_focus``."""
    return find_focus(cameras).distance


def find_focus(cameras: Sequence[Camera]) -> Focus:
    """Find the point closest to all optical axes, and its median depth.

    point = argmin_p sum_i |(I - d_i d_i^T)(p - o_i)|^2, with centres o_i and unit axes d_i, so
    sum_i (I - d_i d_i^T) p = sum_i (I - d_i d_i^T) o_i;  distance = median_i d_i . (point - o_i)

    Where the axes are parallel, or the point lies behind many cameras because they look outward,
    distance = mean_i |o_i - mean o| and point = mean o + distance * mean d, and ``how`` says so.
    Where they look in and out, few have the point in the middle of their image: see ``guessed``.

    Args:
        cameras: The training cameras, at least two, not all in one place.

    Raises:
        InputError: Fewer cameras, all in one place, or too far from the origin for their spread.
    """
    if len(cameras) < 2:
        raise InputError(
            f"the content distance needs at least 2 training cameras, not {len(cameras)}; add "
            "photographs taken from other places."
        )
    centres = np.array([camera.position for camera in cameras])
    axes = np.array([camera.forward for camera in cameras])
    middle = centres.mean(axis=0)
    spread = float(np.linalg.norm(centres - middle, axis=1).mean())
    _check_spread(spread, float(np.abs(centres).max()))

    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # removes what lies along an axis
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] < MIN_AXIS_SPREAD:
        reason = "the training cameras look in parallel directions"
    else:
        # Relative to the middle, so that a far origin costs no digits.
        right = np.einsum("nij,nj->i", across, centres - middle) / len(cameras)
        point = middle + np.linalg.solve(system, right)
        depths = np.einsum("ni,ni->n", axes, point - centres)
        if np.mean(depths > 0.0) >= MIN_SHARE_IN_FRONT:
            how = "median depth of the point that the training cameras look at"
            few = share_aimed_at(cameras, point) < MIN_SHARE_AIMED
            if few:
                how += ", though few of them have it in the middle of their image"
            return Focus(point=point, distance=float(np.median(depths)), how=how, guessed=few)
        reason = "the training cameras look outward"
    return Focus(
        point=middle + spread * axes.mean(axis=0),
        distance=spread,
        how=f"mean distance of the training cameras from their centre, because {reason}; "
        "set the content distance if you know it",
        guessed=True,
    )


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


def estimate_box(cameras: Sequence[Camera], unbounded: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners (min, max), [3] each, of the cube around what the cameras look at.

    half edge = content_distance * tan(half the larger field of view)   for objects,
    half edge = content_distance * UNBOUNDED_BOX_SHARE                  for photographs.

    Args:
        cameras: The training cameras.
        unbounded: Whether content goes on outside the box.

    Raises:
        InputError: As ``find_focus``.
    """
    extent = estimate_extent(cameras, unbounded=unbounded)
    return extent.box_min, extent.box_max


def estimate_extent(cameras: Sequence[Camera], *, unbounded: bool) -> Extent:
    """Estimate box and content distance, and say how; see ``estimate_box`` and ``find_focus``."""
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


def require_split(scene: Scene, split: str) -> tuple[int, ...]:
    """Indices of a split's views; "all" is every view.

    Raises:
        InputError: The scene has no such split, or it is empty.
    """
    if split == "all":
        return tuple(range(len(scene.views)))
    if not scene.splits.get(split):
        raise InputError(
            f"{scene.name} has no {split!r} views; it has {', '.join(sorted(scene.splits))} or all."
        )
    return scene.splits[split]
