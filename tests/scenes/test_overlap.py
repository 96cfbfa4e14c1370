"""How many cameras see the same, and how far gradients are scaled for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_scenes import camera_at, ring, tiny_scene
from warpnerf import GridConfig, TrainConfig
from warpnerf.scenes.cameras.overlap import in_picture, overlap_along_rays, views_of_content
from warpnerf.scenes.scene import Scene
from warpnerf.training.extent import content_distances


def test_cameras_back_to_back_share_nothing() -> None:
    ahead, behind = np.eye(3, 4), np.eye(3, 4)
    behind[:, :3] = np.diag([-1.0, 1.0, -1.0])
    cameras = [camera_at(ahead), camera_at(behind)]
    assert views_of_content(cameras, np.full(2, 2.0)) == 1.0
    assert views_of_content([*cameras, cameras[0], cameras[0]], np.full(4, 2.0)) == 3.0


@pytest.mark.parametrize("n_cameras", [5, 200])
def test_cameras_around_a_thing_all_see_it(n_cameras: int) -> None:
    cameras = [camera_at(pose) for pose in ring(n_cameras, radius=4.0)]
    assert views_of_content(cameras, np.full(n_cameras, 4.0)) == n_cameras
    # what is right before one is not in the pictures of all others
    assert views_of_content(cameras, np.full(n_cameras, 0.5)) < 0.7 * n_cameras


@pytest.mark.parametrize("fisheye", [False, True])
@pytest.mark.parametrize("size", [(64, 48), (33, 7), (1, 1)])
def test_what_a_camera_looks_at_is_in_its_picture(fisheye: bool, size: tuple[int, int]) -> None:
    width, height = size
    lens = {"fx": 0.8 * width, "fy": 0.9 * width, "cx": 0.4 * width, "cy": 0.6 * height}
    pose = ring(3, radius=2.0)[1]
    camera = camera_at(pose, width=width, height=height, **lens)
    assert views_of_content([replace(camera, fisheye=fisheye)] * 2, np.ones(2)) == 2.0


def test_a_fisheye_sees_farther_aside() -> None:
    camera = camera_at(np.eye(3, 4), width=64, height=64, fx=32.0, fy=32.0, cx=32.0, cy=32.0)
    fisheye = replace(camera, fisheye=True)
    angles = np.array([0.0, 0.7, 0.9, 1.1])  # 45 degrees are 0.785, 1 of a fisheye is at the rim
    points = np.stack([np.sin(angles), np.zeros(4), -np.cos(angles)], axis=1)
    assert in_picture(camera, points).tolist() == [True, True, False, False]
    assert in_picture(fisheye, points).tolist() == [True, True, True, False]
    assert not in_picture(camera, -points).any()


def in_circle(n_cameras: int, turned: float) -> Scene:
    """Cameras in a circle at one height, turned from its middle by so many degrees."""
    angle = np.radians(turned)
    around = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    poses = ring(n_cameras + 1, radius=4.0, height=0.0)  # the last is for testing
    for pose in poses:
        pose[:3, :3] = around @ pose[:3, :3]
    return replace(
        tiny_scene(poses), content_distance=4.0, content_distances=np.full(n_cameras + 1, 4.0)
    )


def test_where_many_see_the_same_gradients_are_scaled_less_far() -> None:
    """By how many do: at least half as far, and 0.7 where they look at one thing."""
    auto = TrainConfig(model="rgb", grid=GridConfig(voxels=8**3))
    shares = []
    for n_cameras in (8, 50, 200):
        scene = in_circle(n_cameras, 60.0)
        cameras = scene.training_cameras
        seen_by = views_of_content(cameras, np.full(n_cameras, 4.0))
        one, each = content_distances(scene, auto)
        shares.append(each[0] / 4.0)
        assert one == 4.0 and each == [each[0]] * n_cameras
        assert shares[-1] == pytest.approx(np.clip(7.0 / seen_by, 0.5, 1.0))
        one_thing, unknown = in_circle(n_cameras, 0.0), replace(scene, content_distances=None)
        each = content_distances(one_thing, auto)[1]
        seen_by = views_of_content(one_thing.training_cameras, np.full(n_cameras, 4.0))
        assert each == pytest.approx([4.0 * np.clip(7.0 / seen_by, 0.7, 1.0)] * n_cameras)
        assert content_distances(unknown, auto)[1] == [4.0] * n_cameras
        own = replace(auto, content_distance="per-camera")
        assert content_distances(scene, own)[1] == [4.0] * n_cameras
        assert content_distances(scene, replace(auto, content_distance=3.0))[1] == [3.0] * n_cameras
    assert shares[0] == 1.0 and 0.5 < shares[1] < 1.0 and shares[-1] == 0.5
    assert each[0] == pytest.approx(0.7 * 4.0)


def test_overlap_along_rays_of_two_cameras_side_by_side() -> None:
    """Close to them each sees its own; far away both see all, and rays thin out by the square."""
    lens = {"width": 40, "height": 30, "fx": 40.0, "fy": 40.0, "cx": 20.0, "cy": 15.0}
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 1.0
    found = overlap_along_rays([camera_at(pose, **lens) for pose in poses], 1.0)
    assert found.distances[[0, -1]] == pytest.approx([0.01, 100.0])
    assert found.cameras[0] == 1.0 and found.cameras[-1] == 2.0
    assert (np.diff(found.cameras) >= 0.0).all()
    scaled = found.density * found.distances**2 / 40.0**2
    assert scaled[0] == pytest.approx(1.0) and scaled[-1] == pytest.approx(2.0, rel=0.02)
