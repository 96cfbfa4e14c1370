"""Total variation is as strong as the gradients are that it is compared with."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.config import TrainConfig
from warpnerf.fields.nodes import points_of
from warpnerf.fields.total_variation import TotalVariation, root_mean_square_scale
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.training.trainer import Trainer

CONFIG = TrainConfig(steps=10, rays_per_step=64, threads=1, model="rgb", loss=SQUARED)


def one_by_one(
    point: Any, cameras: list[Camera], distances: list[float], near: float = 0.0
) -> float:
    """By the definition: rays go with 1 / distance^2, and each has its scale."""
    rays, squares = [], []
    for camera, distance in zip(cameras, distances, strict=True):
        away = point - camera.position
        t = math.sqrt(float(away @ away))
        corner = math.hypot(
            max(camera.cx, camera.width - camera.cx) / camera.fx,
            max(camera.cy, camera.height - camera.cy) / camera.fy,
        )
        if t < near:
            continue
        if not camera.fisheye and math.acos(away @ camera.forward / t) >= math.atan(corner):
            continue
        scale = min(1.0, (t / distance) ** 2)
        rays.append(1.0 / t**2)
        squares.append(rays[-1] * scale**2)
    return math.sqrt(sum(squares) / sum(rays)) if rays else 1.0


@pytest.mark.parametrize("near", [0.0, 3.0])
@pytest.mark.parametrize("away", [0.0, 1e6])
@pytest.mark.parametrize("lens", ["straight", "fisheye"])
def test_the_scales_of_the_rays_at_points(lens: str, away: float, near: float) -> None:
    """Also of a scene in the coordinates of a country."""
    cameras = list(tiny_scene(ring(5), fisheye=lens == "fisheye").cameras)
    distances = [1.0, 2.0, 3.0, 4.0, 5.0]
    points = np.random.default_rng(0).uniform(-6.0, 6.0, size=(200, 3))
    expected = [one_by_one(point, cameras, distances, near) for point in points]
    moved = [replace(camera, c2w=camera.c2w + [[0, 0, 0, away]] * 3) for camera in cameras]
    found = root_mean_square_scale(points + away, moved, distances, near)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    assert found.min() < 0.95 and found.max() == 1.0
    unseen = sum(value == 1.0 for value in expected)
    assert lens == "fisheye" or unseen > 10


def test_places_at_infinity_and_nowhere_are_far() -> None:
    cameras = list(tiny_scene(ring(5)).cameras)
    points = np.array([[np.inf, 0, 0], [0, -np.inf, 0], [np.nan, np.nan, np.nan]])
    np.testing.assert_allclose(root_mean_square_scale(points, cameras, [1.0] * 5), 1.0)


def strength_of(trainer: Trainer) -> np.ndarray:
    """That of a training's total variation."""
    assert isinstance(trainer.regulariser, TotalVariation)
    return np.asarray(trainer.regulariser.strength.numpy())


@pytest.mark.parametrize("near", [0.0, 3.3])
def test_a_training_smooths_less_what_is_near(near: float) -> None:
    """But for rays that begin behind a place: those do not count."""
    scene = tiny_scene(ring(5))
    without = strength_of(Trainer(scene, replace(CONFIG, scaling="none")))
    assert (without == 1.0).all()
    none = replace(CONFIG.optim, tv_density=0.0, tv_rgb=0.0)  # then it would be for nothing
    assert Trainer(scene, replace(CONFIG, optim=none)).regulariser is None
    march = replace(CONFIG.march, near=near)
    trainer = Trainer(scene, replace(CONFIG, content_distance=20.0, march=march))
    strength, lattice = strength_of(trainer), trainer.lattice
    n_nodes = math.prod(lattice.size)
    assert len(strength) == len(without) == -(-n_nodes // TV_BLOCK)
    middles = np.minimum(np.arange(len(strength)) * TV_BLOCK + TV_BLOCK // 2, n_nodes - 1)
    places = points_of(lattice, np.stack(np.unravel_index(middles, lattice.size), axis=1))
    cameras = list(scene.training_cameras)
    other = []
    for run in (0, 7, len(strength) // 2, len(strength) - 1):
        expected = one_by_one(places[run], cameras, [20.0] * len(cameras), near)
        assert strength[run] == pytest.approx(expected, rel=1e-4)
        other.append(expected - one_by_one(places[run], cameras, [20.0] * len(cameras)))
    assert near == 0.0 or max(other) > 1e-3
    assert strength.min() < 0.1


def test_a_grown_grid_gets_strengths_of_its_own() -> None:
    config = replace(CONFIG, steps=600, grid=replace(CONFIG.grid, voxels=4096, grow_at=(0.6,)))
    trainer = Trainer(tiny_scene(ring(5)), config)
    before = len(strength_of(trainer))
    trainer.run()
    assert len(strength_of(trainer)) == -(-math.prod(trainer.lattice.size) // TV_BLOCK) > before
