"""From a viewpoint to pixels: what of which field is shown, and in which colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from warpnerf.fields.nodes import cells_within
from warpnerf.fields.occupancy import FreeCells
from warpnerf.media.pictures import depth_colours, depth_picture, to_bytes
from warpnerf.rendering.composite import AnyField
from warpnerf.rendering.field import Field, Rendering
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.viewer.reprojection import Reprojector
from warpnerf.viewer.viewpoint import Viewpoint

Kind = Literal["colour", "depth", "opacity", "near field"]
Layout = Literal["side by side", "divided", "first", "second"]

KINDS: tuple[Kind, ...] = get_args(Kind)
LAYOUTS: tuple[Layout, ...] = get_args(Layout)

SOLID = 0.5
"""Opacity from which a pixel has a distance."""

SMALLEST_BLOCK = 2
"""Pixels along the edge of a block that one ray fills where a picture has holes."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A field that is looked at."""

    name: str
    """What the page calls it."""
    field: Callable[[], AnyField]
    """The field as it stands."""
    stamp: Callable[[], int] = lambda: 0
    """A number that changes when the field does."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the panel says about pictures."""

    kind: Kind = "colour"
    """What is shown of a field."""
    near: float
    """Depth of the first colour, scene units."""
    far: float
    """Depth of the last."""
    within: float
    """How far the near field reaches from the camera, scene units."""
    crop: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    """Corners of the box outside of which nothing is shown, scene units."""
    clip: float = 0.0
    """Nothing is shown that is closer to the camera, scene units."""
    layout: Layout = "side by side"
    """How two fields share the page."""
    divider: float = 0.5
    """Where the second field begins, if divided: a share of the width."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Look:
    """A picture with depth, and where it was seen from."""

    viewpoint: Viewpoint
    """Where from."""
    settings: Settings
    """What is shown."""
    picture: np.ndarray
    """[H, W, 3] uint8, without the line between two fields."""
    distance: np.ndarray
    """[H, W] float32 along the rays, scene units; infinite where nothing is."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.picture.shape[1], self.picture.shape[0]

    def copied(self, viewpoint: Viewpoint, settings: Settings) -> Look:
        """The same pixels in arrays of their own, to be replaced by those of another viewpoint."""
        return Look(
            viewpoint=viewpoint,
            settings=settings,
            picture=self.picture.copy(),
            distance=self.distance.copy(),
        )

    def resized(self, size: tuple[int, int]) -> Look:
        """The nearest pixels of a picture of another size: width and height."""
        if size == self.size:
            return self
        (high, wide), (width, height) = self.distance.shape, size
        rows = np.minimum((np.arange(height) + 0.5) * high / height, high - 1).astype(int)
        columns = np.minimum((np.arange(width) + 0.5) * wide / width, wide - 1).astype(int)
        at = np.ix_(rows, columns)
        return replace(self, picture=self.picture[at], distance=self.distance[at])


class Painter:
    """Paints what one or two fields look like."""

    def __init__(self, subjects: Sequence[Subject]) -> None:
        """Name one or two subjects."""
        self.subjects = subjects
        self._reprojector: Reprojector | None = None
        self._cropped: dict[int, tuple[object, object, FreeCells]] = {}

    @property
    def stamp(self) -> tuple[int, ...]:
        """Changes when one of the fields does."""
        return tuple(subject.stamp() for subject in self.subjects)

    def paint(
        self,
        viewpoint: Viewpoint,
        settings: Settings,
        size: tuple[int, int],
        rows: range | None = None,
    ) -> np.ndarray:
        """A picture, or some rows of it.

        Args:
            viewpoint: Where from.
            settings: What is shown.
            size: Width and height of the whole picture, pixels.
            rows: Which of them; None: all.

        Returns:
            [rows, width, 3] uint8.
        """
        return self.divided(self.look(viewpoint, settings, size, rows).picture, settings)

    def look(
        self,
        viewpoint: Viewpoint,
        settings: Settings,
        size: tuple[int, int],
        rows: range | None = None,
    ) -> Look:
        """A picture, or some rows of it, with depth; arguments are those of ``paint``."""
        rows = rows or range(size[1])
        pictures, distances = [], []
        for index, camera, _ in self._strips(viewpoint, settings, size, rows):
            picture, distance = self._look(index, camera, settings)
            pictures.append(picture)
            distances.append(distance)
        return Look(
            viewpoint=viewpoint,
            settings=settings,
            picture=np.concatenate(pictures, axis=1),
            distance=np.concatenate(distances, axis=1),
        )

    def divided(self, picture: np.ndarray, settings: Settings) -> np.ndarray:
        """A picture [H, W, 3] with the line between two fields, if there are two in it."""
        shares = self._shares(settings, picture.shape[1])
        if len(shares) > 1:
            picture = picture.copy()
            picture[:, shares[1][1]] = 255
        return picture

    def reproject(self, look: Look, viewpoint: Viewpoint, n_rays: int) -> Look:
        """What a picture with depth shows from elsewhere; what it does not show is rendered.

        Args:
            look: Seen before.
            viewpoint: Where from now.
            n_rays: To be rendered at most: holes are filled in square blocks of one ray each, as
                large as that takes.

        Returns:
            A picture of the same size. Its distances are those of ``look``, and of no use.
        """
        if self._reprojector is None:
            self._reprojector = Reprojector()
        size, settings = look.size, look.settings
        rows = range(size[1])
        before = self._strips(look.viewpoint, settings, size, rows)
        strips = []
        for (index, source, columns), (_, target, _) in zip(
            before, self._strips(viewpoint, settings, size, rows), strict=True
        ):
            picture, seen = self._reprojector.warp(
                look.picture[:, columns], look.distance[:, columns], source, target
            )
            share = n_rays * target.width // size[0]
            self._fill(index, picture, seen, target, settings, share)
            strips.append(picture)
        picture = np.concatenate(strips, axis=1)
        return replace(look, viewpoint=viewpoint, picture=picture)

    def _fill(
        self,
        index: int,
        picture: np.ndarray,
        seen: np.ndarray,
        camera: Camera,
        settings: Settings,
        n_rays: int,
    ) -> None:
        """Render where a picture [H, W, 3] is not seen [H, W]."""
        blocks, edge = _blocks_with_holes(seen, n_rays)
        if not len(blocks):
            return
        rows = np.minimum(edge * blocks[:, 0] + edge // 2, camera.height - 1)
        columns = np.minimum(edge * blocks[:, 1] + edge // 2, camera.width - 1)
        colours, _ = self._look(index, (camera, rows, columns), settings)
        filled = np.zeros((-(-camera.height // edge), -(-camera.width // edge), 3), np.uint8)
        filled[blocks[:, 0], blocks[:, 1]] = colours
        holes = np.flatnonzero(~seen)
        row, column = np.divmod(holes, camera.width)
        picture.reshape(-1, 3)[holes] = filled[row // edge, column // edge]

    def _strips(
        self, viewpoint: Viewpoint, settings: Settings, size: tuple[int, int], rows: range
    ) -> list[tuple[int, Camera, slice]]:
        """Which subject is seen by which camera, in which columns of a picture."""
        width, height = size
        camera = viewpoint.camera(width, height)
        strips = []
        for index, begin, end in self._shares(settings, width):
            first = begin
            if settings.layout == "side by side" and len(self.subjects) > 1:
                # Each has the middle of the view, so that it does not shrink.
                first = (width - (end - begin)) // 2
            window = _window(camera, range(first, first + end - begin), rows)
            strips.append((index, window, slice(begin, end)))
        return strips

    def _shares(self, settings: Settings, width: int) -> list[tuple[int, int, int]]:
        """Which subject has which columns: its index, the first, and the one after its last."""
        if len(self.subjects) == 1 or settings.layout == "first":
            return [(0, 0, width)]
        if settings.layout == "second":
            return [(1, 0, width)]
        share = settings.divider if settings.layout == "divided" else 0.5
        middle = round(share * width)
        parts = [(0, 0, middle), (1, middle, width)]
        return [part for part in parts if part[1] < part[2]]

    def _look(
        self,
        index: int,
        seen_by: Camera | tuple[Camera, np.ndarray, np.ndarray],
        settings: Settings,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What a camera sees of a subject, in all its pixels or in those of some rows and columns.

        Returns:
            Colours [..., 3] uint8 and distances [...] float32.
        """
        field = self._shown(index, settings)
        if isinstance(seen_by, Camera):
            seen = field.render(seen_by)
        else:
            seen = field.render_rays(*pixel_rays(*seen_by))
        some = np.maximum(seen.opacity, 1e-6)
        distance = np.where(seen.opacity > SOLID, seen.depth / some, np.inf).astype(np.float32)
        return to_bytes(_colours(seen, settings)), distance

    def surface(
        self, origin: np.ndarray, direction: np.ndarray, settings: Settings
    ) -> np.ndarray | None:
        """Ray casting: the surface point that a ray meets, at its expected depth.

        Args:
            origin: [3], scene units.
            direction: [3] of unit length.
            settings: What is shown: nothing is met that is cropped.

        Returns:
            [3] scene units; None: the field is not opaque along the ray.
        """
        field = self._shown(1 if settings.layout == "second" else 0, settings)
        seen = field.render_rays(origin[None], direction[None])
        if seen.opacity[0] <= SOLID:
            return None
        return origin + float(seen.depth[0] / seen.opacity[0]) * direction

    def _shown(self, index: int, settings: Settings) -> AnyField:
        """What is left of a subject to be shown."""
        field = self.subjects[index].field()
        if settings.crop is not None and isinstance(field, Field):
            field = replace(field, free=self._crop(index, field, settings.crop))
        elif settings.crop is not None:
            field = field.cropped(*settings.crop)
        field = field.beyond(settings.clip)
        return field.up_to(settings.within) if settings.kind == "near field" else field

    def _crop(self, index: int, field: Field, crop: object) -> FreeCells:
        """Free cells with all outside of the box among them, kept as long as neither changes."""
        free, box, cropped = self._cropped.get(index, (None, None, None))
        if cropped is None or free is not field.free or box != crop:
            low, high = np.array(crop)
            cropped = field.free.cropped(
                field.lattice, cells_within(field.lattice, low, high), field.workers
            )
            self._cropped[index] = field.free, crop, cropped
        return cropped


def pixel_rays(
    camera: Camera, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Camera rays through the centres of some pixels.

    Args:
        camera: Without distortion.
        rows: [n] of the pixels.
        columns: [n] of the pixels.

    Returns:
        origins [n, 3], scene units, and directions [n, 3] of unit length.
    """
    x = (columns + 0.5 - camera.cx) / camera.fx
    y = (rows + 0.5 - camera.cy) / camera.fy
    directions = np.stack([x, -y, -np.ones(len(rows))], axis=-1) @ camera.c2w[:, :3].T
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.broadcast_to(camera.position, directions.shape), directions


def _colours(seen: Rendering, settings: Settings) -> np.ndarray:
    """What is shown of a rendering, [..., 3]."""
    if settings.kind == "near field":
        # The root, so that a thin veil shows: bright is dense.
        return depth_colours(1.0 - np.sqrt(seen.opacity), 0.0, 1.0)
    if settings.kind == "depth":
        return depth_picture(seen, settings.near, settings.far)
    if settings.kind == "opacity":
        return np.repeat(seen.opacity[..., None], 3, axis=-1)
    return seen.rgb


def _blocks_with_holes(seen: np.ndarray, most: int) -> tuple[np.ndarray, int]:
    """Square blocks of a picture in which some pixel [H, W] is not seen.

    Returns:
        Their rows and columns, [n, 2] with n <= max(most, 1), and their edge in pixels: the
        smallest power of two from SMALLEST_BLOCK that needs no more blocks.
    """
    holes, edge = ~seen, 1
    while edge < SMALLEST_BLOCK or np.count_nonzero(holes) > max(most, 1):
        holes = np.pad(holes, [(0, size % 2) for size in holes.shape])
        holes = holes[::2] | holes[1::2]
        holes = holes[:, ::2] | holes[:, 1::2]
        edge *= 2
    return np.argwhere(holes), edge


def _window(camera: Camera, columns: range, rows: range) -> Camera:
    """The camera of a part of another's picture: the same rays through the same pixels."""
    return replace(
        camera,
        width=len(columns),
        height=len(rows),
        cx=camera.cx - columns.start,
        cy=camera.cy - rows.start,
    )
