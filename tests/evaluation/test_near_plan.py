"""Plans of the density around cameras, against numpy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at, look_at
from warpnerf.evaluation.near_plan import near_plan
from warpnerf.fields.occupancy import FreeCells
from warpnerf.media.scene_plan import near_picture
from warpnerf.scenes.scene import Scene, View


def test_vertical_lines_through_balls_around_cameras_in_even_density() -> None:
    """Two upright cameras, one just below the top of the box; z is up, and x is to the right."""
    field = tiny_field()
    values = field.storage.values.numpy()
    values[:, 0] = 1.0
    field.storage.values.assign(values)
    field = replace(field, free=FreeCells.none(field.workers))
    sigma = field.storage.density_scale * np.log1p(np.exp(1.0 + field.storage.density_shift))
    places, radius = np.array([[0.0, 0.0, 0.8], [0.2, 0.1, -0.1]]), 0.3
    views = [
        View(
            name=str(place),
            camera=camera_at(look_at(tuple(place), (place[0], 3.0, place[2]))),
            image=np.zeros((6, 8, 3), np.uint8),
        )
        for place in places
    ]
    scene = Scene(
        name="even",
        views=views,
        splits={"train": (0, 1)},
        box_min=-np.ones(3),
        box_max=np.ones(3),
        unbounded=False,
        content_distance=10.0 * radius,
    )
    plan = near_plan(field, scene)
    assert plan is not None and plan.axes == (0, 1)
    n = len(plan.depths)
    cells = (np.arange(n) + 0.5) * plan.extent / n - 0.5 * plan.extent
    x, y = np.meshgrid(0.1 + cells, 0.05 + cells, indexing="ij")
    lengths = []
    for a, b, c in places:
        with np.errstate(invalid="ignore"):
            half = np.sqrt(radius**2 - (x - a) ** 2 - (y - b) ** 2)
        lengths.append(np.minimum(c + half, 1.0) - (c - half))
    truth = sigma * np.fmax(*lengths)
    assert np.array_equal(np.isnan(plan.depths), np.isnan(truth)) and np.isnan(truth).mean() > 0.1
    known = ~np.isnan(truth)
    off = np.abs(plan.depths - truth)[known]
    assert off.max() < 0.6 * sigma * field.steps.step  # of a step that the box cuts
    assert np.median(off) < 1e-3
    picture = near_picture(scene, {"a": plan, "b": plan})
    assert (picture == [214, 40, 40]).all(axis=2).any() and picture.shape[1] > 2 * 640
    far = replace(
        views[1], camera=replace(views[1].camera, c2w=look_at((600.0, 0.0, 0.0), (0.0, 0, 0))[:3])
    )
    wide = near_plan(field, replace(scene, views=[views[0], far]))
    assert wide is not None and (~np.isnan(wide.depths)).sum() == 2
    assert np.nanmax(wide.depths) == pytest.approx(sigma * 0.5, abs=0.6 * sigma * field.steps.step)
