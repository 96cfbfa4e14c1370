"""Cameras farther away than those of the training see what is there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.solid_fields import ball_field, camera_at
from warpnerf.grid_config import Contraction
from warpnerf.rendering.field import Field, Rendering
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.cameras.camera import Camera


@pytest.mark.parametrize("contraction", ["linf", "l2", "none"])
@pytest.mark.parametrize("away", [2.5, 9.0, 30.0])
def test_steps_through_the_box_are_short_from_afar(contraction: Contraction, away: float) -> None:
    field = ball_field(contraction=contraction)
    if contraction != "none":  # as trainings have it, whose cameras were three units away
        field = replace(field, steps=replace(field.steps, n_linear=150, growth=0.1))
    camera = camera_at((0.6 * away, -0.64 * away, 0.48 * away))
    camera = replace(camera, fx=camera.fx * away / 2.5, fy=camera.fy * away / 2.5)
    centre = np.array([0.1, -0.05, 0.15]) - camera.position
    x, y, z = camera.c2w[:, :3].T @ centre
    column, row = camera.cx - camera.fx * x / z, camera.cy + camera.fy * y / z
    at = int(row), int(column)
    for found in (field.render(camera), _along(field, camera)):
        assert found.opacity[at] > 0.999
        assert found.depth[at] == pytest.approx(np.linalg.norm(centre) - 0.6, abs=0.06)


def _along(field: Field, camera: Camera) -> Rendering:
    """The same, by rays that are given."""
    origins, directions = (a.numpy() for a in camera_rays(camera, field.workers))
    found = field.render_rays(origins, directions)
    shape = (camera.height, camera.width)
    return replace(found, depth=found.depth.reshape(shape), opacity=found.opacity.reshape(shape))


def test_near_cameras_march_as_in_training() -> None:
    steps = ball_field(contraction="linf").steps
    assert steps.reaching(1.9) == steps
    assert steps.reaching(4.0) == replace(steps, n_linear=200)
    assert steps.reaching(1e30).n_linear == 2**24
    assert ball_field().steps.reaching(1e30) == ball_field().steps


def test_no_rays_at_all_are_no_rays() -> None:
    nothing = np.zeros((0, 3), np.float32)
    assert ball_field(contraction="linf").render_rays(nothing, nothing).rgb.shape == (0, 3)
