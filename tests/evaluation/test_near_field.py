"""Figures of floaters, in fields of which they are known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.evaluation.test_evaluation import scene_of
from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at
from warpnerf.evaluation.near_field import (
    MAX_PIXELS,
    MAX_PULLED,
    ends_within,
    measure_near_field,
)
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.field import Field, Rendering
from warpnerf.scenes.scene import Scene, View

CONTENT_DISTANCE = 5.0
WITHIN = 0.5


def even_field(sigma: float) -> Field:
    """A field of one density, sampled from the camera on."""
    field = tiny_field()
    values = field.storage.values.numpy()
    softplus = sigma / field.storage.density_scale
    values[:, 0] = math.log(math.expm1(softplus)) - field.storage.density_shift
    field.storage.values.assign(values)
    steps = replace(field.steps, near=0.0, step=0.01)
    return replace(field, steps=steps, free=FreeCells.none(field.workers))


def scene_inside(n: int = 3) -> Scene:
    """Cameras in the middle of the field."""
    pose = np.eye(4)
    size = {"width": 40, "height": 30, "fx": 30.0, "fy": 30.0, "cx": 20.0, "cy": 15.0}
    black = np.zeros((30, 40, 3), np.uint8)
    views = [View(name=f"{k}", camera=camera_at(pose, **size), image=black) for k in range(n)]
    return Scene(
        name="inside",
        views=views,
        splits={"train": tuple(range(n))},
        box_min=-np.ones(3),
        box_max=np.ones(3),
        unbounded=False,
        content_distance=CONTENT_DISTANCE,
    )


@pytest.mark.parametrize("sigma", [0.01, 0.4, 3.0])
def test_mass_of_even_density(sigma: float) -> None:
    """The integral of sigma up to the limit, whatever lies behind."""
    found = measure_near_field(even_field(sigma), scene_inside())
    assert found.within == WITHIN
    assert found.near_mass == pytest.approx(sigma * WITHIN, rel=0.01)


def test_rays_that_end_near() -> None:
    """In a thin medium light gets far; in a dense one, not; in empty space there is none to end."""
    for sigma, share in ((1e-3, 0.0), (0.5, 0.0), (20.0, 1.0)):
        assert measure_near_field(even_field(sigma), scene_inside()).near_rays == share


def test_a_ray_ends_where_its_light_comes_from_if_half_of_it_does() -> None:
    opacity, depth = np.array([[1.0, 0.6, 0.6, 0.49, 1.0], [0.45, 0.25, 0.35, 0.1, 0.55]])
    seen = Rendering(rgb=np.zeros((5, 3)), opacity=opacity, depth=depth)
    assert ends_within(seen, 0.5).tolist() == [True, True, False, False, False]


def test_what_hangs_before_one_of_four_cameras_counts_for_a_quarter() -> None:
    field = even_field(20.0)
    scene = scene_inside(4)
    away = replace(scene.views[0].camera, c2w=scene.views[0].camera.c2w + [[0, 0, 0, 9.0]] * 3)
    views = [replace(view, camera=away) for view in scene.views[:3]]
    found = measure_near_field(field, replace(scene, views=[*views, scene.views[3]]))
    assert found.near_rays == 0.25
    assert found.near_mass == pytest.approx(0.25 * 20.0 * WITHIN, rel=0.01)


def test_without_new_photographs_nothing_is_pulled_back() -> None:
    field = tiny_field()
    found = measure_near_field(field, scene_of(field, depth=False))
    assert (found.pulled_back, found.pulled_psnr, found.pulled_views) == (None, None, None)
    assert list(found.to_dict()) == ["within", "near_mass", "near_rays"]
    assert "pulled" not in str(found)


def test_pulled_back_cameras_see_what_their_photographs_show() -> None:
    field = even_field(0.4)
    cameras = []

    def photograph(camera):
        cameras.append(camera)
        if len(cameras) == 2:  # cannot stand there
            return None
        return np.round(255.0 * field.render(camera).rgb).astype(np.uint8)

    found = measure_near_field(field, replace(scene_inside(40), photograph=photograph))
    assert len(cameras) <= MAX_PULLED
    assert found.pulled_views == len(cameras) - 1
    assert found.pulled_back == 1.0
    assert found.pulled_psnr == pytest.approx(58.9, abs=2.0)
    for camera in cameras:
        np.testing.assert_allclose(camera.position, [0.0, 0.0, 1.0])  # they look along -z
        np.testing.assert_array_equal(camera.c2w[:, :3], np.eye(3))

    def black(camera):
        return np.zeros((30, 40, 3), np.uint8)

    wrong = measure_near_field(field, replace(scene_inside(), photograph=black))
    assert wrong.pulled_psnr is not None and wrong.pulled_psnr < 20.0


def test_moving_back_leaves_the_camera_as_it_was() -> None:
    camera = scene_inside().views[0].camera
    before = camera.c2w.copy()
    camera.moved_back(2.0)
    np.testing.assert_array_equal(camera.c2w, before)


@pytest.mark.parametrize(("width", "height"), [(8, 6), (640, 480), (1, 5000)])
def test_coarse_cameras_see_the_same_field_of_view(width: int, height: int) -> None:
    camera = camera_at(np.eye(4), width=width, height=height, cx=width / 2, cy=height / 2)
    less = camera.downscaled(camera.block_for(MAX_PIXELS))
    assert 1 <= less.width * less.height <= max(MAX_PIXELS, height)
    if width * height <= MAX_PIXELS:
        assert (less.width, less.height) == (width, height)
    elif min(width, height) > 100:
        assert less.width * less.height > 0.7 * MAX_PIXELS
        assert less.width / less.fx == pytest.approx(camera.width / camera.fx, rel=0.05)
