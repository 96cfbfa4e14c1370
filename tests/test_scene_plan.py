"""The plan shows things where they are: up is up, and each in its colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_scenes import ring, tiny_scene

from warpnerf.evaluation.inspection import Inspection
from warpnerf.media.scene_plan import _BOX, _SIGHT_END, _TEST, _TRAIN, plan_picture

HEADER = 92


def inspection(poses: list[np.ndarray], up: tuple[float, float, float]) -> Inspection:
    return Inspection(
        contraction="none",
        scene=tiny_scene(poses),
        format="by hand",
        content_distance=1.0,
        up=np.array(up),
        focus=None,
        oddities=(),
        costs={},
    )


def places(picture: np.ndarray, colour: tuple[int, int, int], panel: int) -> np.ndarray:
    """Rows and columns of a colour within a panel, below the legend."""
    half = picture.shape[1] // 2
    part = picture[HEADER:, half * panel : half * (panel + 1)].astype(int)
    return np.argwhere(np.abs(part - colour).sum(axis=2) < 60)


@pytest.mark.parametrize("panel", [0, 1])
def test_everything_is_drawn(panel: int) -> None:
    picture = plan_picture(inspection(ring(7), (0.0, 0.0, 1.0)))
    assert picture.dtype == np.uint8
    for colour in (_TRAIN, _TEST, _BOX, _SIGHT_END):
        assert len(places(picture, colour, panel)) > 10


def test_from_above_x_is_right_and_y_is_up() -> None:
    east, north, west = (np.eye(4) for _ in range(3))
    east[:3, 3], north[:3, 3], west[:3, 3] = (3.0, 0.0, 0.0), (0.0, 3.0, 0.0), (-3.0, 0.0, 0.0)
    picture = plan_picture(inspection([east, west, north], (0.0, 0.0, 1.0)))
    test = places(picture, _TEST, 0).mean(axis=0)
    train = places(picture, _TRAIN, 0).mean(axis=0)
    assert test[0] < train[0] - 50  # the test camera is in the north
    assert abs(test[1] - train[1]) < 10


def test_from_above_nothing_is_mirrored_where_up_is_down() -> None:
    """With up along -z, y is to the right of x: seen from there, x is up on paper."""
    poses = [np.eye(4) for _ in range(4)]
    for pose, place in zip(poses, ((0, 3, 0), (0, -3, 0), (0, 2, 0), (3, 0, 0)), strict=True):
        pose[:3, 3] = place
    picture = plan_picture(inspection(poses, (0.0, 0.0, -1.0)))
    test, train = (places(picture, c, 0).mean(axis=0) for c in (_TEST, _TRAIN))
    assert test[0] < train[0] - 50
    assert train[1] > test[1] + 50


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_from_the_side_up_is_up(axis: int, sign: float) -> None:
    up = sign * np.eye(3)[axis]
    below, above = np.eye(4), np.eye(4)
    below[:3, 3], above[:3, 3] = -2.0 * up, 2.0 * up
    found = inspection([below, below.copy(), above], (up[0], up[1], up[2]))
    picture = plan_picture(found)
    test, train = (places(picture, c, 1).mean(axis=0) for c in (_TEST, _TRAIN))
    assert test[0] < train[0] - 100


def test_the_content_distance_is_to_scale() -> None:
    near = inspection(ring(7, height=0.0), (0.0, 0.0, 1.0))
    far = replace(near, content_distance=3.0)  # all at the middle
    spread = [np.ptp(places(plan_picture(f), _SIGHT_END, 0), axis=0).max() for f in (near, far)]
    assert spread[0] > 200 and spread[1] < 20
