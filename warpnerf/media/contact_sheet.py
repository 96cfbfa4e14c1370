"""One picture of a whole run: truth, rendering and depth of a few views, with their PSNR."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.media.pictures import (
    FAINT,
    INK,
    depth_legend,
    depth_picture,
    dimmed,
    drawable,
    font,
    to_bytes,
)
from warpnerf.rendering.field import Rendering

N_ROWS = 4
"""Views on a sheet, where there are as many."""

MAX_WIDTH = 1600
"""Of a sheet, pixels."""

_PANEL = (450, 340)
"""Most that a panel of three measures, pixels; of four, a little narrower."""

_LABELS = 190
_GAP, _MARGIN = 8, 12
_TITLE, _TEXT = 22, 16
_MIN_LEGEND = 320


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetRow:
    """A view on a sheet."""

    name: str
    """The view's."""
    psnr: float
    """Of its rendering, dB."""
    target: np.ndarray
    """Its photograph, [H, W, 3] in [0, 1]."""
    rendering: Rendering
    """[H, W]."""
    depth: np.ndarray | None = None
    """True distance along each pixel's ray, [H, W], scene units; not finite where it is unknown.
    None: not known."""
    mask: np.ndarray | None = None
    """[H, W] bool; the photograph is pale where it is false."""


def spread(count: int, most: int = N_ROWS) -> list[int]:
    """Indices of at most so many of some things, spread evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int)).tolist()


def contact_sheet(rows: Sequence[SheetRow], title: str, near: float, far: float) -> np.ndarray:
    """Draw a row of panels for each view: truth, rendering, depth, and true depth where known.

    Photographs of any sizes keep their shape. Each column is as wide as its widest panel; small
    photographs are enlarged by whole pixels.

    Args:
        rows: At least one.
        title: What views they are.
        near: Depth of the first colour, scene units; one range for the whole sheet.
        far: Depth of the last.

    Returns:
        [H, W, 3] uint8, W at most ``MAX_WIDTH``.
    """
    title = drawable(title)
    columns = ["truth", "rendering", "depth"]
    if any(row.depth is not None for row in rows):
        columns.append("true depth")
    room = (MAX_WIDTH - 2 * _MARGIN - _LABELS) // len(columns) - _GAP
    most = (min(_PANEL[0], room), _PANEL[1])
    panels = [[_fitted(panel, most) for panel in _panels(row, near, far)] for row in rows]

    width = max(row[0].width for row in panels)
    heights = [max(row[0].height, 4 * _TEXT) for row in panels]
    lefts = [_MARGIN + _LABELS + number * (width + _GAP) for number in range(len(columns))]
    right = max(lefts[-1] + width, _MARGIN + _LABELS + _MIN_LEGEND)
    legend = depth_legend(right - lefts[0], near, far)
    right = max(right, min(MAX_WIDTH - _MARGIN, _MARGIN + _width(title, _TITLE)))
    top = _MARGIN + 2 * _TITLE + _TEXT
    height = top + sum(heights) + len(rows) * _GAP + legend.shape[0] + _MARGIN

    sheet = Image.new("RGB", (right + _MARGIN, height), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((_MARGIN, _MARGIN), _shortened(title, right - _MARGIN, _TITLE), INK, font(_TITLE))
    for left, column in zip(lefts, columns, strict=True):
        at = (left + width / 2, top - _TEXT)
        draw.text(at, column, INK, font(_TEXT), anchor="mm")
    for row, images, tall in zip(rows, panels, heights, strict=True):
        name = _shortened(drawable(row.name), _LABELS - _GAP, _TEXT)
        draw.text((_MARGIN, top), name, INK, font(_TEXT))
        draw.text((_MARGIN, top + 1.6 * _TEXT), f"PSNR {row.psnr:.2f} dB", FAINT, font(_TEXT))
        for left, image in zip(lefts, images, strict=False):
            sheet.paste(image, (left + (width - image.width) // 2, top))
        top += tall + _GAP
    sheet.paste(Image.fromarray(legend), (lefts[0], top))
    return np.asarray(sheet)


def _panels(row: SheetRow, near: float, far: float) -> list[np.ndarray]:
    """[H, W, 3] in [0, 1], column by column."""
    panels = [
        dimmed(row.target, row.mask),
        row.rendering.rgb,
        depth_picture(row.rendering, near, far),
    ]
    if row.depth is not None:
        known = np.isfinite(row.depth)
        truth = Rendering(
            rgb=row.target, depth=np.where(known, row.depth, 0.0), opacity=known.astype(np.float32)
        )
        panels.append(depth_picture(truth, near, far))
    return panels


def _fitted(panel: np.ndarray, most: tuple[int, int]) -> Image.Image:
    """An image as large as fits, in its own shape; if it is small, in whole multiples."""
    image = Image.fromarray(to_bytes(panel))
    scale = min(most[0] / image.width, most[1] / image.height)
    if scale >= 1.0:
        size = (int(scale) * image.width, int(scale) * image.height)
        return image.resize(size, Image.Resampling.NEAREST)
    size = (max(1, int(scale * image.width)), max(1, int(scale * image.height)))
    return image.resize(size, Image.Resampling.BOX)


def _width(text: str, size: int) -> int:
    """Pixels that a text takes; file names may hold what is no character."""
    return math.ceil(font(size).getbbox(text.encode(errors="replace").decode())[2])


def _shortened(text: str, width: int, size: int) -> str:
    """The end of a text that fits, which is where numbers are."""
    short = text = text.encode(errors="replace").decode()
    while len(text) > 1 and _width(short, size) > width:
        text = text[1:]
        short = f"...{text}"
    return short
