"""A scene: posed photographs, their split, and its extent."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, overload

import numpy as np

from warpnerf.checked import checked
from warpnerf.checks import MAX_COORDINATE, InputError, require_kind, require_length, said
from warpnerf.optim_config import SceneKind
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.observations import Observations
from warpnerf.scenes.cameras.tracks import Tracks

FirstHit = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From origins [n, 3] and unit directions [n, 3] to the distance of the first surface along each
ray, [n], scene units; as ``warpnerf.scenes.builtin.room.first_hit``."""


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
    """Unique within the scene; the image's path relative to the scene's folder, or generated."""
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
        if not isinstance(self.name, str):
            raise InputError(f"View.name must be text, not {said(self.name)}.")
        require_kind(self.camera, Camera, f"{self.name}: its camera must be a Camera", "make one")
        size = (self.camera.height, self.camera.width)
        image = self.__dict__["image"]
        for part in ("image", "depth", "mask"):
            kept = self.__dict__[part]
            if not (hasattr(kept, "shape") or (kept is None and part != "image")):
                raise InputError(f"{self.name}: {part} must be an array, not {said(kept)}.")
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

    def posed(self, c2w: np.ndarray) -> View:
        """The view with another pose.

        Args:
            c2w: [3, 4] camera to world, OpenGL axes, scene units.

        Returns:
            A view with the same photograph, which is not read.
        """
        return View(**{**self.__dict__, "camera": replace(self.camera, c2w=c2w)})

    def with_image(self, image: np.ndarray | ImageFile) -> View:
        """The view whose pixels are kept elsewhere.

        Args:
            image: The same photograph.

        Returns:
            A view with the same camera, depth and mask.
        """
        return View(**{**self.__dict__, "image": image})

    @property
    def channels(self) -> int:
        """Image channels: 3, or 4 with alpha."""
        return int(self.__dict__["image"].shape[2])


@checked("Scene")
@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """A scene: posed photographs, their train/test split, and the extent estimated from their
    cameras. Lengths are the file's."""

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
    """Whether content continues outside the box (photographs), or not (objects, rooms)."""
    content_distance: float
    """Median distance from a camera to what it sees, or to what all look at, scene units. What is
    found before a training takes its place, see ``TrainConfig.coarse_steps``."""
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
    observations: Observations | None = None
    """Some of these points, as training cameras see them."""
    tracks: Tracks | None = None
    """All of these points, with the photographs that show them; None: not known."""
    bounds: np.ndarray | None = None
    """[n_views, 2] float64, depth of the nearest and of the farthest content that each camera sees,
    scene units, as the file gives them: not checked. None where it gives none."""
    offset: np.ndarray | None = None
    """[3] float64, scene units: what was subtracted from the coordinates of a georeferenced file,
    for single precision to resolve them; exports add it again. None: nothing was."""
    notes: tuple[str, ...] = field(default=())
    """How the scene was understood: its split, what was estimated; a line each."""
    warnings: tuple[str, ...] = field(default=())
    """What may be a mistake: missing files, duplicates, unused keys; a line each."""
    photograph: Callable[[Camera], np.ndarray | None] | None = None
    """What another camera sees, [H, W, 3] uint8 rgb, or None where it cannot stand; for scenes that
    can be photographed again."""
    first_hit: FirstHit | None = None
    """The true distance of the first surface along rays, for scenes that can be traced."""

    def __post_init__(self) -> None:
        """Refuse what nothing can be trained on.

        Raises:
            InputError: An empty box, no distance, points that are none, or a split of views that
                are not there.
        """
        box = np.stack([self.box_min, self.box_max])
        within = box.shape == (2, 3) and (np.abs(box) <= MAX_COORDINATE).all()
        if not within or not (box[0] < box[1]).all():
            raise InputError(
                f"{self.name}: box_min must lie below box_max on every axis, both within "
                f"{MAX_COORDINATE:g} scene units of 0, not {box[0]} and {box[1]}."
            )
        require_length(f"{self.name}: content_distance", self.content_distance)
        distances = self.content_distances
        if distances is not None and (
            distances.shape != (len(self.views),) or not (distances > 0.0).all()
        ):
            raise InputError(
                f"{self.name}: content_distances must be one above 0 for each of "
                f"{len(self.views)} views."
            )
        points = self.points
        if points is not None and (
            points.dtype.kind not in "fiu"
            or points.shape[1:] != (3,)
            or not np.isfinite(points).all()
        ):
            raise InputError(
                f"{self.name}: points must be finite numbers, [n, 3], not {points.dtype} "
                f"{list(points.shape)}; leave out those that are not."
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

    def at_offset(self, offset: np.ndarray | None) -> Scene:
        """The scene in other coordinates.

        Args:
            offset: [3] what is subtracted from those of its file, scene units; None: nothing is.

        Returns:
            The same scene, moved; photographs are not read.
        """
        none = np.zeros(3)
        by = (none if self.offset is None else self.offset) - (none if offset is None else offset)
        if not by.any():
            return self
        seen = self.observations
        return replace(
            self,
            views=[
                view.posed(np.column_stack([view.camera.c2w[:, :3], view.camera.position + by]))
                for view in self.views
            ],
            box_min=self.box_min + by,
            box_max=self.box_max + by,
            points=None if self.points is None else self.points + by,
            observations=None if seen is None else replace(seen, positions=seen.positions + by),
            tracks=None if self.tracks is None else self.tracks.moved(by),
            offset=offset,
        )

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
        """The kind of scene, object or not, which the default training schedule goes by."""
        if self.unbounded:
            return "unbounded"
        return "object" if self.has_alpha else "bounded"

    @property
    def training_cameras(self) -> list[Camera]:
        """The cameras of the training split."""
        return [self.views[index].camera for index in self.splits["train"]]

    @property
    def training_names(self) -> list[str]:
        """The names of the views of the training split."""
        return [self.views[index].name for index in self.splits["train"]]


def require_split(scene: Scene, split: str) -> tuple[int, ...]:
    """Indices of a split's views; "all" is every view.

    Raises:
        InputError: The scene has no such split, or it is empty.
    """
    if split == "all":
        return tuple(range(len(scene.views)))
    if not scene.splits.get(split):
        there = ", ".join(name for name in sorted(scene.splits) if scene.splits[name])
        raise InputError(f"{scene.name} has no {split!r} views; it has {there} or all.")
    return scene.splits[split]
