"""From a viewpoint to pixels: what of which field is shown, and in which colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from warpnerf.fields.nodes import cells_within
from warpnerf.fields.occupancy import FreeCells
from warpnerf.media.pictures import depth_colours, depth_picture, to_bytes
from warpnerf.rendering.field import Field
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.viewer.viewpoint import Viewpoint

Kind = Literal["colour", "depth", "opacity", "near field"]
Layout = Literal["side by side", "divided", "first", "second"]

KINDS: tuple[Kind, ...] = get_args(Kind)
LAYOUTS: tuple[Layout, ...] = get_args(Layout)


@dataclass(frozen=True, kw_only=True, eq=False)
class Subject:
    """A field that is looked at."""

    name: str
    """What the page calls it."""
    field: Callable[[], Field]
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
    layout: Layout = "side by side"
    """How two fields share the page."""
    divider: float = 0.5
    """Where the second field begins, if divided: a share of the width."""


class Painter:
    """Paints what one or two fields look like."""

    def __init__(self, subjects: Sequence[Subject]) -> None:
        """Name one or two subjects."""
        self.subjects = subjects
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
        width, height = size
        rows = rows or range(height)
        strips = []
        for index, begin, end in self._shares(settings, width):
            if settings.layout == "side by side" and len(self.subjects) > 1:
                # Each has the middle of the view, so that it does not shrink.
                camera, first = viewpoint.camera(width, height), (width - (end - begin)) // 2
            else:
                camera, first = viewpoint.camera(width, height), begin
            strip = _window(camera, range(first, first + end - begin), rows)
            strips.append(self._look(index, strip, settings))
        picture = np.concatenate(strips, axis=1)
        if len(strips) > 1:
            picture[:, strips[0].shape[1]] = 255  # the line between
        return picture

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

    def _look(self, index: int, camera: Camera, settings: Settings) -> np.ndarray:
        """What a camera sees of a subject, [H, W, 3] uint8."""
        field = self.subjects[index].field()
        if settings.crop is not None:
            field = replace(field, free=self._crop(index, field, settings.crop))
        if settings.kind == "near field":
            steps = replace(field.steps, far=settings.within, transmittance_min=0.0)
            opacity = replace(field, steps=steps, proposal=None).render(camera).opacity
            # The root, so that a thin veil shows: bright is dense.
            return to_bytes(depth_colours(1.0 - np.sqrt(opacity), 0.0, 1.0))
        rendering = field.render(camera)
        if settings.kind == "depth":
            return to_bytes(depth_picture(rendering, settings.near, settings.far))
        if settings.kind == "opacity":
            return to_bytes(np.repeat(rendering.opacity[..., None], 3, axis=-1))
        return to_bytes(rendering.rgb)

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


def _window(camera: Camera, columns: range, rows: range) -> Camera:
    """The camera of a part of another's picture: the same rays through the same pixels."""
    return replace(
        camera,
        width=len(columns),
        height=len(rows),
        cx=camera.cx - columns.start,
        cy=camera.cy - rows.start,
    )
