"""Measures, against numpy in float64 and by hand."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from tests.evaluation.test_evaluation import scene_of
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.evaluation.light import absorbed, measure_light
from warpnerf.evaluation.measures import Measuring, angle_to_nearest, depth_errors
from warpnerf.evaluation.near_field import measure_near_field, near_masses
from warpnerf.evaluation.sight import (
    SurfaceVisibility,
    surfaces,
    training_views_that_see,
    true_depths,
)
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.field import Field, Rendering
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.cameras.tracks import Tracks
from warpnerf.scenes.scene import Scene, View

LIGHT = ("front", "hit", "behind", "transmitted")
WALL = 0.5
"""x of a wall that reaches from y = -1 to 1."""


def thin_field() -> Field:
    """One that light passes in part, without free cells; renderings end rays early."""
    field = tiny_field(density=-1.0)
    steps = replace(field.steps, transmittance_min=0.3)
    return replace(field, steps=steps, free=FreeCells.none(field.workers))


def light_passing(field: Field, origin: np.ndarray, direction: np.ndarray, limit: float) -> float:
    """Light up to a distance: a product over steps, of densities between eight nodes."""
    size = np.array(field.lattice.size)
    raw = field.storage.values.numpy()[:, 0].astype(np.float64).reshape(size)
    steps, passing = field.steps, 1.0
    for k in range(200):
        t = steps.near + (k + 0.5) * steps.step
        length = np.clip(limit - (t - steps.step / 2.0), 0.0, steps.step)  # cut where it ends
        node = (origin + t * direction + 1.0) / 2.0 * (size - 1)  # the box is [-1, 1]^3
        if t >= steps.far or (node < 0.0).any() or (node > size - 1).any():
            continue
        low = np.minimum(node.astype(int), size - 2)
        value = 0.0
        for corner in np.ndindex(2, 2, 2):
            share = np.where(corner, node - low, 1.0 - (node - low)).prod()
            value += share * raw[tuple(low + corner)]
        sigma = field.storage.density_scale * np.log1p(np.exp(value + field.storage.density_shift))
        passing *= np.exp(-sigma * length)
    return passing


def test_shares_of_light_are_those_of_the_integral_and_sum_to_one() -> None:
    field, rng = thin_field(), np.random.default_rng(3)
    origins = np.array([0.0, 0.0, 3.0]) + rng.uniform(-2.0, 2.0, (24, 3))
    directions = rng.uniform(-0.9, 0.9, (24, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    depths = np.linspace(2.0, 5.0, 24)
    found = absorbed(field, origins, directions, depths)
    for ray, shares in enumerate(found):
        place = origins[ray], directions[ray]
        front = light_passing(field, *place, 0.8 * depths[ray])
        behind = light_passing(field, *place, 1.25 * depths[ray])
        end = light_passing(field, *place, np.inf)
        truth = [1.0 - front, front - behind, behind - end, end]
        np.testing.assert_allclose(shares, truth, atol=2e-6)
    np.testing.assert_allclose(found.sum(axis=1), 1.0, atol=1e-12)
    assert (found.mean(axis=0) > 0.05).all()


def test_only_pixels_that_count_and_have_a_depth_are_looked_along() -> None:
    field = thin_field()
    scene = scene_of(field, depth=True)
    view = scene.views[3]
    assert view.depth is not None
    mask = np.zeros((12, 16), bool)
    mask[:4] = True
    depth = np.where(np.arange(16) < 8, 3.0, np.inf).astype(np.float32) + np.zeros((12, 1), "f4")
    views = [*scene.views[:3], replace(view, depth=depth, mask=mask)]
    found = measure_light(field, replace(scene, views=views), "test")
    assert found is not None and found.rays == 32
    assert sum(getattr(found, name) for name in LIGHT) == pytest.approx(1.0)
    assert measure_light(field, scene_of(field, depth=False), "test") is None


def first_hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """The wall, and all around it a far one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (WALL - origins[:, 0]) / directions[:, 0]
        y = origins[:, 1] + t * directions[:, 1]
    return np.where((t > 0.0) & (np.abs(y) < 1.0), t, 100.0)


def walled(traced: bool) -> Scene:
    """Two training cameras before the wall and one behind it; the test camera is one of them."""
    lens = {"width": 40, "height": 30, "fx": 30.0, "fy": 30.0, "cx": 20.0, "cy": 15.0}
    field, views = tiny_field(), []
    for k, x in enumerate((-3.0, -2.0, 4.0, -3.0)):
        camera = camera_at(look_at((x, 0.0, 0.1), (WALL, 0.0, 0.0)), **lens)
        view = View(name=str(k), camera=camera, image=np.zeros((30, 40, 3), np.uint8))
        directions = directions_of(field, view)
        depth = first_hit(np.broadcast_to(camera.position, directions.shape), directions)
        views.append(replace(view, depth=depth.reshape(30, 40).astype(np.float32)))
    return Scene(
        name="wall",
        views=views,
        splits={"train": (0, 1, 2), "test": (3,)},
        box_min=-np.ones(3),
        box_max=np.ones(3),
        unbounded=False,
        content_distance=3.0,
        first_hit=first_hit if traced else None,
    )


def directions_of(field: Field, view: View) -> np.ndarray:
    return camera_rays(view.camera, field.workers)[1].numpy()


@pytest.mark.parametrize("traced", [True, False], ids=["by the tracer", "by depths"])
def test_a_wall_hides_what_is_behind_it(traced: bool) -> None:
    scene = walled(traced)
    before, behind = np.array([WALL, 0.2, 0.4]), np.array([WALL + 1.0, 0.05, 0.1])
    aside = np.array([-2.5, 0.0, 0.1])  # between the first two cameras
    found = training_views_that_see(scene, np.stack([before, behind, aside]))
    # The third camera sees the wall's other side, at the same place.
    assert found.tolist() == [3, 1, 1]
    masks = [np.zeros((30, 40), bool) for _ in range(2)]
    masks[0][:15] = True  # in the upper half of both
    masks[1][0, 0] = True
    hidden = [replace(view, mask=mask) for view, mask in zip(scene.views, masks, strict=False)]
    scene = replace(scene, views=[*hidden, *scene.views[2:]])
    assert training_views_that_see(scene, before[None]).tolist() == [2]


@pytest.mark.parametrize("k1", [-0.2, 0.2])
def test_a_camera_sees_all_of_its_own_surfaces_through_its_lens(k1: float) -> None:
    """And nothing beside them that the lens would fold into its picture."""
    field, scene = tiny_field(), walled(True)
    camera = replace(scene.views[0].camera, k1=k1)
    view = replace(scene.views[0], camera=camera)
    rays = directions_of(field, view)
    depth = first_hit(np.broadcast_to(camera.position, rays.shape), rays).reshape(30, 40)
    view = replace(view, depth=depth.astype(np.float32))
    alone = replace(scene, views=[view], splits={"train": (0,)})
    assert training_views_that_see(alone, surfaces(view, rays)).all()
    along = np.array([[-math.sin(a), 0.0, -math.cos(a)] for a in np.radians(np.arange(55, 90))])
    assert not training_views_that_see(alone, camera.position + along @ camera.c2w[:, :3].T).any()


def test_figures_are_of_the_pixels_that_enough_views_see() -> None:
    """Pixels that see no wall are wrong and do not count; of the others, the field is known."""
    field, scene = tiny_field(), walled(True)
    wide = replace(scene.views[3].camera, fx=12.0, fy=12.0)  # sees what the second does not
    view = replace(scene.views[3], camera=wide)
    origin = np.broadcast_to(wide.position, (1200, 3))
    depth = first_hit(origin, directions_of(field, view)).reshape(30, 40).astype(np.float32)
    view = replace(view, depth=depth)
    points = surfaces(view, directions_of(field, view))
    counts = training_views_that_see(scene, points).reshape(30, 40)
    seen = counts >= 2
    assert 0.05 < seen.mean() < 0.9
    rgb = np.repeat(np.where(seen, 0.1, 0.9)[..., None], 3, axis=2)
    opacity = np.ones((30, 40))
    opacity[np.nonzero(seen)[0][:10], np.nonzero(seen)[1][:10]] = 0.49
    rendering = Rendering(rgb=rgb, depth=np.where(seen, 1.1 * depth, 0.0), opacity=opacity)
    measuring = Measuring(field, scene, "test")
    measuring.add(view, np.zeros((30, 40, 3)), rendering)
    away = view.camera.moved_back(9.0)
    unseen = replace(view, name="4", camera=away, depth=np.full((30, 40), 0.5, "f4"))
    measuring.add(unseen, np.zeros((30, 40, 3)), rendering)  # of which no training view sees any
    found = measuring.finish(list(near_masses(field, scene)))
    two = found.seen["2"]
    assert two.psnr == pytest.approx(20.0) and two.share == pytest.approx(seen.mean() / 2)
    assert two.coverage == pytest.approx(1.0 - 10 / seen.sum())
    assert two.relative_depth_error == pytest.approx(0.1, rel=1e-5)
    assert found.seen["1"].share > two.share and found.seen["1"].psnr < two.psnr
    assert "2 or more" in str(found) and "front" in str(found)
    assert list(found.light) == ["test", "train"] and found.near_density is not None


def test_points_stand_in_where_no_depths_are_known() -> None:
    """Five points of structure from motion, one of them hidden behind another."""
    field, scene = thin_field(), walled(False)
    position = scene.views[3].camera.position
    points = np.array(
        [[WALL, y, z] for y, z in ((0.0, 0.1), (0.6, 0.3), (-0.7, -0.4), (0.3, -0.5))]
    )
    points = np.concatenate([points, position + 1.2 * (points[:1] - position)])
    shown = {"0": [0, 1, 4], "1": [1, 0, 2, 2], "2": [4], "3": [0, 1, 2, 3, 4]}
    tracks = Tracks(positions=points, shown={name: np.array(of) for name, of in shown.items()})
    bare = [replace(view, depth=None) for view in scene.views]
    scene = replace(scene, views=bare, tracks=tracks)
    view = scene.views[3]
    x, y, z = ((points[:4] - position) @ view.camera.c2w[:, :3]).T
    columns, rows = (20.0 - 30.0 * x / z).astype(int), (15.0 + 30.0 * y / z).astype(int)
    away = np.linalg.norm(points[:4] - position, axis=1)
    depths = true_depths(scene, view)
    assert depths is not None and np.isfinite(depths).sum() == 4
    np.testing.assert_allclose(depths[rows, columns], away)
    counts = SurfaceVisibility(scene).counts(view, field.workers)
    assert counts is not None and counts[rows, columns].tolist() == [2, 2, 1, 0]

    rendering = Rendering(
        rgb=np.full((30, 40, 3), 0.9), depth=1.1 * np.nan_to_num(depths), opacity=np.ones((30, 40))
    )
    rendering.rgb[rows[:2], columns[:2]] = 0.1
    measuring = Measuring(field, scene, "test")
    measuring.add(view, np.zeros((30, 40, 3)), rendering)
    found = measuring.finish(list(near_masses(field, scene)))
    two = found.seen["2"]
    assert found.points_only and two.share == 0.5 and two.ssim is None
    assert two.psnr == pytest.approx(20.0) and found.seen["1"].psnr < 10.0
    assert two.relative_depth_error == pytest.approx(0.1)
    assert found.light["test"].rays == 4 and found.light["train"].rays == 2 + 3 + 1
    top = np.arange(30)[:, None] < 15
    hidden = replace(view, mask=np.broadcast_to(top, (30, 40)).copy())
    known = true_depths(scene, hidden)
    assert known is not None and np.isfinite(known).sum() == (rows < 15).sum() == 2


def test_depth_errors_by_hand() -> None:
    found = depth_errors(np.array([1.0, 4.0, 0.0]), np.array([2.0, 2.0, 2.0]), 0.5)
    assert found["depth_error"] == pytest.approx((1.0 + 2.0 + 2.0) / 3)
    assert found["relative_depth_error"] == pytest.approx((0.5 + 1.0 + 1.0) / 3)
    assert found["inverse_depth_error"] == pytest.approx((0.5 + 0.25 + 1.5) / 3)


def test_the_angle_is_that_to_the_nearest_camera() -> None:
    def facing(degrees: float):
        angle = np.radians(degrees)
        return camera_at(look_at((0.0, 0.0, 0.0), (np.cos(angle), np.sin(angle), 0.0)))

    assert angle_to_nearest(facing(0.0), [facing(50.0), facing(-20.0)]) == pytest.approx(20.0)


def test_a_capture_without_depths_is_measured_as_far_as_it_can_be() -> None:
    field = tiny_field()
    scene = replace(scene_of(field, depth=False), content_distance=30.0)  # all of it is near
    result = evaluate(field, scene, measures=True)
    found = json.loads(result.to_json())["measures"]
    assert found["light"] == {} and found["seen"] == {} and len(found["left_out"]) == 2
    assert list(found["near_mass"]) == [f"images/{k}.png" for k in range(3)]
    mean = np.mean(list(found["near_mass"].values()))  # cameras have as many rays
    assert mean == pytest.approx(measure_near_field(field, scene).near_mass) and mean > 0.0
    (angle,) = found["angles"]
    assert angle["angle"] == pytest.approx(84.3, abs=0.1) and angle["psnr"] > 50.0
    assert found["training_psnr"] > 50.0 and "left out" in str(result)
    assert "measures" not in json.loads(evaluate(field, scene).to_json())
