"""What one page shows: coarse while something changes, then fine, piece by piece.

A page is told nothing that it need not know: while its camera moves it gets small pictures, as
large as the machine can make them in time. When it has come to rest the picture is rendered again
at the resolution of its canvas, in bands of rows, and given up as soon as the camera moves again.
"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic

import numpy as np

from warpnerf.viewer.painter import Painter, Settings
from warpnerf.viewer.viewpoint import Viewpoint

MOVING_SECONDS = 1.0 / 15.0
"""That a picture may take while the camera moves."""
BAND_SECONDS = 0.04
"""That a band may take: how long a moving camera waits for it, at most."""
REST_SECONDS = 0.15
"""Without a change, after which the fine picture begins."""
SHOW_EVERY = 0.4
"""Seconds from one look at an unfinished fine picture to the next."""
REFRESH_SECONDS = 1.0
"""From a fine picture to the next one, of a field in training."""

MAX_SIDE = 1920
"""Pixels along the longer side of a fine picture; pages of larger screens stretch it."""
MIN_PIXELS = 32 * 24
"""Of a coarse picture."""

COARSE_QUALITY, FINE_QUALITY = 70, 92
"""Of JPEG."""


class Pace:
    """How many pixels are made in a second, by what was measured last."""

    def __init__(self) -> None:
        """A guess."""
        self._rate = 2e5

    def pixels(self, seconds: float) -> int:
        """About as many as can be made in so many seconds."""
        return int(self._rate * seconds)

    def note(self, pixels: int, seconds: float) -> None:
        """Measured: so many pixels in so many seconds."""
        self._rate += 0.3 * (pixels / max(seconds, 1e-6) - self._rate)


class Screen:
    """The picture of one page.

    ``look_from`` may be called by any thread, the rest is for the one that renders.
    """

    def __init__(
        self, painter: Painter, show: Callable[[np.ndarray, int], None], coarse: Pace, fine: Pace
    ) -> None:
        """Nothing is shown yet.

        Args:
            painter: Makes pixels.
            show: Is given a picture [H, W, 3] uint8, and the quality of JPEG to send it in.
            coarse: Of coarse pictures, shared by all screens.
            fine: Of bands.
        """
        self._painter = painter
        self._show = show
        self._coarse = coarse
        self._fine = fine
        self._wanted: Viewpoint | None = None
        self._drawn: tuple[Viewpoint, Settings] | None = None
        self._changed = 0.0
        self._canvas = np.empty((0, 0, 3), np.uint8)
        self._row = 0
        self._stamp: tuple[int, ...] = ()
        self._shown = 0.0
        self.size = (0, 0)
        """Width and height of the picture that the page got last."""
        self.coarse = False
        """Whether that was a coarse one."""
        self.fine = False
        """Whether that was all of a fine one."""

    def look_from(self, viewpoint: Viewpoint) -> None:
        """The page's camera is there now."""
        self._wanted = viewpoint

    def due(self, settings: Settings) -> float | None:
        """When there is something to do: a time of the monotonic clock; None: nothing."""
        if self._wanted is None:
            return None
        if self._drawn is None or self._drawn != (self._wanted, settings):
            return 0.0
        if self._row < len(self._canvas):
            return self._changed + REST_SECONDS
        if self._stamp != self._painter.stamp:
            return self._shown + REFRESH_SECONDS
        return None

    def advance(self, settings: Settings, share: float = 1.0) -> None:
        """Do the next piece of work, of a twentieth of a second or so.

        Args:
            settings: What is shown.
            share: Of the time, that pictures get: coarse ones have as many fewer pixels.
        """
        wanted = self._wanted
        if wanted is None:
            return
        if self._drawn is None or self._drawn != (wanted, settings):
            self._draw_coarse(wanted, settings, share)
            return
        if self._row == len(self._canvas):  # once more, over what is shown
            self._row = 0
        self._draw_band(wanted, settings)

    def _draw_coarse(self, viewpoint: Viewpoint, settings: Settings, share: float) -> None:
        wide, high = fine_size(viewpoint)
        pixels = max(MIN_PIXELS, self._coarse.pixels(share * MOVING_SECONDS))
        shrink = min(1.0, (pixels / (wide * high)) ** 0.5)
        size = (max(1, round(shrink * wide)), max(1, round(shrink * high)))
        began = monotonic()
        picture = self._painter.paint(viewpoint, settings, size)
        self._coarse.note(size[0] * size[1], monotonic() - began)
        self._drawn = viewpoint, settings
        self._changed = monotonic()
        columns = np.arange(wide) * size[0] // wide
        rows = np.arange(high) * size[1] // high
        self._canvas, self._row = picture[rows[:, None], columns], 0
        self._send(picture, COARSE_QUALITY, coarse=True)

    def _draw_band(self, viewpoint: Viewpoint, settings: Settings) -> None:
        if self._row == 0:
            self._stamp = self._painter.stamp
        high, wide = self._canvas.shape[:2]
        n_rows = max(1, self._fine.pixels(BAND_SECONDS) // wide)
        rows = range(self._row, min(high, self._row + n_rows))
        began = monotonic()
        band = self._painter.paint(viewpoint, settings, (wide, high), rows)
        self._fine.note(wide * len(rows), monotonic() - began)
        self._canvas[rows.start : rows.stop] = band
        self._row = rows.stop
        done = self._row == high
        if done or monotonic() - self._shown >= SHOW_EVERY:
            self._send(self._canvas, FINE_QUALITY if done else COARSE_QUALITY, fine=done)

    def _send(
        self, picture: np.ndarray, quality: int, *, coarse: bool = False, fine: bool = False
    ) -> None:
        self.size = picture.shape[1], picture.shape[0]
        self.coarse, self.fine = coarse, fine
        self._shown = monotonic()
        self._show(picture, quality)


def fine_size(viewpoint: Viewpoint) -> tuple[int, int]:
    """Width and height of a fine picture, pixels: those of the canvas, up to MAX_SIDE."""
    shrink = min(1.0, MAX_SIDE / max(viewpoint.width, viewpoint.height))
    return max(1, round(shrink * viewpoint.width)), max(1, round(shrink * viewpoint.height))
