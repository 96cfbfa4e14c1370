"""The plan shows things where they are: up is up, and each in its colour."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.inspection.inspection import Cost, Inspection
from warpnerf.media.scene_plan import (
    _BLURRED,
    _BOX,
    _SHARP,
    _SIGHT_END,
    _TEST,
    _TRAIN,
    _WIDER,
    plan_picture,
)
from warpnerf.scenes.cameras.observations import guessed
from warpnerf.training.plan import resolve

HEADER = 114


def inspection(poses: list[np.ndarray], up: tuple[float, float, float]) -> Inspection:
    scene = tiny_scene(poses)
    config = TrainConfig(grid=GridConfig(voxels=1000))
    cost = Cost(plan=resolve(scene, config), seconds=1.0, threads=1)
    return Inspection(
        scene=scene,
        format="by hand",
        content_distance=1.0,
        up=np.array(up),
        focus=None,
        diagnostics=(),
        costs={"by hand": cost},
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


def test_what_is_seen_is_the_redder_the_more_pixels_wide_its_voxels_are() -> None:
    found = inspection(ring(7, height=0.0), (0.0, 0.0, 1.0))
    seen = guessed([view.camera for view in found.scene.views], 2.0)
    seen = replace(seen, pixels=2.0 * seen.pixels)  # as of photographs twice as large
    found = replace(found, scene=replace(found.scene, observations=seen))
    own = found.costs["by hand"]

    def drawn(voxels: int) -> np.ndarray:
        config = replace(own.plan.config, grid=GridConfig(voxels=voxels))
        cost = replace(own, plan=replace(own.plan, config=config))
        return plan_picture(replace(found, costs={"by hand": cost}))

    for colour, more, fewer in ((_SHARP, 10**6, 8), (_BLURRED, 8, 10**6)):
        assert len(places(drawn(more), colour, 0)) > len(places(drawn(fewer), colour, 0))


def test_an_outline_shows_where_voxels_are_twice_as_wide() -> None:
    found = inspection(ring(7, height=0.0), (0.0, 0.0, 1.0))
    own = found.costs["by hand"]
    assert np.ptp(places(plan_picture(found), _WIDER, 0), axis=0).max(initial=0) < 300
    space = replace(own.plan.space, contraction="linf", border=0.5)
    cost = replace(own, plan=replace(own.plan, space=space))
    picture = plan_picture(replace(found, costs={"by hand": cost}))
    assert np.ptp(places(picture, _WIDER, 0), axis=0).min() > 300  # 2.6 times the box, on paper
