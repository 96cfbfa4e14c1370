"""Paths are smooth, stay upright, and lead where they say."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_scenes import camera_at, look_at, ring, tiny_scene
from warpnerf.checks import InputError
from warpnerf.media.camera_path import backing_away, camera_path, natural_path, path_lens
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene

UP = np.array([0.0, 0.0, 1.0])


def walk(n: int = 12) -> Scene:
    """Cameras along a wavy line, that look ahead and a little about."""
    at = [(0.5 * i, 0.2 * np.sin(i), 1.0) for i in range(n)]
    return tiny_scene([look_at(p, (p[0] + 3.0, p[1] + np.cos(i), 1.2)) for i, p in enumerate(at)])


def positions(cameras: list[Camera]) -> np.ndarray:
    return np.array([camera.position for camera in cameras])


def assert_smooth(cameras: list[Camera]) -> None:
    """Rigid and upright poses, none of which leaps."""
    poses = np.array([camera.c2w for camera in cameras])
    np.testing.assert_allclose(
        poses[:, :, :3].transpose(0, 2, 1) @ poses[:, :, :3],
        np.broadcast_to(np.eye(3), (len(poses), 3, 3)),
        atol=1e-9,
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :, :3]), 1.0, atol=1e-9)
    assert (poses[:, :, 1] @ UP > 0.0).all()
    steps = np.linalg.norm(np.diff(poses, axis=0), axis=(1, 2))
    assert steps.max() < 4.0 * np.median(steps)


@pytest.mark.parametrize("kind", ["orbit", "through", "back"])
def test_paths_are_smooth_and_upright(kind: Any) -> None:
    cameras = camera_path(tiny_scene(ring(14)), kind, 120)
    assert len(cameras) == 120
    assert_smooth(cameras)


def test_an_orbit_goes_all_the_way_round_at_the_cameras_distance() -> None:
    cameras = camera_path(tiny_scene(ring(14, radius=3.0, height=1.0)), "orbit", 60)
    places = positions(cameras)
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1]), 3.0, atol=1e-6)
    np.testing.assert_allclose(places[:, 2], 1.0, atol=1e-6)
    turned = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    assert abs(turned[-1] - turned[0]) == pytest.approx(2.0 * np.pi * 59 / 60)
    for camera in cameras:  # towards the middle
        assert camera.forward @ -camera.position == pytest.approx(np.sqrt(10.0))


def test_an_orbit_is_as_far_away_as_the_cameras_on_that_side() -> None:
    """On one side they stand low and close, on the other high and far."""
    angles = 2.0 * np.pi * np.arange(24) / 24
    poses = [
        look_at((r * np.cos(a), r * np.sin(a), 0.5 * r), (0.0, 0.0, 0.0))
        for a, r in zip(angles, np.where(np.cos(angles) > 0.0, 2.0, 4.0), strict=True)
    ]
    places = positions(camera_path(tiny_scene([*poses, poses[0]]), "orbit", 120))
    radii, along = np.hypot(places[:, 0], places[:, 1]), places[:, 0]
    assert radii[along.argmax()] == pytest.approx(2.0, abs=0.1)
    assert radii[along.argmin()] == pytest.approx(4.0, abs=0.1)
    between = np.abs(along) < 0.3
    assert (radii[between] > 2.5).all() and (radii[between] < 3.5).all()
    np.testing.assert_allclose(places[:, 2], 0.5 * radii, atol=0.05)


def test_an_orbit_stays_on_the_side_that_was_photographed() -> None:
    poses = [
        look_at((3.0 * np.cos(a), 3.0 * np.sin(a), 1.0), (0.0, 0.0, 0.0))
        for a in np.linspace(-0.8, 0.8, 9)
    ]
    cameras = camera_path(tiny_scene([*poses, poses[4]]), "orbit", 60)
    angles = np.arctan2(*positions(cameras).T[1::-1])
    assert angles.min() == pytest.approx(-0.8, abs=0.01)
    assert angles.max() == pytest.approx(0.8, abs=0.01)
    assert_smooth(cameras[:30])


def test_through_passes_every_camera_in_order() -> None:
    scene = walk()
    places = positions(camera_path(scene, "through", 600))
    wanted = positions(scene.training_cameras)
    distances = np.linalg.norm(places[:, None] - wanted[None], axis=2)
    assert distances.min(axis=0).max() < 0.02
    assert (np.diff(distances.argmin(axis=0)) > 0).all()


def test_through_goes_by_the_numbers_in_names() -> None:
    """A walk whose views are in the order of letters: 0, 1, 10, 11, ..., 2, 20, ..."""
    scene = walk(60)
    scene = replace(scene, splits={"train": tuple(range(60))})
    names = [str(number) for number in range(len(scene.views))]
    order = sorted(range(len(names)), key=lambda index: names[index])
    views = [replace(scene.views[index], name=names[index]) for index in order]
    by_letters = replace(scene, views=views)
    in_order = [replace(view, name=f"{k:03}") for k, view in enumerate(scene.views)]
    np.testing.assert_array_equal(
        positions(camera_path(by_letters, "through", 60)),
        positions(camera_path(replace(scene, views=in_order), "through", 60)),
    )


def test_through_goes_at_even_speed_however_far_cameras_are_apart() -> None:
    """Turning counts as well as moving does."""
    at = np.cumsum([0.0, 0.1, 0.1, 0.1, 1.5, 1.5, 0.1, 0.1, 1.0, 0.2])
    turned = 0.1 * np.arange(10.0)
    scene = tiny_scene(
        [
            look_at((x, 0.0, 1.0), (x + np.sin(a), np.cos(a), 1.0))
            for x, a in zip(at, turned, strict=True)
        ]
    )
    poses = np.array([camera.c2w for camera in camera_path(scene, "through", 300)])
    moved, spun = np.diff(poses[:, :, 3], axis=0), np.diff(poses[:, :, :3], axis=0)
    steps = np.hypot(
        np.linalg.norm(moved, axis=1),
        scene.content_distance * np.linalg.norm(spun, axis=(1, 2)) / 2**0.5,
    )
    assert steps.max() < 1.05 * steps.min()
    assert np.linalg.norm(moved, axis=1).max() > 3.0 * np.linalg.norm(moved, axis=1).min()


def test_cameras_in_no_order_are_visited_from_neighbour_to_neighbour() -> None:
    poses = ring(40)
    shuffled = [poses[i] for i in np.random.default_rng(0).permutation(40)]
    places = positions(camera_path(tiny_scene([*shuffled, poses[0]]), "through", 900))
    length = np.linalg.norm(np.diff(places, axis=0), axis=1).sum()
    assert length < 2.5 * 2.0 * np.pi * 3.0  # in the given order it is 24 times round


def test_back_begins_at_the_cameras_and_ends_behind_them() -> None:
    scene = walk()
    through = camera_path(scene, "through", 100)
    back = camera_path(scene, "back", 100, distance=2.0)
    offsets = positions(back) - positions(through)
    backward = np.array([-camera.forward for camera in through])
    along = (offsets * backward).sum(axis=1)
    np.testing.assert_allclose(offsets, along[:, None] * backward, atol=1e-12)
    assert along[0] == 0.0
    assert along[-1] == pytest.approx(2.0)
    assert (np.diff(along) > 0.0).all()
    default = positions(camera_path(scene, "back", 100)) - positions(through)
    assert np.linalg.norm(default[-1]) == pytest.approx(0.5 * scene.content_distance)


def test_backing_away_keeps_the_direction() -> None:
    camera = camera_at(ring(1)[0])
    cameras = backing_away(camera, 1.5, 5)
    np.testing.assert_array_equal(cameras[0].c2w, camera.c2w)
    np.testing.assert_allclose(cameras[-1].position, camera.position - 1.5 * camera.forward)
    for other in cameras:
        np.testing.assert_array_equal(other.c2w[:, :3], camera.c2w[:, :3])


def test_the_natural_path() -> None:
    assert natural_path(tiny_scene(ring(8))) == "orbit"
    assert natural_path(walk()) == "through"
    scene = walk()
    chosen, named = camera_path(scene, None, 9), camera_path(scene, "through", 9)
    np.testing.assert_array_equal(positions(chosen), positions(named))


def test_the_lens_sees_along_the_shorter_side_what_the_photographs_see() -> None:
    scene = tiny_scene(ring(4), width=30, height=40, fx=60.0, fy=60.0, k1=0.1, cx=3.0)
    lens = path_lens(scene.training_cameras, (160, 90))
    assert (lens.width, lens.height) == (160, 90)
    assert lens.height / lens.fy == pytest.approx(30 / 60.0)
    assert (lens.fx, lens.cx, lens.cy, lens.k1) == (lens.fy, 80.0, 45.0, 0.0)
    own = camera_path(scene, "orbit", 3)[0]
    assert (own.width, own.height) == (30, 40)


@pytest.mark.parametrize(
    ("angle", "seen"), [(30.0, 30.0), (44.0, 44.0), (60.0, 45.0), (89.0, 45.0)]
)
def test_through_a_fisheye_a_path_sees_ninety_degrees_at_most(angle: float, seen: float) -> None:
    """Half of the shorter side is that angle away from the axis."""
    focal = 3.0 / np.radians(angle)
    scene = tiny_scene(ring(4), fx=focal, fy=focal, fisheye=True)
    lens = path_lens(scene.training_cameras, None)
    assert np.degrees(np.arctan(0.5 * lens.height / lens.fy)) == pytest.approx(seen)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"kind": "spiral"}, "kind must be one of orbit, through, back"),
        ({"n_frames": 0}, "number of frames"),
        ({"size": (0, 5)}, "the width"),
        ({"size": (5, 90000)}, "at most 8000"),
        ({"distance": float("nan")}, "distance of the path"),
    ],
)
def test_what_makes_no_path_is_refused(options: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        camera_path(tiny_scene(ring(5)), **{"kind": "through", "n_frames": 5, **options})
