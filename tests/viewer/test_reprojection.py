"""3D warping of pictures with depth, compared with pictures of scenes whose truth is a formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at, ring
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.viewer.painter import Look, Painter, Settings, Subject, pixel_rays
from warpnerf.viewer.reprojection import Reprojector
from warpnerf.viewer.viewpoint import Viewpoint

WIDTH, HEIGHT = 96, 64
SETTINGS = Settings(near=1.0, far=4.0, within=2.5)


def camera(x: float = 0.0, y: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Camera:
    """Looking along -z from (x, y, z), turned to the left by an angle in radians."""
    pose = np.eye(4)
    pose[:3, :3] = [
        [np.cos(turn), 0.0, np.sin(turn)],
        [0.0, 1.0, 0.0],
        [-np.sin(turn), 0.0, np.cos(turn)],
    ]
    pose[:3, 3] = x, y, z
    return camera_at(pose, width=WIDTH, height=HEIGHT, fx=80.0, fy=90.0, cx=50.0, cy=30.0)


def walls(view: Camera, near: float | None = None) -> tuple[np.ndarray, np.ndarray]:
    """A wall at z = -4, and before it a square of 1.2 at z = -near; colours by the place."""
    rows, columns = np.mgrid[: view.height, : view.width].reshape(2, -1)
    origins, directions = pixel_rays(view, rows, columns)
    distance = (-4.0 - origins[:, 2]) / directions[:, 2]
    place = origins + distance[:, None] * directions
    rgb = 128.0 + 60.0 * np.sin(place[:, [0, 1, 0]] * [2.0, 3.0, 5.0])
    if near is not None:
        there = (-near - origins[:, 2]) / directions[:, 2]
        spot = origins + there[:, None] * directions
        square = np.abs(spot[:, :2]).max(axis=1) < 0.6
        distance = np.where(square, there, distance)
        rgb[square] = np.array([250.0, 250.0, 30.0])
    size = view.height, view.width
    picture = np.round(rgb).astype(np.uint8).reshape(*size, 3)
    return picture, distance.astype(np.float32).reshape(size)


def warped(source: Camera, target: Camera, near: float | None = None) -> tuple[np.ndarray, ...]:
    """A picture, where it is known, and what it should be."""
    picture, seen = Reprojector().warp(*walls(source, near), source, target)
    return picture, seen, walls(target, near)[0]


def test_from_the_same_place_a_picture_stays_as_it_is() -> None:
    picture, seen, truth = warped(camera(0.3, 0.2), camera(0.3, 0.2), near=2.0)
    assert seen.all()
    assert np.abs(picture.astype(int) - truth).max() <= 1


@pytest.mark.parametrize(
    "target",
    [
        camera(x=0.3),
        camera(y=-0.2),
        camera(z=-1.0),
        camera(z=0.7),
        camera(turn=0.2),
        camera(x=-0.2, y=0.1, z=-0.5, turn=-0.1),
    ],
    ids=["right", "down", "ahead", "back", "turn", "all"],
)
def test_a_wall_is_seen_from_elsewhere_as_it_is(target: Camera) -> None:
    picture, seen, truth = warped(camera(), target)
    assert 0.6 < seen.mean() <= 1.0
    assert np.abs(picture.astype(int) - truth)[seen].max() <= 6  # between pixels: interpolated
    still = np.abs(walls(camera())[0].astype(int) - truth).mean()
    assert np.abs(picture.astype(int) - truth)[seen].mean() < 0.05 * still
    # All that both see is known.
    rows, columns = np.mgrid[:HEIGHT, :WIDTH].reshape(2, -1)
    origins, directions = pixel_rays(target, rows, columns)
    place = origins + ((-4.0 - origins[:, 2]) / directions[:, 2])[:, None] * directions
    u = 80.0 * place[:, 0] / -place[:, 2] + 50.0
    v = 30.0 - 90.0 * place[:, 1] / -place[:, 2]
    inside = (u > 1) & (u < WIDTH - 1) & (v > 1) & (v < HEIGHT - 1)
    assert seen.reshape(-1)[inside].all()


def test_what_was_hidden_is_not_made_up() -> None:
    """Behind a square the wall comes into sight on one side, and goes out of it on the other."""
    source, target = camera(), camera(x=0.6)
    picture, seen, truth = warped(source, target, near=2.0)
    wrong = np.abs(picture.astype(int) - truth).max(axis=-1) > 12
    assert (wrong & seen).mean() < 0.02  # the outline of the square, which is a pixel thick
    yellow = (truth == [250, 250, 30]).all(axis=-1)
    shown = (np.abs(picture.astype(int) - [250, 250, 30]).max(axis=-1) < 12) & seen
    assert (yellow & ~shown).sum() < 0.1 * yellow.sum()
    hidden = ~seen[:, : WIDTH - 20]  # the picture's own edge is elsewhere
    assert 0.5 < hidden.sum() / (0.3 * 80.0 / 2.0 * (1.2 * 90.0 / 2.0)) < 2.0


def test_the_background_turns_and_does_not_shift() -> None:
    source = camera()
    picture, _ = walls(source)
    nowhere = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    shifted, seen = Reprojector().warp(picture, nowhere, source, camera(x=3.0))
    assert seen.all() and np.abs(shifted.astype(int) - picture).max() <= 1
    turned, seen = Reprojector().warp(picture, nowhere, source, camera(turn=0.3))
    assert 0.5 < seen.mean() < 0.95 and np.abs(turned.astype(int) - picture)[seen].mean() > 5.0


def test_pixels_without_a_distance_are_not_used() -> None:
    picture, distance = walls(camera())
    distance[:, 40:50] = 0.0
    _, seen = Reprojector().warp(picture, distance, camera(), camera())
    assert not seen[:, 40:50].any() and seen[:, 39].mean() < 0.5  # nor for their neighbours
    assert seen[:, :39].all() and seen[:, 51:].all()


def look_from(painter: Painter, viewpoint: Viewpoint, settings: Settings = SETTINGS) -> Look:
    return painter.look(viewpoint, settings, (WIDTH, HEIGHT))


def viewpoint(angle: float = 0.0, radius: float = 3.5) -> Viewpoint:
    eye = radius * np.sin(angle), -radius * np.cos(angle), 0.8
    return Viewpoint(c2w=look_at(eye, (0.0, 0.0, 0.0))[:3], fov=0.8, width=WIDTH, height=HEIGHT)


@pytest.mark.parametrize("layout", ["first", "divided", "side by side"])
def test_a_field_is_shown_from_elsewhere(layout: str) -> None:
    """A dense one, whose surface has a place; what it hid is rendered."""
    solid, other = tiny_field(density=30.0), tiny_field(density=29.0)
    painter = Painter(
        [Subject(name=str(i), field=lambda f=f: f) for i, f in enumerate((solid, other))]
    )
    settings = replace(SETTINGS, layout=layout, divider=0.3)  # type: ignore[arg-type]
    before = look_from(painter, viewpoint(), settings)
    wanted = look_from(painter, viewpoint(0.15), settings)
    moved = painter.reproject(before, viewpoint(0.15), WIDTH * HEIGHT)
    assert moved.viewpoint == wanted.viewpoint or moved.viewpoint.c2w is not before.viewpoint.c2w
    error = np.abs(moved.picture.astype(float) - wanted.picture).mean()
    assert error < 0.5 * np.abs(before.picture.astype(float) - wanted.picture).mean()


def test_where_nothing_was_seen_few_rays_are_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    """From behind nothing is known: blocks of one ray each, no more of them than said."""
    painter = Painter([Subject(name="", field=lambda: field)])
    field = tiny_field()
    before = look_from(painter, viewpoint())
    away = Viewpoint(
        c2w=look_at((0.0, -3.5, 0.8), (0.0, -9.0, 0.8))[:3], fov=0.8, width=WIDTH, height=HEIGHT
    )
    counts = []
    render_rays = type(field).render_rays

    def counted(self: object, origins: np.ndarray, directions: np.ndarray) -> object:
        counts.append(len(origins))
        return render_rays(self, origins, directions)  # type: ignore[arg-type]

    monkeypatch.setattr(type(field), "render_rays", counted)
    for most, blocks in ((2000, 48 * 32), (400, 24 * 16), (1, 1)):
        counts.clear()
        moved = painter.reproject(before, away, most)
        assert counts == [blocks]
    behind = tuple(int(np.round(255 * c)) for c in field.background)
    assert (moved.picture == behind).all()


def test_pictures_of_other_sizes_have_the_nearest_pixels() -> None:
    picture = np.arange(12, dtype=np.uint8).reshape(2, 2, 3)
    look = Look(
        viewpoint=Viewpoint(c2w=ring(3)[0][:3], fov=0.8, width=4, height=4),
        settings=SETTINGS,
        picture=picture,
        distance=np.array([[1.0, 2.0], [3.0, 4.0]], np.float32),
    )
    large = look.resized((4, 4))
    np.testing.assert_array_equal(large.picture, picture.repeat(2, 0).repeat(2, 1))
    np.testing.assert_array_equal(large.distance, look.distance.repeat(2, 0).repeat(2, 1))
    np.testing.assert_array_equal(large.resized((2, 2)).picture, picture)
    assert look.resized((2, 2)) is look
