"""Axes of poses, and axes and units of points, by what photographs of a room show."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_points import write_ply
from tests.support.tiny_scenes import DATA, camera_at, look_at, needs_capture, picture, ring
from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import upside_down
from warpnerf.scenes.cameras.quaternions import quaternions, rotations
from warpnerf.scenes.extent import photo_consistency
from warpnerf.scenes.extent.conventions import _fit_all, _is_proved, check_against_photographs
from warpnerf.scenes.extent.photo_consistency import (
    FEWEST,
    Agreement,
    PhotoConsistency,
    neighbours,
)
from warpnerf.scenes.extent.points import Points
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import View

SIZE = {"width": 96, "height": 72, "fx": 75.0, "fy": 75.0, "cx": 48.0, "cy": 36.0}
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def outward(n: int) -> list[Camera]:
    """From the middle of the room to all sides."""
    cameras = []
    for k in range(n):
        a = 2.0 * np.pi * k / n + 0.2
        eye = np.array([0.15 + 0.45 * np.cos(a), 0.5 * np.sin(a), 1.35 + 0.15 * np.sin(3.0 * a)])
        target = eye + np.array([np.cos(a), np.sin(a), (-0.3, 0.1)[k % 2]])
        cameras.append(camera_at(look_at(tuple(eye), tuple(target)), **SIZE))
    return cameras


def along_a_wall(n: int) -> list[Camera]:
    """Nearly parallel: two degrees to and fro."""
    return [
        camera_at(look_at((1.3, y, 1.3), (-1.5, y + 0.1 * np.sin(3.0 * y), 0.7)), **SIZE)
        for y in np.linspace(-1.9, 1.9, n)
    ]


def photographed(cameras: list[Camera]) -> list[View]:
    return [
        View(name=f"{k:03d}", camera=camera, image=photograph(camera, 1)[0])
        for k, camera in enumerate(cameras)
    ]


def surface(cameras: list[Camera], each: int = 40) -> Points:
    """Where rays of random pixels meet the room."""
    rng = np.random.default_rng(0)
    found = []
    for c in cameras:
        x, y = rng.uniform(-0.6, 0.6, each), rng.uniform(-0.45, 0.45, each)
        rays = np.stack([x, y, -np.ones(each)], axis=1) @ c.c2w[:, :3].T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        far = first_hit(np.repeat(c.position[None], each, 0), rays)
        found.append(c.position + far[:, None] * rays)
    return Points(positions=np.concatenate(found), tracks=None, source="points.ply")


@pytest.fixture(scope="module")
def room() -> list[View]:
    return photographed(outward(20))


@pytest.fixture(scope="module")
def wall() -> list[View]:
    return photographed(along_a_wall(24))


@pytest.fixture
def few_references(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half as many photographs are looked at, where many cases ask the same of one scene."""
    monkeypatch.setattr(photo_consistency, "REFERENCES", 6)


def misread(views: list[View], as_written: Callable[[np.ndarray], np.ndarray]) -> list[View]:
    """Views whose poses [4, 4] stand otherwise in their file."""
    return [
        view.posed(as_written(np.concatenate([view.camera.c2w, [[0.0, 0.0, 0.0, 1.0]]]))[:3])
        for view in views
    ]


def held(views: list[View], points: Points | None = None) -> tuple[list[View], Points | None, str]:
    found, _, left, said = check_against_photographs(views, range(len(views)), points, False)
    return found, left, "; ".join(said)


def with_w_first(m: np.ndarray) -> np.ndarray:
    """World to camera in OpenCV axes, its quaternion x, y, z, w read as w, x, y, z."""
    to_camera = np.linalg.inv(m @ FLIP)
    x_first = np.roll(quaternions(to_camera[None, :3, :3]), -1, axis=1)
    to_camera[:3, :3] = rotations(x_first)[0]
    return np.asarray(np.linalg.inv(to_camera) @ FLIP)


def with_positions(m: np.ndarray) -> np.ndarray:
    """World to camera in OpenCV axes, with the camera's position where its translation belongs."""
    to_camera = np.linalg.inv(m @ FLIP)
    to_camera[:3, 3] = m[:3, 3]
    return np.asarray(np.linalg.inv(to_camera) @ FLIP)


WRITTEN = {
    "camera to world in OpenCV": lambda m: m @ FLIP,
    "world to camera in OpenCV": lambda m: np.linalg.inv(m @ FLIP),
    "world to camera in OpenGL": np.linalg.inv,
    "PyTorch3D's": lambda m: m @ np.diag([-1.0, 1.0, -1.0, 1.0]),
    "x left, y down, looking along -z": lambda m: m @ np.diag([-1.0, -1.0, 1.0, 1.0]),
    "LLFF's": lambda m: m[:, [1, 0, 2, 3]] * [-1.0, 1.0, 1.0, 1.0],
    "x up, y left": lambda m: m[:, [1, 0, 2, 3]] * [1.0, -1.0, 1.0, 1.0],
    "in OpenCV axes, in place of LLFF's": lambda m: m[:, [1, 0, 2, 3]] * [-1.0, -1.0, -1.0, 1.0],
    "quaternions that end with w": with_w_first,
    "left-handed axes as of Unity": lambda m: (
        np.diag([1.0, 1.0, -1.0, 1.0]) @ m @ np.diag([1.0, 1.0, -1.0, 1.0])
    ),
    "positions of cameras in place of translations": with_positions,
}


@pytest.mark.usefixtures("few_references")
def test_poses_that_fit_stay(room: list[View], wall: list[View]) -> None:
    for views in (room, wall):
        found, points, said = held(views)
        assert said == "" and points is None
        assert all(a is b for a, b in zip(found, views, strict=True))


@pytest.mark.ci
@pytest.mark.usefixtures("few_references")
@pytest.mark.parametrize("name", WRITTEN)
def test_poses_in_other_axes_are_read_as_the_photographs_show(name: str, room: list[View]) -> None:
    found, _, said = held(misread(room, WRITTEN[name]))
    assert said.startswith("poses are read as ") and name in said and "photographs fit" in said
    turned = {"x left, y down, looking along -z": 180, "LLFF's": 90, "x up, y left": 90}.get(name)
    assert ("unless the photographs were turned" in said) == (turned is not None)
    assert turned is None or f"turned by {turned} degrees" in said
    for view, right in zip(found, room, strict=True):
        np.testing.assert_allclose(view.camera.c2w, right.camera.c2w, atol=1e-12)


PARTS = {
    "half": range(10, 20),
    "every other": range(0, 20, 2),
    "most": range(6, 20),
    "five": range(4, 9),
}


@pytest.mark.ci
@pytest.mark.parametrize("part", PARTS)
def test_a_part_in_opencv_axes_is_read_as_the_photographs_show(part: str, room: list[View]) -> None:
    """Every other one was taken for all."""
    wrong = misread(room, WRITTEN["camera to world in OpenCV"])
    views = [wrong[k] if k in PARTS[part] else view for k, view in enumerate(room)]
    found, _, said = held(views)
    assert said.startswith(
        f"poses of {len(PARTS[part])} of 20 images (first: {PARTS[part][0]:03d}) are read as "
        "camera to world in OpenCV axes"
    )
    for view, right in zip(found, room, strict=True):
        np.testing.assert_allclose(view.camera.c2w, right.camera.c2w, atol=1e-12)


@pytest.mark.ci
def test_a_folder_in_other_axes_is_read_as_the_photographs_show(room: list[View]) -> None:
    wrong = misread(room, WRITTEN["world to camera in OpenCV"])
    views = [
        replace(wrong[k], name=f"second/{k}.png") if k % 3 == 0 else view
        for k, view in enumerate(room)
    ]
    found, _, said = held(views)
    assert "poses of 7 of 20 images (first: second/0.png) are read as world to camera" in said
    for view, right in zip(found, room, strict=True):
        np.testing.assert_allclose(view.camera.c2w, right.camera.c2w, atol=1e-12)


@pytest.mark.ci
def test_a_drone_whose_half_looks_up_is_read_as_the_photographs_show() -> None:
    """Of cameras that look down, turned in all ways, none stands on its head."""
    poses = []
    for k in range(20):
        pose, a = np.eye(4), 2.4 * k
        pose[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
        pose[:3, 3] = (-0.9 + 0.45 * (k % 5), -1.2 + 0.8 * (k // 5), 2.3)
        poses.append(pose)
    down = photographed([camera_at(pose, **SIZE) for pose in poses])
    wrong = misread(down, WRITTEN["camera to world in OpenCV"])
    assert held(down)[2] == ""
    found, _, said = held(down[:10] + wrong[10:])
    assert "poses of 10 of 20 images (first: 010) are read as camera to world in OpenCV" in said
    np.testing.assert_allclose(found[15].camera.c2w, down[15].camera.c2w, atol=1e-12)


def test_a_part_along_a_wall_is_never_taken_for_all(wall: list[View]) -> None:
    """Half of it fits in both axes, and stays; that it stands on its head is said elsewhere."""
    wrong = misread(wall, WRITTEN["camera to world in OpenCV"])
    found, _, said = held([*wrong[:12], *wall[12:]])
    assert said == "" and found[5] is wrong[5] and found[20] is wall[20]
    assert upside_down([view.camera for view in found]).tolist() == 12 * [True] + 12 * [False]
    found, _, said = held([wrong[k] if k % 2 == 0 else view for k, view in enumerate(wall)])
    assert "poses of 12 of 24 images (first: 000) are read as" in said
    np.testing.assert_allclose(found[4].camera.c2w, wall[4].camera.c2w, atol=1e-12)


@pytest.mark.ci
def test_a_part_that_no_reading_fits_whole_stays(wall: list[View]) -> None:
    """Of every third photograph of a wall those were read in axes as of Unity."""
    wrong = misread(wall, WRITTEN["camera to world in OpenCV"])
    given = [wrong[k] if k % 3 == 0 else view for k, view in enumerate(wall)]
    found, _, said = held(given)
    assert "are read as" not in said
    assert all(one is other for one, other in zip(found, given, strict=True))


def test_a_part_is_proved_by_nearly_every_reference_and_by_the_whole() -> None:
    def agreement(gain: list[float]) -> Agreement:
        chance = np.full(len(gain), 0.1)
        return Agreement(found=gain + chance, by_chance=chance, of=np.arange(len(gain)))

    given = agreement(12 * [0.0])
    assert _is_proved(given, agreement(11 * [0.3] + [0.0]))
    assert not _is_proved(given, agreement(9 * [0.3] + 3 * [0.01]))
    assert not _is_proved(agreement(10 * [0.0] + 2 * [0.4]), agreement(12 * [0.3]))
    assert _fit_all(agreement(10 * [0.3] + 2 * [0.0]))
    assert not _fit_all(agreement(9 * [0.3] + 3 * [0.0]))
    assert not _fit_all(agreement(12 * [0.06]))


def test_opencv_axes_along_a_wall_are_told_by_photographs_alone(wall: list[View]) -> None:
    """Pairs of nearly parallel cameras fit in either axes; what depths they tell does not."""
    found, _, said = held(misread(wall, WRITTEN["camera to world in OpenCV"]))
    assert "camera to world in OpenCV axes" in said
    np.testing.assert_allclose(found[3].camera.c2w, wall[3].camera.c2w, atol=1e-12)


def test_points_tell_axes_where_photographs_are_too_small() -> None:
    views = [
        View(name=str(k), camera=camera_at(pose @ FLIP), image=picture(k))
        for k, pose in enumerate(ring(8))
    ]
    ball = np.random.default_rng(0).normal(size=(300, 3))
    ball = 0.3 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    found, points, said = held(views, Points(positions=ball, tracks=None, source=""))
    assert "OpenCV axes" in said and "points fit" in said and points is not None
    np.testing.assert_allclose(found[1].camera.c2w, ring(8)[1][:3], atol=1e-12)


@pytest.mark.usefixtures("few_references")
@pytest.mark.parametrize(
    ("written", "read"),
    [
        (lambda p: p, ""),
        (lambda p: p * [1.0, 1.0, -1.0], "(x, y, -z)"),
        (lambda p: p[:, [0, 2, 1]] * [1.0, 1.0, -1.0], "(x, -z, y)"),
        (lambda p: p[:, [1, 0, 2]] * [1.0, 1.0, -1.0], "(y, x, -z)"),
        (lambda p: 1000.0 * p, "0.001 (x, y, z)"),
        (lambda p: 100.0 * p[:, [0, 2, 1]] * [1.0, 1.0, -1.0], "0.01 (x, -z, y)"),
    ],
)
def test_points_in_other_axes_or_units_come_to_the_cameras(
    written: Callable[[np.ndarray], np.ndarray], read: str, room: list[View]
) -> None:
    right = surface([view.camera for view in room])
    found, points, said = held(room, replace(right, positions=written(right.positions)))
    assert found[0] is room[0] and points is not None
    assert (f"points of points.ply are read as {read}: " in said) if read else said == ""
    np.testing.assert_allclose(points.positions, right.positions, atol=1e-9)


TURN = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]


@pytest.mark.usefixtures("few_references")
@pytest.mark.parametrize(
    "wrong",
    [
        lambda p: 1.4 * p,
        lambda p: 0.3 * p,
        lambda p: 1e-5 * p,
        lambda p: p + np.array([2.0, 1.0, 0.5]),
        lambda p: p + np.array([500.0, 900.0, 0.0]),
        lambda p: p.mean(axis=0) + p.std(axis=0) * np.random.default_rng(1).normal(size=p.shape),
    ],
)
def test_points_that_fit_in_no_way_are_left_out(
    wrong: Callable[[np.ndarray], np.ndarray], room: list[View]
) -> None:
    require_left_out(wrong, room)


@pytest.mark.ci
def test_turned_points_are_left_out(room: list[View]) -> None:
    require_left_out(lambda p: p @ TURN, room)


def require_left_out(wrong: Callable[[np.ndarray], np.ndarray], room: list[View]) -> None:
    right = surface([view.camera for view in room])
    _, points, said = held(room, replace(right, positions=wrong(right.positions)))
    assert points is None
    assert "points.ply are not used" in said and "export them together with the poses" in said
    tried = replace(right, positions=wrong(right.positions), tried=True)
    assert held(room, tried)[1:] == (None, "")


@pytest.mark.usefixtures("few_references")
def test_poses_and_points_may_both_be_in_other_axes(room: list[View]) -> None:
    right = surface([view.camera for view in room])
    views = misread(room, WRITTEN["world to camera in OpenCV"])
    found, points, said = held(views, replace(right, positions=1000.0 * right.positions))
    assert "world to camera in OpenCV" in said and "0.001 (x, y, z)" in said
    assert points is not None
    np.testing.assert_allclose(points.positions, right.positions, atol=1e-9)
    np.testing.assert_allclose(found[5].camera.c2w, room[5].camera.c2w, atol=1e-12)


@pytest.mark.usefixtures("few_references")
@pytest.mark.parametrize("bent", [{"k1": -0.2, "p1": 0.01}, {"k1": 0.05, "fisheye": True}])
def test_lenses_are_undone(bent: dict[str, Any], room: list[View]) -> None:
    """Photographs of such lenses, resampled from the pinhole's."""
    views = []
    for view in room:
        camera = replace(view.camera, **bent)
        u, v = np.meshgrid(np.arange(96) + 0.5, np.arange(72) + 0.5)
        straight = np.stack([u.ravel() - 48.0, v.ravel() - 36.0], axis=1) / 75.0
        pixels = np.floor(camera.distort(straight)[0] * 75.0 + [48.0, 36.0]).astype(int)
        image = np.zeros((72, 96, 3), np.uint8)
        inside = ((pixels >= 0) & (pixels < [96, 72])).all(axis=1)
        image[pixels[inside, 1], pixels[inside, 0]] = view.image.reshape(-1, 3)[inside]
        views.append(View(name=view.name, camera=camera, image=image))
    agreement = [PhotoConsistency.of(v).agreement for v in (views, room)]
    undone = [replace(v, camera=replace(v.camera, k1=0.0, p1=0.0, fisheye=False)) for v in views]
    without = PhotoConsistency.of(undone).agreement
    assert agreement[0].gain.mean() > 0.6 * agreement[1].gain.mean()
    assert agreement[0].found.mean() > without.found.mean() + 0.03


@pytest.mark.ci
def test_noise_and_few_or_small_photographs_tell_nothing() -> None:
    for n, scale in ((12, 6), (FEWEST - 1, 6), (12, 3)):
        size = {"width": 8 * scale, "height": 6 * scale}
        lens = {"fx": 10.0 * scale, "fy": 10.0 * scale, "cx": 4.0 * scale, "cy": 3.0 * scale}
        views = [
            View(
                name=str(k), camera=camera_at(pose @ FLIP, **size, **lens), image=picture(k, **size)
            )
            for k, pose in enumerate(ring(n))
        ]
        found, _, said = held(views)
        assert said == "" and found[0] is views[0]


def test_neighbours_stand_and_look_alike_but_not_quite() -> None:
    poses = np.array([pose[:3] for pose in ring(240)])
    assert set(neighbours(poses, 0)) <= {2, 3, 237, 238}  # 3 degrees and more
    assert set(neighbours(poses, 0, 0.5)) <= {7, 8, 232, 233}
    assert len(neighbours(np.repeat(poses[:1], 6, axis=0), 2)) == 3


def test_a_scene_file_is_read_in_the_right_axes(tmp_path: Path, room: list[View]) -> None:
    """transforms.json with OpenCV's axes and points in millimetres, against the right one."""
    right = surface([view.camera for view in room])
    found = []
    for turn, scale in ((np.eye(4), 1.0), (FLIP, 1000.0)):
        frames = []
        for view in room:
            Image.fromarray(view.image).save(tmp_path / f"{view.name}.png")
            pose = np.concatenate([view.camera.c2w, [[0.0, 0.0, 0.0, 1.0]]]) @ turn
            frames.append({"file_path": f"{view.name}.png", "transform_matrix": pose.tolist()})
        lens = {"w": 96, "h": 72, "fl_x": 75.0, "fl_y": 75.0, "cx": 48.0, "cy": 36.0}
        content = {**lens, "ply_file_path": "points.ply", "frames": frames}
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        write_ply(tmp_path / "points.ply", scale * right.positions)
        found.append(load_scene(tmp_path))
    assert not found[0].warnings and len(found[1].warnings) == 2
    assert found[1].content_distance == pytest.approx(found[0].content_distance, rel=1e-6)
    np.testing.assert_allclose(found[1].box_min, found[0].box_min, rtol=1e-6)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=needs_capture(name))
        for name in ("cup_colmap", "fox_q", "stitch", "lund_door", "fern_llff")
    ],
)
def test_captures_are_read_as_they_stand(name: str) -> None:
    scene = load_scene(DATA / name, images="files")
    assert not any("read as" in warning or "not used" in warning for warning in scene.warnings)
