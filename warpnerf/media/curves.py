"""Training curves in one picture: loss and PSNR, over steps and over seconds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from warpnerf.media.pictures import INK, drawable, font
from warpnerf.media.plots import Frame

SIZE = (1200, 760)
"""Of the picture, pixels."""

_TRAIN, _TEST = (31, 119, 180), (214, 39, 40)
_TITLE = 20
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
    draw.text((12, 8), drawable(title), INK, font(_TITLE))
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
            whole = np.concatenate([[0.0], along]), np.concatenate([values, others])
            frame = Frame(draw, corner, (width, height), *whole)
            frame.axes(axis, name, logarithmic=(False, row == 0))
            frame.line(along, values, _pale(_TRAIN), width=1)
            frame.line(along, running_mean(values), _TRAIN, width=2)
            if row and tested:
                frame.line(along[tested], test, _TEST, width=2)
                frame.dots(along[tested], test, _TEST)
                frame.key(("training rays", _TRAIN), ("test views", _TEST))
    return np.asarray(sheet)


def running_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the values around each, as many before as after."""
    total, n = np.concatenate([[0.0], np.cumsum(values)]), len(values)
    k = np.arange(n)
    half = np.minimum(np.minimum(k, n - 1 - k), n // _WINDOWS)
    return np.asarray((total[k + half + 1] - total[k - half]) / (2 * half + 1))


def _pale(colour: tuple[int, int, int]) -> tuple[int, ...]:
    return tuple(255 - (255 - part) // 4 for part in colour)
