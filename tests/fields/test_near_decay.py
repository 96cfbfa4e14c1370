"""The decay of densities near cameras, against a loop over nodes and cameras."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base.tiles import TILE

from tests.support.kernel_runner import Kernels
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import camera_at, look_at, ring, tiny_scene
from warpnerf.checks import InputError
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.near_decay import near_decay
from warpnerf.fields.nodes import points_of, voxel_edges
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.rays import camera_rays
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene
from warpnerf.training.trainer import Trainer

CONFIG = TrainConfig(steps=20, rays_per_step=64, threads=1, model="rgb", loss=SQUARED)
STRENGTH = 0.3


def share_of(
    point: Any, margin: float, cameras: list[Camera], distances: Any, near: float = 0.0
) -> float:
    """1 - S by its definition, for cameras without distortion."""
    rays = scaled = 0.0
    for camera, distance in zip(cameras, distances, strict=True):
        away = point - camera.position
        x, y, z = (float(away @ axis) for axis in camera.c2w[:, :3].T)
        t = math.sqrt(x * x + y * y + z * z)
        left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
        bottom, top = -(camera.height - camera.cy) / camera.fy, camera.cy / camera.fy
        inside = left * -z - margin < x < right * -z + margin
        inside = inside and bottom * -z - margin < y < top * -z + margin and -z > -margin
        if inside and t >= near:
            rays += camera.fx * camera.fy / t**2
            scaled += camera.fx * camera.fy / t**2 * min(1.0, t**2 / distance**2)
    return 1.0 - scaled / rays if rays else 0.0


@pytest.mark.parametrize("away", [0.0, 1e6])
@pytest.mark.parametrize("near", [0.0, 2.5])
def test_each_tile_has_that_of_its_middle_node(near: float, away: float, device: str) -> None:
    """With a focal length of each axis; also in the coordinates of a country."""
    cameras = [
        replace(c, fx=c.fx * (1 + 0.2 * n), cx=3.0, cy=2.0)
        for n, c in enumerate(tiny_scene(ring(5), fy=7.0).cameras)
    ]
    distances = [1.0, 2.0, 3.0, 4.0, 5.0]
    size = (9, 10, 11)
    lattice = Lattice(size=size, box_min=np.full(3, -3.0), box_max=np.array([3.0, 3.0, 4.0]))
    n_tiles = -(-math.prod(size) // TILE)
    middles = np.minimum(np.arange(n_tiles) * TILE + TILE // 2, math.prod(size) - 1)
    points = points_of(lattice, np.stack(np.unravel_index(middles, size), axis=1))
    margin = float(lattice.voxel_size.mean())
    expected = [STRENGTH * share_of(p, margin, cameras, distances, near) for p in points]
    moved = [replace(c, c2w=c.c2w + [[0, 0, 0, away]] * 3) for c in cameras]
    there = replace(lattice, box_min=lattice.box_min + away, box_max=lattice.box_max + away)
    found = near_decay(there, moved, distances, near, STRENGTH, Workers(device, 2)).numpy()
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert (found == 0.0).mean() > 0.1 and found.max() > 0.1
    alone = near_decay(there, moved, distances, near, STRENGTH, Workers(device, 1))
    assert np.array_equal(found, alone.numpy())


def test_in_float64(kernels64: Kernels) -> None:
    rng = np.random.default_rng(1)
    cameras = list(tiny_scene(ring(4)).cameras)
    distances, margins = rng.uniform(1.0, 6.0, size=4), rng.uniform(0.0, 0.5, size=300)
    points = rng.uniform(-4.0, 4.0, size=(300, 3))
    module, vec3 = kernels64.module("optim.near_decay"), kernels64.types.vec3
    observers = []
    for camera, distance in zip(cameras, distances, strict=True):
        observer = module.Observer()
        right, up, back = camera.c2w[:, :3].T
        observer.position = vec3(*camera.position)
        observer.axes = kernels64.types.mat33(*right, *-up, *-back)
        observer.low = kernels64.types.vec2(-0.4, -0.3)
        observer.high = kernels64.types.vec2(0.4, 0.3)
        observer.pixels, observer.content_distance = camera.fx * camera.fy, distance
        observers.append(observer)
    out = kernels64.zeros(300)
    kernels64.workers.launch(
        module.find_near_decay,
        300,
        kernels64.array(points, vec3),
        kernels64.array(margins),
        wp.array(observers, dtype=module.Observer, device=kernels64.device),
        1.5,
        STRENGTH,
        out,
    )
    expected = [
        STRENGTH * share_of(point, margin, cameras, distances, 1.5)
        for point, margin in zip(points, margins, strict=True)
    ]
    np.testing.assert_allclose(out.numpy(), expected, rtol=1e-12, atol=1e-12)


LENSES = {
    "barrel": {"k1": -0.3},
    "tangential": {"p1": 0.05, "p2": -0.03},
    "fisheye": {"fisheye": True, "fx": 50.0, "fy": 50.0},
}


@pytest.mark.parametrize("lens", LENSES)
def test_a_lens_that_bends_sees_all_along_its_rays(lens: str, device: str) -> None:
    """And nothing far outside of them: behind it, or aside."""
    size = {"width": 80, "height": 60, "fx": 100.0, "fy": 100.0, "cx": 40.0, "cy": 30.0}
    camera = camera_at(look_at((0.0, 0.0, 0.0), (1.0, 0.2, 0.1)), **(size | LENSES[lens]))
    workers = Workers(device, 1)
    rays = camera_rays(camera, workers)[1].numpy().astype(np.float64)
    corners = rays[[0, camera.width - 1, -camera.width, -1]]
    ahead = corners @ camera.forward
    beyond = 1.5 * corners + (ahead - 1.5 * ahead)[:, None] * camera.forward
    beyond /= np.linalg.norm(beyond, axis=1)[:, None]
    for direction, wanted in (
        *((d, 0.19) for d in corners),
        *((d, 0.0) for d in beyond),
        (-camera.forward, 0.0),
    ):
        point = 0.9 * direction
        # Its first tile's middle node, the third along z.
        low, high = np.subtract(point, [0.0, 0.0, 1e-4]), np.add(point, [1e-4, 1e-4, 0.0])
        lattice = Lattice(size=(2, 2, 3), box_min=low, box_max=high)
        found = near_decay(lattice, [camera], [1.0], 0.0, STRENGTH, workers).numpy()
        assert found[0] == pytest.approx(STRENGTH * wanted, abs=1e-4)


def test_places_at_infinity_have_none(device: str) -> None:
    """Contracted space ends there; what lies outside of the box is judged by where it is."""
    lattice = Lattice(
        size=(12, 12, 12),
        box_min=-np.ones(3),
        box_max=np.ones(3),
        contraction="linf",
        border=1.0,
    )
    cameras, distances = list(tiny_scene(ring(5)).cameras), [6.0] * 5
    found = near_decay(lattice, cameras, distances, 0.0, STRENGTH, Workers(device, 1)).numpy()
    middles = np.arange(len(found)) * TILE + TILE // 2
    nodes = np.stack(np.unravel_index(middles, lattice.size), axis=1)
    points = points_of(lattice, nodes)
    ends = ~np.isfinite(points).all(axis=1) | (np.abs(points) > 1e3).any(axis=1)
    assert ends.any() and not found[ends].any()
    margins = voxel_edges(lattice, points)
    outside = np.flatnonzero(~ends & (np.abs(points) > 1.2).any(axis=1))
    expected = [STRENGTH * share_of(points[n], margins[n], cameras, distances) for n in outside]
    np.testing.assert_allclose(found[outside], expected, atol=1e-5)
    assert 0 < np.count_nonzero(expected) < len(expected)


def after_an_update(scene: Scene, near_decay: float) -> tuple[Trainer, Any]:
    """A trainer, and its nodes."""
    optim = replace(CONFIG.optim, near_decay=near_decay)
    trainer = Trainer(scene, replace(CONFIG, content_distance=5.0, optim=optim))
    trainer.update()
    return trainer, trainer.storage.values.numpy()  # type: ignore[attr-defined]


def test_an_update_lowers_the_densities_that_it_moves() -> None:
    """By their share of the learning rate, as it is then; and none where that is off."""
    scene = tiny_scene(ring(5))
    trainer, lowered = after_an_update(scene, STRENGTH)
    without, values = after_an_update(scene, 0.0)
    assert not without._decays
    lattice, cameras = trainer.lattice, list(scene.training_cameras)
    margin, moved = float(lattice.voxel_size.mean()), values[:, 0] != 0.0
    tiles = np.unique(np.flatnonzero(moved) // TILE)
    assert len(tiles) > 20
    nodes = np.stack(np.unravel_index(tiles * TILE + TILE // 2, lattice.size), axis=1)
    expected = np.zeros(-(-len(values) // TILE))
    expected[tiles] = [
        STRENGTH * share_of(point, margin, cameras, [5.0] * len(cameras))
        for point in points_of(lattice, nodes)
    ]
    rate = trainer.schedule.rate(0.0, 0, 1) * CONFIG.optim.learning_rate_density
    fall = rate * np.repeat(expected, TILE)[: len(values)] * moved
    np.testing.assert_allclose(values[:, 0] - lowered[:, 0], fall, atol=1e-6)
    assert fall.max() > 0.05 and np.array_equal(values[:, 1:], lowered[:, 1:])


def test_a_grown_grid_has_decays_of_its_own() -> None:
    optim = replace(CONFIG.optim, near_decay=STRENGTH)
    grid = GridConfig(voxels=4096, grow_at=(0.6,))
    trainer = Trainer(tiny_scene(ring(5)), replace(CONFIG, steps=600, grid=grid, optim=optim))
    before = trainer._decays["values"].shape[0]
    trainer.run()
    n_tiles = -(-math.prod(trainer.lattice.size) // TILE)
    assert trainer._decays["values"].shape[0] == n_tiles > before


def test_other_fields_are_refused() -> None:
    with pytest.raises(InputError, match="hash field has no density of its own at each node;"):
        TrainConfig(field="hash", optim=OptimConfig(near_decay=0.1))
    for wrong in (-0.1, 1.0, math.nan):
        with pytest.raises(InputError, match=r"optim\.near_decay must lie in \[0, 1\), not"):
            OptimConfig(near_decay=wrong)
