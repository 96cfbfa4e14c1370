"""Plots: lines over round numbers, on plain or logarithmic axes."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.media.pictures import FAINT, INK, drawable, font

COLOURS = (
    (31, 119, 180),
    (214, 39, 40),
    (44, 140, 60),
    (148, 103, 189),
    (200, 120, 20),
    (23, 160, 170),
    (120, 80, 60),
    (90, 90, 100),
)
"""Of lines, in their order; more begin again."""

SIZE = (760, 460)
"""Of a plot, pixels."""

MAX_TICKS = 8
"""Along a logarithmic axis."""

_GRID = (225, 225, 225)
_TEXT, _TITLE = 15, 20
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 20, 34, 46


def line_plot(
    lines: Mapping[str, tuple[np.ndarray, np.ndarray]],
    title: str,
    axes: tuple[str, str],
    logarithmic: tuple[bool, bool] = (False, False),
) -> np.ndarray:
    """Plot lines.

    Args:
        lines: By name, x and y, [n] each. Where an axis is logarithmic, points at 0 are left out.
        title: Above them.
        axes: What is along, and what is upwards, with units.
        logarithmic: Whether each axis is.

    Returns:
        [H, W, 3] uint8 of ``SIZE``.
    """
    places = {}
    for name, (x, y) in lines.items():
        shown = np.isfinite(x) & np.isfinite(y)
        for values, is_log in zip((x, y), logarithmic, strict=True):
            shown &= (values > 0.0) | (not is_log)
        if shown.any():
            both = zip((x[shown], y[shown]), logarithmic, strict=True)
            places[name] = [np.log10(v) if is_log else np.asarray(v, float) for v, is_log in both]
    sheet = Image.new("RGB", SIZE, "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((12, 8), drawable(title), INK, font(_TITLE))
    if not places:
        return np.asarray(sheet)
    along, up = (np.concatenate([place[k] for place in places.values()]) for k in range(2))
    corner, size = (0, 2 * _TITLE), (SIZE[0], SIZE[1] - 2 * _TITLE)
    frame = Frame(draw, corner, size, along, up)
    frame.axes(*axes, logarithmic=logarithmic)
    colours = {name: COLOURS[k % len(COLOURS)] for k, name in enumerate(lines)}
    for name, (x, y) in places.items():
        frame.line(x, y, colours[name], width=2)
    if len(lines) > 1:
        frame.key(*colours.items())
    return np.asarray(sheet)


class Frame:
    """A plot: from numbers, or their logarithms, to pixels."""

    def __init__(
        self,
        draw: ImageDraw.ImageDraw,
        corner: tuple[int, int],
        size: tuple[int, int],
        x: np.ndarray,
        y: np.ndarray,
    ) -> None:
        """Set up.

        Args:
            draw: Of the picture.
            corner: Upper left, pixels.
            size: Width and height with what stands around the plot, pixels.
            x: What is to be seen along, from the least to the greatest.
            y: What is to be seen upwards, with a little slack.
        """
        self._draw = draw
        self._left, self._right = corner[0] + _LEFT, corner[0] + size[0] - _RIGHT
        self._top, self._bottom = corner[1] + _TOP, corner[1] + size[1] - _BOTTOM
        first, last = float(x.min()), float(x.max())
        self._x = (first, max(last, first + 1e-9))
        low, high = float(y.min()), float(y.max())
        slack = 0.05 * (high - low) or 0.5
        self._y = (low - slack, high + slack)

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Where a point lies, pixels."""
        across = (x - self._x[0]) / (self._x[1] - self._x[0])
        up = (y - self._y[0]) / (self._y[1] - self._y[0])
        return (
            self._left + across * (self._right - self._left),
            self._bottom - up * (self._bottom - self._top),
        )

    def axes(self, below: str, beside: str, *, logarithmic: tuple[bool, bool]) -> None:
        """Frame, round numbers and what they are.

        Args:
            below: What is along.
            beside: What is upwards.
            logarithmic: Whether places along, and upwards, are decimal logarithms.
        """
        draw, small = self._draw, font(_TEXT)
        draw.text((self._left, self._top - 6), beside, INK, small, anchor="lb")
        for value in _ticks(*self._x, logarithmic[0]):
            x, _ = self.place(value, self._y[0])
            draw.line([(x, self._top), (x, self._bottom)], _GRID)
            text = _number(value, logarithmic[0])
            draw.text((x, self._bottom + 6), text, FAINT, small, anchor="mt")
        for value in _ticks(*self._y, logarithmic[1]):
            _, y = self.place(self._x[0], value)
            draw.line([(self._left, y), (self._right, y)], _GRID)
            text = _number(value, logarithmic[1])
            draw.text((self._left - 6, y), text, FAINT, small, anchor="rm")
        draw.rectangle((self._left, self._top, self._right, self._bottom), outline=FAINT)
        middle = (self._left + self._right) / 2
        draw.text((middle, self._bottom + 24), below, INK, small, anchor="mt")

    def line(self, x: np.ndarray, y: np.ndarray, colour: tuple[int, ...], width: int) -> None:
        """A line through points."""
        places = [self.place(float(a), float(b)) for a, b in zip(x, y, strict=True)]
        self._draw.line(places, colour, width)

    def dots(self, x: np.ndarray, y: np.ndarray, colour: tuple[int, ...]) -> None:
        """A dot at each point."""
        for a, b in zip(x, y, strict=True):
            u, v = self.place(float(a), float(b))
            self._draw.ellipse((u - 3, v - 3, u + 3, v + 3), colour)

    def key(self, *entries: tuple[str, tuple[int, ...]]) -> None:
        """Names of lines in their colours, in the lower right corner."""
        for number, (name, colour) in enumerate(reversed(entries)):
            at = (self._right - 8, self._bottom - 8 - 1.3 * _TEXT * number)
            self._draw.text(at, drawable(name), colour, font(_TEXT), anchor="rb")


def _ticks(low: float, high: float, logarithmic: bool) -> list[float]:
    """About five round numbers in a range, or logarithms of such.

    Logarithms are of 1, 2 and 5 times powers of ten; over many powers, of ten and its powers alone,
    and over less than a power of ten, of numbers in even steps.
    """
    if not logarithmic:
        return _round_numbers(low, high)
    powers = range(math.floor(low), math.ceil(high) + 1)
    for leading in ((1.0, 2.0, 5.0), (1.0,)):
        found = [k + math.log10(n) for k in powers for n in leading]
        found = [value for value in found if low <= value <= high]
        if len(found) <= MAX_TICKS:
            break
    else:
        return [value for value in _round_numbers(low, high) if value.is_integer()]
    if len(found) >= 2:
        return found
    return [math.log10(n) for n in _round_numbers(10.0**low, 10.0**high) if n > 0.0]


def _round_numbers(low: float, high: float) -> list[float]:
    """About five round numbers in a range."""
    step = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step *= next(k for k in (1.0, 2.0, 5.0, 10.0) if (high - low) / (step * k) <= 6.0)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def _number(value: float, logarithmic: bool) -> str:
    """A number at an axis, short."""
    return f"{10.0**value:.3g}" if logarithmic else f"{value:g}"
