"""What a page is shown when: coarse or warped while it moves, fine at rest, nothing for nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_scenes import ring
from warpnerf.viewer import screen as module
from warpnerf.viewer.painter import Look, Settings
from warpnerf.viewer.screen import REFRESH_SECONDS, REST_SECONDS, Paces, Screen, fine_size
from warpnerf.viewer.viewpoint import Viewpoint

SETTINGS = Settings(near=0.0, far=1.0, within=0.1)
PIXELS_PER_SECOND = 60_000.0
WARPED_PER_SECOND = 3e6


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class Paints:
    """In place of a painter: row numbers, in a time that grows with the pixels."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.stamp = (0,)
        self.calls: list[tuple[tuple[int, int], int]] = []
        self.warped: list[tuple[Look, Viewpoint, int]] = []
        self.pixels_per_second = PIXELS_PER_SECOND

    def look(
        self, viewpoint: Viewpoint, settings: Settings, size: Any, rows: range | None = None
    ) -> Look:
        rows = rows or range(size[1])
        self.calls.append((size, len(rows)))
        self.clock.now += size[0] * len(rows) / self.pixels_per_second
        picture = np.repeat(np.array(rows, np.uint8)[:, None, None], size[0], 1).repeat(3, 2)
        distance = np.ones(picture.shape[:2], np.float32)
        return Look(viewpoint=viewpoint, settings=settings, picture=picture, distance=distance)

    def reproject(self, look: Look, viewpoint: Viewpoint, n_rays: int) -> Look:
        self.warped.append((look, viewpoint, n_rays))
        self.clock.now += look.distance.size / WARPED_PER_SECOND
        return replace(look, viewpoint=viewpoint)

    def divided(self, picture: np.ndarray, settings: Settings) -> np.ndarray:
        return picture


class Watched:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.clock = Clock()
        monkeypatch.setattr(module, "monotonic", self.clock)
        self.painter = Paints(self.clock)
        self.shown: list[np.ndarray] = []
        show: Any = lambda picture, quality: self.shown.append(picture.copy())  # noqa: E731
        self.screen = Screen(self.painter, show, Paces())  # type: ignore[arg-type]

    def run(self, settings: Settings = SETTINGS, share: float = 1.0) -> None:
        """As long as something is due, waiting for it."""
        while (due := self.screen.due(settings)) is not None:
            self.clock.now = max(self.clock.now, due)
            self.screen.advance(settings, share)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


def viewpoint(index: int = 0, width: int = 200, height: int = 150) -> Viewpoint:
    return Viewpoint(c2w=ring(9)[index][:3], fov=0.8, width=width, height=height)


def test_nothing_is_due_before_a_page_says_where_it_is(watched: Watched) -> None:
    assert watched.screen.due(SETTINGS) is None
    watched.screen.advance(SETTINGS)
    assert not watched.painter.calls


def test_coarse_comes_at_once_and_fine_at_rest(watched: Watched) -> None:
    watched.screen.look_from(viewpoint())
    assert watched.screen.due(SETTINGS) == 0.0
    watched.screen.advance(SETTINGS)
    assert len(watched.shown) == 1 and watched.shown[0].shape[1] < 200
    due = watched.screen.due(SETTINGS)
    assert due == watched.clock.now + REST_SECONDS
    watched.run()
    np.testing.assert_array_equal(watched.shown[-1][:, 0, 0], np.arange(150))
    assert watched.shown[-1].shape == (150, 200, 3)
    assert watched.screen.due(SETTINGS) is None and watched.screen.fine
    assert sum(rows for size, rows in watched.painter.calls if size == (200, 150)) == 150


def test_coarse_pictures_come_in_time(watched: Watched) -> None:
    """As many pixels as the machine makes in a fifteenth of a second, and of its share of it."""
    for share in (1.0, 0.25):
        for index in range(40):
            watched.screen.look_from(viewpoint())
            began = watched.clock.now
            watched.screen.advance(replace(SETTINGS, within=1.0 + index), share)  # nothing to warp
            seconds = watched.clock.now - began
        assert seconds == pytest.approx(share * module.MOVING_SECONDS, rel=0.1)


def test_a_small_canvas_gets_no_more_than_it_has(watched: Watched) -> None:
    watched.screen.look_from(viewpoint(width=16, height=12))
    watched.run()
    assert {picture.shape for picture in watched.shown} == {(12, 16, 3)}


def drag(watched: Watched, seconds: float, share: float = 1.0) -> int:
    """Say fifty times a second that the camera has moved; the pictures that come."""
    before, end, said = len(watched.shown), watched.clock.now + seconds, watched.clock.now
    index = 0
    while watched.clock.now < end:
        while said <= watched.clock.now:
            index, said = index + 1, said + 0.02
            watched.screen.look_from(viewpoint(index % 9))
        due = watched.screen.due(SETTINGS)
        if due is None or due > watched.clock.now:
            watched.clock.now = said
            continue
        watched.screen.advance(SETTINGS, share)
    return len(watched.shown) - before


@pytest.mark.parametrize("share", [1.0, 0.3])
def test_a_drag_shows_the_last_whole_picture_warped(watched: Watched, share: float) -> None:
    """In full resolution, fifteen times a second; the next whole ones come in between."""
    watched.screen.look_from(viewpoint())
    watched.run()
    fine = watched.screen._whole
    assert drag(watched, 4.0, share) >= 15 * 4.0
    assert {picture.shape for picture in watched.shown[-50:]} == {(150, 200, 3)}
    looks = [id(look) for look, _, _ in watched.painter.warped]
    assert watched.painter.warped[0][0] is fine
    assert 4 <= len(set(looks)) < 0.7 * len(looks)  # each is warped several times
    assert all(n >= 1 for _, _, n in watched.painter.warped)
    last = watched.painter.warped[-1][0].viewpoint
    assert fine is not None and last is not fine.viewpoint
    watched.run()
    assert watched.screen.fine and watched.screen._drawn == (watched.screen._wanted, SETTINGS)


def test_a_machine_that_renders_in_no_time_warps_nothing(watched: Watched) -> None:
    watched.painter.pixels_per_second = 1e8
    watched.screen.look_from(viewpoint())
    for _ in range(20):  # which is measured first
        watched.screen.advance(SETTINGS)
        watched.screen._drawn = None
    watched.run()
    watched.painter.warped.clear()
    drag(watched, 1.0)
    assert not watched.painter.warped and watched.shown[-1].shape == (150, 200, 3)


def test_a_machine_that_warps_slowly_gets_smaller_pictures(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "WARPED_PER_SECOND", 3e5)
    watched.screen.look_from(viewpoint())
    watched.run()
    assert drag(watched, 3.0) >= 15 * 3.0 * 0.8
    assert watched.shown[-1].shape[1] == round(200 * module.STEP**2)


def test_at_rest_the_fine_picture_comes_within_a_second(watched: Watched) -> None:
    watched.screen.look_from(viewpoint())
    watched.run()
    drag(watched, 1.0)
    stopped = watched.clock.now
    watched.run()
    rendering = 200 * 150 / PIXELS_PER_SECOND
    assert watched.clock.now - stopped < REST_SECONDS + rendering + 2.0 * module.MOVING_SECONDS


def test_a_band_is_short_and_a_move_gives_the_rest_up(watched: Watched) -> None:
    watched.screen.look_from(viewpoint())
    watched.screen.advance(SETTINGS)
    watched.clock.now += 1.0
    for _ in range(2):
        began = watched.clock.now
        watched.screen.advance(SETTINGS)
        assert watched.clock.now - began < 4.0 * module.BAND_SECONDS
    assert not watched.screen.fine
    watched.screen.look_from(viewpoint(1))
    assert watched.screen.due(SETTINGS) == 0.0
    watched.screen.advance(SETTINGS)
    assert watched.painter.warped[-1][1].c2w is watched.screen._wanted.c2w  # type: ignore[union-attr]


def test_what_is_set_begins_anew(watched: Watched) -> None:
    watched.screen.look_from(viewpoint())
    watched.run()
    other = replace(SETTINGS, kind="depth")
    assert watched.screen.due(other) == 0.0
    watched.run(other)
    assert watched.screen.due(other) is None and watched.screen.due(SETTINGS) == 0.0


def test_an_unfinished_picture_is_shown_now_and_then(watched: Watched) -> None:
    watched.screen.look_from(viewpoint(width=400, height=200))  # takes more than a second
    watched.run()
    fine = [picture for picture in watched.shown if picture.shape == (200, 400, 3)]
    assert 3 <= len(fine) <= 5
    done = (fine[0][:, 0, 0] == np.arange(200)).sum()
    assert 20 < done < 199


def test_a_field_in_training_is_shown_anew_but_not_all_the_time(watched: Watched) -> None:
    watched.screen.look_from(viewpoint())
    watched.run()
    finished = watched.clock.now
    watched.painter.stamp = (1,)
    due = watched.screen.due(SETTINGS)
    assert due == finished + REFRESH_SECONDS
    before = len(watched.painter.calls)
    watched.clock.now = due
    while watched.screen.due(SETTINGS) is not None:
        watched.screen.advance(SETTINGS)
    assert {size for size, _ in watched.painter.calls[before:]} == {(200, 150)}  # nothing coarse


def test_large_canvases_are_stretched() -> None:
    assert fine_size(viewpoint(width=3840, height=2160)) == (1920, 1080)
    assert fine_size(viewpoint(width=10**9, height=10**8)) == (1920, 192)
    assert fine_size(viewpoint(width=800, height=600)) == (800, 600)
