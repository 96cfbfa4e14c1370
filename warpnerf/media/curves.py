"""Training curves in one picture: loss and PSNR, over steps and over seconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.media.pictures import FAINT, INK, font

SIZE = (1200, 760)
"""Of the picture, pixels."""

_TRAIN, _TEST, _GRID = (31, 119, 180), (214, 39, 40), (225, 225, 225)
_TEXT, _TITLE = 15, 20
_LEFT, _RIGHT, _TOP, _BOTTOM = 70, 20, 34, 46
_WINDOWS = 30
"""Of all values, the line through them is the mean of one in so many on either side."""


@dataclass(frozen=True, kw_only=True)
class CurvePoint:
    """What a report of a training says of its progress."""

    step: int
    """Steps done."""
    seconds: float
    """Of training."""
    loss: float
    """Of the last update, over whole pictures."""
    psnr: float
    """Of the training rays, over whole pictures, dB."""
    test_psnr: float | None = None
    """Mean over test views, dB; None: they were not rendered then."""


def curves(points: Sequence[CurvePoint], title: str) -> np.ndarray:
    """Plot training curves: loss above on a logarithmic axis, PSNR below.

    Single values are faint; the line through them is their running mean. Test PSNR is red, with a
    dot for each measurement.

    Args:
        points: At least one, in the order of the training.
        title: Above the plots.

    Returns:
        [H, W, 3] uint8 of ``SIZE``.
    """
    sheet = Image.new("RGB", SIZE, "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((12, 8), title, INK, font(_TITLE))
    width, height = SIZE[0] // 2, (SIZE[1] - 2 * _TITLE) // 2
    loss = np.array([math.log10(max(p.loss, 1e-12)) for p in points])
    psnr = np.array([p.psnr for p in points])
    tested = [k for k, p in enumerate(points) if p.test_psnr is not None]
    test = np.array([points[k].test_psnr for k in tested], np.float64)
    for column, axis in enumerate(("steps", "seconds")):
        along = np.array([p.step if axis == "steps" else p.seconds for p in points], np.float64)
        for row, (name, values) in enumerate((("loss", loss), ("PSNR [dB]", psnr))):
            corner = (column * width, 2 * _TITLE + row * height)
            others = test if row else test[:0]
            frame = _Frame(draw, corner, (width, height), along, np.concatenate([values, others]))
            frame.axes(axis, name, logarithmic=row == 0)
            frame.line(along, values, _pale(_TRAIN), width=1)
            frame.line(along, _running_mean(values), _TRAIN, width=2)
            if row and tested:
                frame.line(along[tested], test, _TEST, width=2)
                frame.dots(along[tested], test, _TEST)
                frame.key(("training rays", _TRAIN), ("test views", _TEST))
    return np.asarray(sheet)


class _Frame:
    """A plot: from numbers to pixels."""

    def __init__(
        self,
        draw: ImageDraw.ImageDraw,
        corner: tuple[int, int],
        size: tuple[int, int],
        x: np.ndarray,
        y: np.ndarray,
    ) -> None:
        self._draw = draw
        self._left, self._right = corner[0] + _LEFT, corner[0] + size[0] - _RIGHT
        self._top, self._bottom = corner[1] + _TOP, corner[1] + size[1] - _BOTTOM
        self._x = (0.0, max(float(x.max()), 1e-9))
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

    def axes(self, below: str, beside: str, *, logarithmic: bool) -> None:
        """Frame, round numbers and what they are."""
        draw, small = self._draw, font(_TEXT)
        draw.text((self._left, self._top - 6), beside, INK, small, anchor="lb")
        for value in _round_numbers(*self._x):
            x, _ = self.place(value, self._y[0])
            draw.line([(x, self._top), (x, self._bottom)], _GRID)
            draw.text((x, self._bottom + 6), f"{value:g}", FAINT, small, anchor="mt")
        for value in _round_numbers(*self._y):
            _, y = self.place(0.0, value)
            draw.line([(self._left, y), (self._right, y)], _GRID)
            text = f"{10.0**value:.2g}" if logarithmic else f"{value:g}"
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
            self._draw.text(at, name, colour, font(_TEXT), anchor="rb")


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the values around each, as many before as after."""
    total, n = np.concatenate([[0.0], np.cumsum(values)]), len(values)
    k = np.arange(n)
    half = np.minimum(np.minimum(k, n - 1 - k), n // _WINDOWS)
    return np.asarray((total[k + half + 1] - total[k - half]) / (2 * half + 1))


def _round_numbers(low: float, high: float) -> list[float]:
    """About five round numbers in a range."""
    step = 10.0 ** math.floor(math.log10((high - low) / 4.0))
    step *= next(k for k in (1.0, 2.0, 5.0, 10.0) if (high - low) / (step * k) <= 6.0)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def _pale(colour: tuple[int, int, int]) -> tuple[int, ...]:
    return tuple(255 - (255 - part) // 4 for part in colour)
