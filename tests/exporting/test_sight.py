"""What cameras see of a field, compared with what they render."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.compiling import not_optimising
from tests.support.solid_fields import ball_field, camera_at, cameras_around
from tests.support.tiny_fields import tiny_field
from warpnerf.checks import InputError
from warpnerf.exporting import visibility as seen_by
from warpnerf.exporting.visibility import visibility
from warpnerf.fields.nodes import nodes_of, points_of, values_at
from warpnerf.scenes.cameras.undistort import seen_pixels
from warpnerf.scenes.scene import View


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
def test_all_light_comes_from_some_node(contraction: str) -> None:
    """A sample's trilinear shares add up to 1, and its weights to the ray's opacity."""
    field = tiny_field(contraction=contraction)
    field = replace(field, steps=replace(field.steps, transmittance_min=0.0))
    cameras = [camera_at((2.2, 0.4, 0.5)), camera_at((-0.3, 2.5, 1.0))]
    with not_optimising():
        opacity = sum(field.render(camera).opacity.sum(dtype=np.float64) for camera in cameras)
        seen = visibility(field, cameras).light
    assert seen.shape == field.lattice.size and seen.min() >= 0.0
    assert seen.sum(dtype=np.float64) == pytest.approx(opacity, rel=1e-4)


def test_light_comes_from_the_front_of_what_is_solid() -> None:
    field = ball_field()
    seen = visibility(field, [camera_at((2.5, 0.0, 0.1))]).light
    points = points_of(field.lattice, np.argwhere(seen > 0.1).astype(float))
    assert len(points) > 50
    radii = np.linalg.norm(points - (0.1, -0.05, 0.15), axis=1)
    assert radii.min() > 0.45 and radii.max() < 0.66
    assert points[:, 0].min() > 0.1


def test_colours_are_means_over_the_pixels_that_see_them() -> None:
    """Each pixel's colour, less its background, flows back in full."""
    field = tiny_field()
    field = replace(field, steps=replace(field.steps, transmittance_min=0.0))
    camera = camera_at((2.2, 0.4, 0.5))
    shown, visible = field.render(camera), visibility(field, [camera])
    weighted = (shown.rgb * shown.opacity[..., None]).sum(axis=(0, 1), dtype=np.float64)
    np.testing.assert_allclose(
        visible.colour.sum(axis=(0, 1, 2), dtype=np.float64), weighted, rtol=1e-4
    )
    ball = ball_field()
    rgb, seen = visibility(ball, cameras_around()).rgb_at(
        nodes_of(
            ball.lattice, np.array([[0.65, -0.05, 0.25], [-0.45, -0.05, 0.05], [0.1, -0.05, 0.15]])
        )
    )
    assert seen.tolist() == [True, True, False]
    assert rgb[0, 0] > 0.7 > 0.4 > rgb[1, 0] and rgb[1, 1] > 0.7


def test_pixels_that_do_not_count_see_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the picture masked: the other half's light, and colours, remain."""
    field = tiny_field()
    field = replace(field, steps=replace(field.steps, transmittance_min=0.0))
    camera = camera_at((2.2, 0.4, 0.5))
    mask = np.zeros((40, 48), bool)
    mask[:, 24:] = True
    view = View(name="half", camera=camera, image=np.zeros((40, 48, 3), np.uint8), mask=mask)
    shown, half = field.render(camera), visibility(field, [view])
    opacity = shown.opacity[mask].sum(dtype=np.float64)
    assert 0.0 < opacity < 0.9 * shown.opacity.sum()
    assert half.light.sum(dtype=np.float64) == pytest.approx(opacity, rel=1e-4)
    weighted = (shown.rgb * shown.opacity[..., None])[mask].sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(half.colour.sum(axis=(0, 1, 2), dtype=float), weighted, rtol=1e-4)
    monkeypatch.setattr(seen_by, "MAX_RAYS", 48 * 40 // 4)  # blocks of 2 x 2
    assert visibility(field, [view]).light.sum() == pytest.approx(opacity, rel=0.05)


def test_corners_outside_of_a_fisheyes_circle_see_nothing() -> None:
    field = tiny_field()
    field = replace(field, steps=replace(field.steps, transmittance_min=0.0))
    camera = replace(camera_at((0.3, 0.2, 0.4)), fx=7.0, fy=7.0, fisheye=True)
    seen = seen_pixels(camera)
    assert seen is not None and 0.3 < seen.mean() < 0.9
    opacity = field.render(camera).opacity
    assert opacity[~seen].sum() > 0.1 * opacity.sum()
    light = visibility(field, [camera]).light
    assert light.sum(dtype=np.float64) == pytest.approx(float(opacity[seen].sum()), rel=1e-4)


def test_fewer_rays_stand_for_as_many_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    field, cameras = ball_field(), cameras_around()
    fully = visibility(field, cameras).light
    monkeypatch.setattr(seen_by, "MAX_RAYS", 12 * 48 * 40 // 4)
    coarsely = visibility(field, cameras).light
    assert coarsely.sum() == pytest.approx(fully.sum(), rel=0.05)
    assert not np.array_equal(coarsely, fully)


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
def test_node_coordinates_are_those_that_kernels_read(contraction: str) -> None:
    """Rays of one short step show the raw values at its sample."""
    field = tiny_field(density=400.0, contraction=contraction)  # opaque at once
    reach = 0.95 if contraction == "none" else 4.0
    points = np.random.default_rng(1).uniform(-reach, reach, (200, 3))
    nodes = nodes_of(field.lattice, points)
    np.testing.assert_allclose(points_of(field.lattice, nodes), points, atol=1e-9)
    step = 1e-3
    steps = replace(field.steps, near=0.0, far=step, step=step, n_linear=1)
    along = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    start = points - (0.0, 0.0, 0.5 * step)
    shown = replace(field, steps=steps).render_rays(start, along)
    values = field.storage.values.numpy().reshape(*field.lattice.size, -1)
    raw = np.stack([values_at(values[..., 1 + c], nodes) for c in range(3)], axis=1)
    background = np.array(field.background) * (1.0 - shown.opacity[:, None])
    rgb = (shown.rgb - background) / shown.opacity[:, None]
    np.testing.assert_allclose(rgb, 1.0 / (1.0 + np.exp(-raw)), atol=2e-3)


def test_without_views_there_is_nothing_to_see() -> None:
    with pytest.raises(InputError, match="at least one view"):
        visibility(tiny_field(), [])
