"""What one page shows: warped pictures while its camera moves, then a fine one, piece by piece.

A page is told nothing that it need not know. While its camera moves, the last whole picture is
reprojected by its depth, holes filled by few rays; in between the next whole picture is rendered
from where the camera was when that began. Where there is none yet, or a machine renders in no time,
pictures are rendered, as large as the machine can make them in time. When the camera has come to
rest, the picture is rendered at the resolution of its canvas, in bands of rows, and given up as
soon as the camera moves again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic

import numpy as np

from warpnerf.viewer.painter import Look, Painter, Settings
from warpnerf.viewer.viewpoint import Viewpoint

MOVING_SECONDS = 1.0 / 15.0
"""That a rendered picture may take while the camera moves."""
INTERVAL = 1.0 / 25.0
"""Seconds from one warped picture to the next."""
WARP_SECONDS = 0.05
"""That warping and encoding one may take; on slower machines it is smaller."""
HOLE_SECONDS = 0.003
"""That rays may take which fill its holes."""
KEY_SECONDS = 0.2
"""That the whole picture may take which is warped next."""
NEXT_SHARE = 0.4
"""Of the time to the next warped picture, that a band of the next whole one may take: on a busy
machine it takes longer than it should."""
BAND_SECONDS = 0.04
"""That a band may take: how long a moving camera waits for it, at most."""
REST_SECONDS = 0.2
"""Without a change, after which the fine picture begins."""
SHOW_EVERY = 0.4
"""Seconds from one look at an unfinished fine picture to the next."""
REFRESH_SECONDS = 1.0
"""From a fine picture to the next one, of a field in training."""

MAX_SIDE = 1920
"""Pixels along the longer side of a fine picture; pages of larger screens stretch it."""
MIN_PIXELS = 32 * 24
"""Of a picture while the camera moves."""
MIN_WARPED = 160 * 100
"""Of a warped one."""
STEP = 0.8
"""Sides of warped pictures are those of the fine one times a power of this."""

COARSE_QUALITY, FINE_QUALITY = 70, 92
"""Of JPEG."""


class Pace:
    """How many pixels are made in a second, by what was measured last."""

    def __init__(self, rate: float = 2e5) -> None:
        """A guess."""
        self._rate = rate

    def pixels(self, seconds: float) -> int:
        """About as many as can be made in so many seconds."""
        return int(self._rate * seconds)

    def note(self, pixels: int, seconds: float) -> None:
        """Measured: so many pixels in so many seconds."""
        self._rate += 0.3 * (pixels / max(seconds, 1e-6) - self._rate)


@dataclass(frozen=True, kw_only=True)
class Paces:
    """How fast pictures are made, shared by all screens."""

    coarse: Pace = field(default_factory=Pace)
    """Of rendered ones while the camera moves."""
    fine: Pace = field(default_factory=Pace)
    """Of bands."""
    warped: Pace = field(default_factory=lambda: Pace(1e7))
    """Of warped ones, with what it takes to encode them."""


@dataclass(kw_only=True, eq=False)
class Job:
    """A picture that is rendered band by band."""

    look: Look
    """What it is to be, of which rows are still those of another picture."""
    stamp: tuple[int, ...]
    """Of the fields when it began."""
    row: int = 0
    """The first that is not rendered yet."""

    def is_of(self, viewpoint: Viewpoint, settings: Settings) -> bool:
        """Whether it is the fine picture of a viewpoint."""
        look = self.look
        return (
            look.viewpoint == viewpoint
            and look.settings == settings
            and look.size == fine_size(viewpoint)
        )


class Screen:
    """The picture of one page.

    ``look_from`` may be called by any thread, the rest is for the one that renders.
    """

    def __init__(
        self, painter: Painter, show: Callable[[np.ndarray, int], None], paces: Paces
    ) -> None:
        """Nothing is shown yet.

        Args:
            painter: Makes pixels.
            show: Is given a picture [H, W, 3] uint8, and the quality of JPEG to send it in.
            paces: Shared by all screens.
        """
        self._painter = painter
        self._show = show
        self._paces = paces
        self._wanted: Viewpoint | None = None
        self._drawn: tuple[Viewpoint, Settings] | None = None
        self._changed = 0.0
        self._last: Look | None = None  # what was shown last
        self._whole: Look | None = None  # rendered last, which is warped
        self._sized: Look | None = None  # the same, as large as it is warped
        self._job: Job | None = None
        self._stamp: tuple[int, ...] = ()
        self._shown = 0.0
        self.size = (0, 0)
        """Width and height of the picture that the page got last."""
        self.coarse = False
        """Whether that was one of a moving camera."""
        self.fine = False
        """Whether that was all of a fine one."""

    def look_from(self, viewpoint: Viewpoint) -> None:
        """The page's camera is there now."""
        self._wanted = viewpoint

    def due(self, settings: Settings) -> float | None:
        """When there is something to do: a time of the monotonic clock; None: nothing."""
        wanted, job = self._wanted, self._job
        if wanted is None:
            return None
        if self._drawn is None or self._drawn != (wanted, settings):
            return 0.0
        if job is None and self.fine:
            return None if self._stamp == self._painter.stamp else self._shown + REFRESH_SECONDS
        if job is not None and not job.is_of(wanted, settings):
            return 0.0  # the next whole picture of a camera that may move on
        return self._changed + REST_SECONDS

    def advance(self, settings: Settings, share: float = 1.0) -> None:
        """Do the next piece of work, of a twentieth of a second or so.

        Args:
            settings: What is shown.
            share: Of the time, that pictures get: rendered ones have as many fewer pixels.
        """
        wanted, now = self._wanted, monotonic()
        if wanted is None:
            return
        if self._drawn is None or self._drawn != (wanted, settings):
            if not self._may_warp(wanted, settings, share):
                self._draw_coarse(wanted, settings, share)
            elif now >= self._changed + INTERVAL:
                self._draw_warped(wanted, share)
            else:
                self._draw_next(wanted, settings, share, self._changed + INTERVAL - now)
        elif self._job is not None and now < self._changed + REST_SECONDS:
            self._draw_next(wanted, settings, share, BAND_SECONDS)
        else:
            self._draw_fine(wanted, settings)

    def _may_warp(self, viewpoint: Viewpoint, settings: Settings, share: float) -> bool:
        """Whether there is something to warp, and rendering all pixels would take too long."""
        if self._whole is None or self._whole.settings != settings:
            return False
        width, height = self._warped_size(viewpoint)
        return self._paces.coarse.pixels(share * MOVING_SECONDS) < width * height

    def _warped_size(self, viewpoint: Viewpoint) -> tuple[int, int]:
        """Of pictures that are warped, pixels."""
        wide, high = fine_size(viewpoint)
        most = max(MIN_WARPED, self._paces.warped.pixels(WARP_SECONDS))
        shrink = 1.0
        while wide * high * shrink**2 > most:
            shrink *= STEP
        return max(1, round(shrink * wide)), max(1, round(shrink * high))

    def _draw_coarse(self, viewpoint: Viewpoint, settings: Settings, share: float) -> None:
        """Render a picture in time."""
        budget = max(MIN_PIXELS, self._paces.coarse.pixels(share * MOVING_SECONDS))
        size = _shrunk(fine_size(viewpoint), budget)
        began = monotonic()
        look = self._painter.look(viewpoint, settings, size)
        self._paces.coarse.note(size[0] * size[1], monotonic() - began)
        self._whole, self._job = look, None
        self._moved_to(look)

    def _draw_warped(self, viewpoint: Viewpoint, share: float) -> None:
        """Show the last whole picture as it looks from here."""
        assert self._whole is not None
        size, began = self._warped_size(viewpoint), monotonic()
        if self._sized is None or self._sized.size != size:
            self._sized = self._whole.resized(size)
        rays = max(1, self._paces.coarse.pixels(share * HOLE_SECONDS))
        look = self._painter.reproject(self._sized, viewpoint, rays)
        self._moved_to(look, began)
        self._paces.warped.note(size[0] * size[1], monotonic() - began)

    def _moved_to(self, look: Look, began: float | None = None) -> None:
        """A camera that moves sees this, since now or what has been said."""
        self._drawn = look.viewpoint, look.settings
        self._last = look
        self._send(look, COARSE_QUALITY, coarse=True)
        self._changed = monotonic() if began is None else began

    def _draw_next(
        self, viewpoint: Viewpoint, settings: Settings, share: float, seconds: float
    ) -> None:
        """A band of the next picture to be warped, in so many seconds."""
        if self._job is None:
            budget = max(MIN_PIXELS, self._paces.fine.pixels(share * KEY_SECONDS))
            size = _shrunk(self._warped_size(viewpoint), budget)
            self._begin(viewpoint, settings, size)
        self._draw_band(min(NEXT_SHARE * seconds, BAND_SECONDS))

    def _draw_fine(self, viewpoint: Viewpoint, settings: Settings) -> None:
        """A band of the picture at rest."""
        if self._job is None or not self._job.is_of(viewpoint, settings):
            self._begin(viewpoint, settings, fine_size(viewpoint))
        job = self._draw_band(BAND_SECONDS)
        if self._job is None or monotonic() - self._shown >= SHOW_EVERY:
            self._last = job.look
            done = self._job is None
            self._send(job.look, FINE_QUALITY if done else COARSE_QUALITY, fine=done)

    def _begin(self, viewpoint: Viewpoint, settings: Settings, size: tuple[int, int]) -> None:
        """Begin a picture, over what is shown now."""
        assert self._last is not None
        self._job = Job(
            look=self._last.resized(size).copied(viewpoint, settings), stamp=self._painter.stamp
        )

    def _draw_band(self, seconds: float) -> Job:
        """Render the next rows of the picture that was begun; the last ones end it."""
        assert self._job is not None
        job = self._job
        look, (wide, high) = job.look, job.look.size
        n_rows = max(1, self._paces.fine.pixels(seconds) // wide)
        rows = range(job.row, min(high, job.row + n_rows))
        began = monotonic()
        band = self._painter.look(look.viewpoint, look.settings, look.size, rows)
        self._paces.fine.note(wide * len(rows), monotonic() - began)
        look.picture[rows.start : rows.stop] = band.picture
        look.distance[rows.start : rows.stop] = band.distance
        job.row = rows.stop
        if job.row == high:
            self._whole, self._sized, self._stamp, self._job = look, None, job.stamp, None
        return job

    def _send(self, look: Look, quality: int, *, coarse: bool = False, fine: bool = False) -> None:
        self.size = look.size
        self.coarse, self.fine = coarse, fine
        self._shown = monotonic()
        self._show(self._painter.divided(look.picture, look.settings), quality)


def fine_size(viewpoint: Viewpoint) -> tuple[int, int]:
    """Width and height of a fine picture, pixels: those of the canvas, up to MAX_SIDE."""
    shrink = min(1.0, MAX_SIDE / max(viewpoint.width, viewpoint.height))
    return max(1, round(shrink * viewpoint.width)), max(1, round(shrink * viewpoint.height))


def _shrunk(size: tuple[int, int], most: int) -> tuple[int, int]:
    """A size of the same shape, of so many pixels at most."""
    wide, high = size
    shrink = min(1.0, (most / (wide * high)) ** 0.5)
    return max(1, round(shrink * wide)), max(1, round(shrink * high))
