"""What the cameras alone say about a scene's extent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from tests.support.tiny_scenes import camera_at, look_at, ring
from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import (
    UNBOUNDED_BOX_SHARE,
    estimate_extent,
    far_off,
    find_focus,
    share_aimed_at,
    up_direction,
    upside_down,
)


def cameras_at(poses: list[np.ndarray]) -> list[Camera]:
    return [camera_at(pose) for pose in poses]


def outward(poses: list[np.ndarray]) -> list[np.ndarray]:
    """The same places, looking the other way."""
    return [pose @ np.diag([-1.0, 1.0, -1.0, 1.0]) for pose in poses]


def test_focus_is_where_all_axes_meet() -> None:
    target = (1.0, -2.0, 0.5)
    positions = [(4.0, 0.0, 1.0), (0.0, 3.0, 2.0), (-3.0, -2.0, 0.0), (1.0, -6.0, 4.0)]
    cameras = cameras_at([look_at(position, target) for position in positions])
    focus = find_focus(cameras)
    np.testing.assert_allclose(focus.point, target, atol=1e-12)
    distances = [np.linalg.norm(np.subtract(position, target)) for position in positions]
    assert focus.distance == pytest.approx(np.median(distances))


def test_focus_minimises_squared_distance_to_the_axes() -> None:
    random = np.random.default_rng(0)
    poses = [
        look_at(tuple(random.normal([0.0, 0.0, 5.0], 3.0)), tuple(random.normal(size=3)))
        for _ in range(12)
    ]
    cameras = cameras_at(poses)

    def cost(point: np.ndarray) -> float:
        return sum(
            np.sum(np.cross(camera.forward, point - camera.position) ** 2) for camera in cameras
        )

    focus = find_focus(cameras).point
    assert cost(focus) > 0.1
    for shift in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert cost(focus + shift) > cost(focus)


def test_extent_moves_and_scales_with_the_cameras() -> None:
    poses = ring(7)
    moved = [pose.copy() for pose in poses]
    for pose in moved:
        pose[:3, 3] = 10.0 * pose[:3, 3] + [100.0, -50.0, 7.0]
    before = estimate_extent(cameras_at(poses), unbounded=True)
    after = estimate_extent(cameras_at(moved), unbounded=True)
    assert after.content_distance == pytest.approx(10.0 * before.content_distance)
    np.testing.assert_allclose(after.box_min, 10.0 * before.box_min + [100.0, -50.0, 7.0])


def test_box_of_an_object_is_what_the_larger_field_of_view_spans() -> None:
    cameras = [camera_at(pose, width=8, fx=8.0, height=30, fy=10.0) for pose in ring(5)]
    extent = estimate_extent(cameras, unbounded=False)
    np.testing.assert_allclose(extent.box_max, np.sqrt(10.0) * 1.5)
    np.testing.assert_allclose(extent.box_min, -np.sqrt(10.0) * 1.5)


def test_box_of_photographs_is_a_share_of_the_content_distance() -> None:
    extent = estimate_extent(cameras_at(ring(5)), unbounded=True)
    np.testing.assert_allclose(extent.box_max, np.sqrt(10.0) * UNBOUNDED_BOX_SHARE)
    np.testing.assert_allclose(extent.box_min, -np.sqrt(10.0) * UNBOUNDED_BOX_SHARE)


def test_cameras_that_look_outward_fall_back_to_their_spread() -> None:
    focus = find_focus(cameras_at(outward(ring(8, height=0.0))))
    np.testing.assert_allclose(focus.point, 0.0, atol=1e-12)
    assert focus.distance == pytest.approx(3.0)
    assert "look outward" in focus.how


def test_cameras_that_turn_nearly_in_place_fall_back_to_their_spread() -> None:
    random = np.random.default_rng(1)
    poses = ring(30)
    for pose in poses:
        pose[:3, 3] = random.normal(0.0, 0.01, 3)
    focus = find_focus(cameras_at(poses))
    assert focus.distance == pytest.approx(0.015, rel=0.3)
    assert "look outward" in focus.how


def test_parallel_cameras_fall_back_to_their_spread() -> None:
    poses = [np.eye(4) for _ in range(3)]
    for i, pose in enumerate(poses):
        pose[0, 3] = 3.0 * i
    focus = find_focus(cameras_at(poses))
    assert focus.distance == pytest.approx(2.0)
    np.testing.assert_allclose(focus.point, [3.0, 0.0, -2.0])
    assert "parallel" in focus.how


def strip(n: int, aim: Callable[[float], tuple[float, float]]) -> list[Camera]:
    """Along y, looking at a wall 3 away, each as far aside and upward as it is told."""
    poses = []
    for y in np.linspace(-1.9, 1.9, n):
        aside, up = aim(float(y))
        poses.append(look_at((3.0, y, 1.3), (0.0, y + aside, 1.0 + up)))
    return cameras_at(poses)


def at_random(seed: int, sway: float) -> Callable[[float], tuple[float, float]]:
    draw = np.random.default_rng(seed).uniform
    return lambda _: (draw(-sway, sway), draw(-sway, sway))


@pytest.mark.parametrize("degrees", [0.7, 1.0, 2.0, 5.0, 10.0])
def test_nearly_parallel_axes_have_no_focus(degrees: float) -> None:
    """Least squares finds one where every camera has it in the middle of its image: far off."""
    sway = 3.0 * np.tan(np.radians(degrees))
    wavy = find_focus(strip(35, lambda y: (sway * np.sin(3.0 * y), 0.0)))
    assert wavy.guessed and "parallel directions" in wavy.how
    for seed in range(20):
        focus = find_focus(strip(35, at_random(seed, sway)))
        assert focus.guessed and "parallel directions" in focus.how
        assert focus.distance == pytest.approx(0.98, abs=0.02)  # the cameras' spread


def test_axes_that_point_anywhere_far_from_the_origin_have_no_focus() -> None:
    cameras = strip(35, lambda y: (0.1 * np.sin(3.0 * y), 0.0))
    for camera in cameras:
        camera.c2w[:, 3] += [500.0, 900.0, 70.0]
    assert find_focus(cameras).guessed


def test_a_survey_of_nadir_photographs_has_no_focus() -> None:
    """A grid of cameras that look down, tilted by some degrees as drones are."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        poses = []
        for x in np.linspace(-40.0, 40.0, 6):
            for y in np.linspace(-60.0, 60.0, 9):
                lean = random.normal(0.0, 3.0, 2)
                poses.append(look_at((x, y, 50.0), (x + lean[0], y + lean[1], 0.0)))
        assert find_focus(cameras_at(poses)).guessed


def test_cameras_behind_each_other_have_no_focus() -> None:
    random = np.random.default_rng(0)
    poses = []
    for y in np.linspace(0.0, 20.0, 30):
        x, z = random.normal(0.0, 0.1, 2)
        poses.append(look_at((x, y, z), (x + random.normal(0.0, 0.3), y + 9.0, z)))
    assert find_focus(cameras_at(poses)).guessed


@pytest.mark.parametrize("away", [5.0, 12.0])
def test_axes_that_do_meet_are_believed_at_small_angles(away: float) -> None:
    """By hand, a tenth of the spread off."""
    random = np.random.default_rng(0)
    poses = []
    for x in np.linspace(-1.0, 1.0, 5):
        for z in np.linspace(-1.0, 1.0, 4):
            off = random.normal(0.0, 0.1, 2)
            poses.append(look_at((x, -away, z), (off[0], 0.0, off[1])))
    focus = find_focus(cameras_at(poses))
    assert not focus.guessed
    assert focus.distance == pytest.approx(away, rel=0.1)


@pytest.mark.parametrize("place", [(120.0, 0.0, 1.0), (-4e5, -5e6, 0.0)])
def test_a_few_cameras_far_away_from_all_others_do_not_count(place: tuple[float, ...]) -> None:
    """As one that was posed wrongly, or not at all among georeferenced ones."""
    inward = cameras_at(ring(9))
    lost = camera_at(look_at((3.0, 1.0, 2.0), (0.0, 0.0, 0.0)))
    lost.c2w[:, 3] = place
    assert far_off([lost, *inward]).tolist() == [True, *9 * [False]]
    for cameras in (inward, cameras_at(outward(ring(9)))):
        alone, found = find_focus(cameras), find_focus([lost, *cameras])
        np.testing.assert_array_equal(found.point, alone.point)
        assert (found.distance, found.how) == (alone.distance, alone.how)


def test_cameras_far_away_count_where_they_are_many_or_the_others_are_in_one_place() -> None:
    """Two places, and a tripod with some photographs from elsewhere."""
    elsewhere = cameras_at(outward(ring(2, radius=90.0)))
    several = cameras_at(outward(ring(5, radius=0.1, height=0.0)))
    assert find_focus([*elsewhere, *several]).distance > 1.0
    assert find_focus([*elsewhere, *8 * several[:1]]).distance > 1.0


def test_notes_say_how() -> None:
    notes = estimate_extent(cameras_at(ring(5)), unbounded=True).notes
    assert notes[0] == (
        "content distance 3.16: median depth of the point that the training cameras look at"
    )
    assert notes[1].startswith("box of edge 4.74: 0.75 of the content distance")


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_cameras_are_refused(n: int) -> None:
    with pytest.raises(InputError, match=f"at least 2 training cameras, not {n}"):
        find_focus(cameras_at(ring(n)))


@pytest.mark.parametrize("place", [[0.0, 0.0, 0.0], [3.0, 1e6, 2.0]])
def test_cameras_at_one_point_are_refused(place: list[float]) -> None:
    poses = ring(5)
    for pose in poses:
        pose[:3, 3] = place
    with pytest.raises(InputError, match="all training cameras are at one point"):
        find_focus(cameras_at(poses))


def test_cameras_too_far_from_the_origin_are_refused() -> None:
    poses = ring(5)
    for pose in poses:
        pose[:3, 3] += [5e5, 4e6, 100.0]
    with pytest.raises(InputError, match=r"4e\+06 from the origin .* subtract their mean"):
        find_focus(cameras_at(poses))


def test_up_is_found_in_upright_photographs_that_all_look_down() -> None:
    """From one side only, the mean of the cameras' own up axes is tilted."""
    poses = [look_at((3.0 * np.cos(a), 3.0 * np.sin(a), 3.0), (0.0, 0.0, 0.0)) for a in (0, 0.5, 1)]
    cameras = cameras_at(poses)
    mean = np.mean([camera.c2w[:, 1] for camera in cameras], axis=0)
    assert mean[2] / np.linalg.norm(mean) < 0.9
    np.testing.assert_allclose(up_direction(cameras), [0.0, 0.0, 1.0], atol=1e-9)


def test_up_turns_with_the_scene() -> None:
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    poses = [np.concatenate([turn @ pose[:3], [[0.0, 0.0, 0.0, 1.0]]]) for pose in ring(9)]
    np.testing.assert_allclose(up_direction(cameras_at(poses)), turn[:, 2], atol=1e-9)


def test_up_is_the_cameras_own_where_nothing_else_tells() -> None:
    poses = [look_at((3.0, 0.0, 1.0), (0.0, 0.0, 0.0)), look_at((4.0, 0.0, 2.0), (1.0, 0.0, 1.0))]
    camera, other = cameras_at(poses)
    np.testing.assert_allclose(up_direction([camera, other]), camera.c2w[:, 1], atol=1e-9)
    rolled = cameras_at([pose @ np.diag([-1.0, -1.0, 1.0, 1.0]) for pose in poses])
    np.testing.assert_array_equal(up_direction([camera, rolled[0]]), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("part", [range(6), range(0, 12, 2), range(2, 5), range(4)])
def test_cameras_upside_down_are_the_fewer(part: range) -> None:
    """Of as many each, either."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    poses = [pose @ flip if k in part else pose for k, pose in enumerate(ring(12))]
    found = set(np.flatnonzero(upside_down(cameras_at(poses))).tolist())
    others = set(range(12)) - set(part)
    assert found == set(part) or (len(part) == 6 and found == others)


def test_no_camera_of_a_drone_that_flies_to_and_fro_is_upside_down() -> None:
    for pitch in (0.0, 15.0, 30.0):
        a = np.radians(pitch)
        tilt = np.eye(4)
        tilt[1:3, 1:3] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        turn = np.diag([-1.0, -1.0, 1.0, 1.0])
        poses = [(turn if k // 3 % 2 else np.eye(4)) @ tilt for k in range(24)]
        assert not upside_down(cameras_at(poses)).any()


def test_share_of_cameras_aimed_at_a_point() -> None:
    cameras = cameras_at(ring(4))
    assert share_aimed_at(cameras, np.zeros(3)) == 1.0
    away = cameras_at(outward(ring(4)))
    assert share_aimed_at([*cameras, *away], np.zeros(3)) == 0.5
    edge = cameras[0].position + cameras[0].forward + 0.3 * cameras[0].c2w[:, 0]  # of 0.4 seen
    assert share_aimed_at(cameras[:1], edge) == 0.0
    inner = cameras[0].position + cameras[0].forward + 0.15 * cameras[0].c2w[:, 0]
    assert share_aimed_at(cameras[:1], inner) == 1.0
