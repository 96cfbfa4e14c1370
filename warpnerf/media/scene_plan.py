"""A plan of a scene: cameras, box and content distance from above and from the side."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.checked import checked_arguments
from warpnerf.evaluation.near_plan import NearPlan
from warpnerf.inspection.inspection import Inspection
from warpnerf.media.pictures import FAINT, INK, drawable, font
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import horizontal_axes
from warpnerf.scenes.cameras.observations import Observations
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.scene import Scene

_FINE = 2  # pixels are drawn twice as large, then averaged
_PANEL = 640 * _FINE
_MARGIN = 64 * _FINE
_HEADER = 114 * _FINE
_TRAIN, _TEST = (38, 96, 168), (214, 96, 30)
_SIGHT, _SIGHT_END = (206, 226, 204), (56, 140, 66)
_GRID, _BOX = (232, 232, 236), (120, 40, 130)
_WIDER = (196, 120, 214)
_POINT = (150, 150, 158)
_EMPTY = (238, 240, 228)
_SHARP, _BLURRED = (70, 150, 190), (214, 40, 40)
"""Places seen at a pixel a voxel or finer, and at ``_RED_AT`` or coarser."""
_RED_AT = 8.0
"""Pixels."""
TWICE = 2.0
"""As wide as in the box are voxels at the outline that is drawn around it."""
_FRUSTUM = 0.035
"""Length of a camera's pyramid, in widths of a panel."""

_PLANS = 3
"""Plans of fields side by side, at most."""

Colour = tuple[int, int, int]


@checked_arguments
def plan_picture(inspection: Inspection) -> np.ndarray:
    """Plot a scene: cameras as pyramids, how far content is, the box, and points if there are any.

    Axes are in the scene's units. Points far outside are left out.

    Up in the view from the side is the axis of the scene nearest to what is up for the cameras.

    Args:
        inspection: Of the scene.

    Returns:
        [H, W, 3] uint8.
    """
    scene = inspection.scene
    up = int(np.abs(inspection.up).argmax())
    standing = inspection.up[up] > 0.0
    right, ahead = (up + 1) % 3, (up + 2) % 3
    if not standing:
        right, ahead = ahead, right
    space = inspection.space
    box = np.stack([scene.box_min, scene.box_max])
    if space.frustum is None:
        box = np.stack([space.box_min, space.box_max])
    outline = space.where_wider(TWICE)
    ends = [c.position + inspection.content_distance * c.forward for c in scene.training_cameras]
    shown = box if outline is None else np.stack(outline)
    points = np.concatenate([shown, [c.position for c in scene.cameras], ends])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    extent = 1.08 * float(np.ptp(points, axis=0).max())

    size = (2 * (_PANEL + _MARGIN) + _MARGIN // 2, _HEADER + _PANEL + _MARGIN // 2)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    _header(draw, inspection)
    for number, (title, axes, signs) in enumerate(
        (
            ("from above", (right, ahead), (1.0, 1.0)),
            ("from the side", (right, up), (1.0, 1.0 if standing else -1.0)),
        )
    ):
        left = _MARGIN + number * (_PANEL + _MARGIN)
        panel = _Panel(draw, (left, _HEADER), axes, signs, middle, extent)
        panel.frame(title)
        if outline is not None:
            panel.box(np.stack(outline), _WIDER)
        for camera, end in zip(scene.training_cameras, ends, strict=True):
            panel.line([camera.position, end], _SIGHT)
        if scene.observations is not None:
            panel.observations(scene.observations, inspection.widths)
        elif scene.points is not None:
            panel.points(scene.points)
        panel.box(box, _BOX)
        for split, colour in (("train", _TRAIN), ("test", _TEST)):
            for index in scene.splits[split]:
                panel.camera(scene.views[index].camera, colour)
        for end in ends:
            panel.dot(end, _SIGHT_END)
        if inspection.focus is not None:
            panel.cross(inspection.focus, INK)
    return np.asarray(sheet.resize((size[0] // _FINE, size[1] // _FINE), Image.Resampling.BOX))


def blocks_picture(scene: Scene, cores: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Plot the blocks of a scene from above: cores with their numbers, margins, cameras.

    Args:
        scene: That was cut.
        cores: [n, 2, 3] corners of the cores, scene units.
        boxes: [n, 2, 3] the same with their margins.

    Returns:
        [H, W, 3] uint8.
    """
    right, ahead = horizontal_axes(scene.training_cameras)
    points = np.concatenate([boxes.reshape(-1, 3), [c.position for c in scene.cameras]])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    extent = 1.08 * float(np.ptp(points, axis=0)[[right, ahead]].max())
    size = (_PANEL + 2 * _MARGIN, _HEADER + _PANEL + _MARGIN // 2)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((_MARGIN, 12 * _FINE), drawable(scene.name), INK, font(24 * _FINE))
    legend: list[tuple[str, Colour]] = [
        ("core", _BOX),
        ("trained for", _WIDER),
        ("training", _TRAIN),
        ("test", _TEST),
    ]
    x = float(_MARGIN)
    for text, colour in legend:
        draw.text((x, 52 * _FINE), text, colour, font(15 * _FINE), anchor="lm")
        x += draw.textlength(text, font(15 * _FINE)) + 26 * _FINE
    panel = _Panel(draw, (_MARGIN, _HEADER), (right, ahead), (1.0, 1.0), middle, extent)
    panel.frame("from above")
    for box in boxes:
        panel.box(box, _WIDER)
    for number, core in enumerate(cores):
        panel.box(core, _BOX)
        panel.label(core.mean(axis=0), str(number))
    for split, colour in (("train", _TRAIN), ("test", _TEST)):
        for index in scene.splits[split]:
            panel.camera(scene.views[index].camera, colour)
    return np.asarray(sheet.resize((size[0] // _FINE, size[1] // _FINE), Image.Resampling.BOX))


def near_picture(scene: Scene, plans: Mapping[str, NearPlan]) -> np.ndarray:
    """Plot the density around the training cameras of a scene from above, fields side by side.

    Args:
        scene: That was trained on.
        plans: Of its fields, by what they are called; at least one. They have the colours of one
            range, from 0 to what nineteen in twenty of all their cells are below.

    Returns:
        [H, W, 3] uint8.
    """
    known = np.concatenate([plan.depths[np.isfinite(plan.depths)] for plan in plans.values()])
    most = max(float(np.quantile(known, 0.95)), 1e-6)
    across, down = min(len(plans), _PLANS), -(-len(plans) // _PLANS)
    size = (across * (_PANEL + _MARGIN) + _MARGIN, _HEADER + down * (_PANEL + _MARGIN))
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    title = f"{drawable(scene.name)}: optical depth around the training cameras"
    draw.text((_MARGIN, 12 * _FINE), title, INK, font(20 * _FINE))
    width, x = 12 * _FINE, float(_MARGIN)
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        colour, text = _density_colour(np.array(share)), f"{share * most:.2g}"
        text = text if share < 1.0 else f"{text} or more"
        draw.rectangle((x, 46 * _FINE, x + width, 46 * _FINE + width), tuple(colour), FAINT)
        draw.text((x + 1.5 * width, 52 * _FINE), text, INK, font(15 * _FINE), anchor="lm")
        x += 1.5 * width + draw.textlength(text, font(15 * _FINE)) + 20 * _FINE
    for number, (name, plan) in enumerate(plans.items()):
        row, column = divmod(number, _PLANS)
        place = _MARGIN + column * (_PANEL + _MARGIN), _HEADER + row * (_PANEL + _MARGIN)
        panel = _Panel(draw, place, plan.axes, (1.0, 1.0), plan.middle, plan.extent)
        colours = _density_colour(plan.depths / most).transpose(1, 0, 2)[::-1]
        picture = Image.fromarray(np.ascontiguousarray(colours))
        sheet.paste(picture.resize((_PANEL, _PANEL), Image.Resampling.NEAREST), place)
        panel.frame(name)
        for camera in scene.training_cameras:
            panel.camera(camera, _TRAIN)
    return np.asarray(sheet.resize((size[0] // _FINE, size[1] // _FINE), Image.Resampling.BOX))


def _density_colour(share: np.ndarray) -> np.ndarray:
    """From pale to red, [..., 3] uint8; white where a share is NaN."""
    part = np.clip(share, 0.0, 1.0)[..., None]
    colours = (1.0 - part) * np.array(_EMPTY) + part * np.array(_BLURRED)
    return np.where(np.isnan(part), 255.0, colours).round().astype(np.uint8)


def _header(draw: ImageDraw.ImageDraw, inspection: Inspection) -> None:
    scene = inspection.scene
    draw.text((_MARGIN, 12 * _FINE), drawable(scene.name), INK, font(24 * _FINE))
    legend: list[tuple[str, Colour]] = [
        (f"{len(scene.splits['train'])} training cameras", _TRAIN),
        (f"{len(scene.splits['test'])} test cameras", _TEST),
        (f"content distance {inspection.content_distance:.4g} in sight", _SIGHT_END),
        (f"box, {inspection.space.kind.words}", _BOX),
    ]
    if inspection.space.where_wider(TWICE) is not None:
        legend.append(("voxels outside twice as wide", _WIDER))
    if scene.observations is not None:
        legend.append(("seen with voxels 1 pixel wide", _SHARP))
        legend.append((f"{_RED_AT:.0f} pixels wide", _BLURRED))
    elif scene.points is not None:
        legend.append(("points", _POINT))
    if inspection.focus is not None:
        legend.append(("+ what the cameras look at", INK))
    x, y = float(_MARGIN), 52.0 * _FINE
    type_face = font(15 * _FINE)
    for text, colour in legend:
        if x + draw.textlength(text, type_face) + 18 * _FINE > 2 * (_PANEL + _MARGIN):
            x, y = float(_MARGIN), y + 22.0 * _FINE
        if not text.startswith("+"):
            draw.rectangle((x, y - 6 * _FINE, x + 12 * _FINE, y + 6 * _FINE), fill=colour)
            x += 18 * _FINE
        draw.text((x, y), text, INK, type_face, anchor="lm")
        x += draw.textlength(text, type_face) + 26 * _FINE


class _Panel:
    """One view: two axes of the scene on paper."""

    def __init__(
        self,
        draw: ImageDraw.ImageDraw,
        corner: tuple[int, int],
        axes: tuple[int, int],
        signs: tuple[float, float],
        middle: np.ndarray,
        extent: float,
    ) -> None:
        """Place it on the sheet.

        Args:
            draw: The sheet.
            corner: Left and top, pixels.
            axes: Of the scene, to the right and up on paper.
            signs: Of these.
            middle: [3] scene units, what is in the middle.
            extent: Of each side, scene units.
        """
        self._draw = draw
        self._left, self._top = corner
        self._axes, self._signs = axes, signs
        self._middle, self._extent = middle, extent
        self._scale = _PANEL / extent

    def frame(self, title: str) -> None:
        """Grid, ticks and labels."""
        small, draw = font(13 * _FINE), self._draw
        step = _nice_step(self._extent / 8.0)
        low = self._middle - 0.5 * self._extent
        bottom = self._top + _PANEL
        for paper, axis in enumerate(self._axes):
            first = math.ceil(low[axis] / step)
            for number in range(first, math.floor((low[axis] + self._extent) / step) + 1):
                point = self._middle.copy()
                point[axis] = number * step
                at = self._at(point)[paper]
                text = f"{number * step:.6g}"
                if paper == 0:
                    draw.line((at, self._top, at, bottom), _GRID, _FINE)
                    draw.text((at, bottom + 6 * _FINE), text, FAINT, small, anchor="mt")
                else:
                    draw.line((self._left, at, self._left + _PANEL, at), _GRID, _FINE)
                    draw.text((self._left - 6 * _FINE, at), text, FAINT, small, anchor="rm")
        draw.rectangle((self._left, self._top, self._left + _PANEL, bottom), None, FAINT, _FINE)
        across, along = ("xyz"[axis] for axis in self._axes)
        draw.text((self._left, self._top - 8 * _FINE), title, INK, font(17 * _FINE), anchor="ls")
        draw.text(
            (self._left + _PANEL, self._top - 8 * _FINE),
            f"{across} to the right, {along} {'up' if self._signs[1] > 0 else 'down'}; scene units",
            FAINT,
            small,
            anchor="rs",
        )

    def line(self, points: Sequence[np.ndarray], colour: Colour, width: int = 1) -> None:
        """A line through points [3]."""
        self._draw.line([self._at(point) for point in points], colour, width * _FINE)

    def points(self, points: np.ndarray) -> None:
        """Small dots at points [n, 3], as far as they lie on the panel."""
        half = 0.5 * self._extent
        near = (np.abs(points - self._middle)[:, list(self._axes)] < half).all(axis=1)
        for point in points[near]:
            x, y = self._at(point)
            self._draw.rectangle((x, y, x + _FINE - 1, y + _FINE - 1), fill=_POINT)

    def observations(self, seen: Observations, widths: np.ndarray) -> None:
        """What cameras see, each as a dot, the wider its voxel is in pixels the redder."""
        half = 0.5 * self._extent
        near = (np.abs(seen.positions - self._middle)[:, list(self._axes)] < half).all(axis=1)
        for place, width in zip(seen.positions[near], widths[near], strict=True):
            x, y = self._at(place)
            share = float(np.clip(np.log2(max(width, 1e-6)) / np.log2(_RED_AT), 0.0, 1.0))
            colour = tuple(
                round((1.0 - share) * a + share * b) for a, b in zip(_SHARP, _BLURRED, strict=True)
            )
            self._draw.rectangle((x - _FINE, y - _FINE, x + _FINE, y + _FINE), fill=colour)

    def box(self, corners: np.ndarray, colour: Colour) -> None:
        """The outline of a box from corners [2, 3]."""
        (x0, y0), (x1, y1) = self._at(corners[0]), self._at(corners[1])
        outline = (min(x0, x1), min(y0, y1), max(x0, x1), max(y0, y1))
        self._draw.rectangle(outline, None, colour, 2 * _FINE)

    def camera(self, camera: Camera, colour: Colour) -> None:
        """A pyramid whose base is the image."""
        length = _FRUSTUM * self._extent
        w, h = float(camera.width), float(camera.height)
        corners = np.array([(0.0, h), (w, h), (w, 0.0), (0.0, 0.0)])
        base = [*(camera.position + length * directions(camera, corners) @ camera.c2w[:, :3].T)]
        self.line([*base, base[0]], colour)
        for corner in base:
            self.line([camera.position, corner], colour)

    def dot(self, point: np.ndarray, colour: Colour) -> None:
        """A small disc."""
        (x, y), r = self._at(point), 2.0 * _FINE
        self._draw.ellipse((x - r, y - r, x + r, y + r), fill=colour)

    def label(self, point: np.ndarray, text: str) -> None:
        """Text around a point [3]."""
        self._draw.text(self._at(point), text, _BOX, font(20 * _FINE), anchor="mm")

    def cross(self, point: np.ndarray, colour: Colour) -> None:
        """A plus sign."""
        (x, y), r = self._at(point), 9 * _FINE
        self._draw.line((x - r, y, x + r, y), colour, 2 * _FINE)
        self._draw.line((x, y - r, x, y + r), colour, 2 * _FINE)

    def _at(self, point: np.ndarray) -> tuple[float, float]:
        """Where a point [3] is on the sheet, pixels."""
        x, y = (
            sign * float(point[axis] - self._middle[axis]) * self._scale
            for axis, sign in zip(self._axes, self._signs, strict=True)
        )
        return self._left + 0.5 * _PANEL + x, self._top + 0.5 * _PANEL - y


def _nice_step(least: float) -> float:
    """The smallest of 1, 2, 5 times a power of ten that is not below ``least``."""
    power = 10.0 ** math.floor(math.log10(least))
    return next(power * factor for factor in (1.0, 2.0, 5.0, 10.0) if power * factor >= least)
