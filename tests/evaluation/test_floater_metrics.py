"""Density around cameras, measured in fields whose density is known."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base.types import vector

from tests.support.tiny_fields import tiny_field
from tests.support.tiny_scenes import camera_at
from warpnerf.evaluation.floater_metrics import clearance, directions_around, near_density


def inside() -> Any:
    pose = np.eye(4)
    pose[:3, 3] = (0.1, -0.2, 0.3)
    return camera_at(pose)


def first_hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """A wall at x = 0.5, far away everywhere else."""
    with np.errstate(divide="ignore"):
        t = (0.5 - origins[:, 0]) / directions[:, 0]
    return np.where(t > 0.0, t, 100.0)


def test_directions_are_spread_evenly() -> None:
    directions = directions_around(500)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0)
    np.testing.assert_allclose(directions.mean(axis=0), 0.0, atol=0.01)
    np.testing.assert_allclose(directions.T @ directions / 500, np.eye(3) / 3.0, atol=0.01)


def test_clearance_is_the_distance_to_the_nearest_wall() -> None:
    assert clearance(inside(), first_hit) == pytest.approx(0.4, rel=1e-3)


@pytest.mark.parametrize("raw_density", [0.7, 13.0])
def test_near_density_is_density_times_clearance(raw_density: float) -> None:
    """Also where hardly any light is left: rays in it end nowhere else."""
    field = tiny_field()
    raw = np.zeros((5 * 6 * 7, 4), np.float32)
    raw[:, 0] = raw_density
    grid = replace(field.storage, values=wp.array(raw, dtype=vector(4), device="cpu"))
    steps = replace(field.steps, near=0.0, step=0.001)
    field = replace(field, storage=grid, steps=steps)
    sigma = grid.density_scale * np.log1p(np.exp(raw_density + grid.density_shift))
    measured = near_density(field, [inside(), inside()], first_hit)
    assert sigma * 0.4 > 0.5
    assert measured == pytest.approx(sigma * 0.4, rel=0.01)


def test_empty_space_has_none() -> None:
    assert near_density(tiny_field(density=-60.0), [inside()], first_hit) < 1e-5
