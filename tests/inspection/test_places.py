"""Where cameras stand: far off, on their heads, in other units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.inspection.test_inspection import odd, scene_with
from tests.support.tiny_scenes import look_at, ring
from warpnerf.inspection.inspection import inspect


def test_a_camera_far_away_and_one_upside_down(tmp_path: Path) -> None:
    poses = ring(9)
    poses[3] = look_at((300.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    poses[5] = poses[5] @ np.diag([-1.0, -1.0, 1.0, 1.0])
    found = odd(inspect(scene_with(tmp_path, poses)))
    assert "far away from all others: 1 of 9 cameras (first: images/003.png)" in found
    assert "upside down against the others: 1 of 9 cameras (first: images/005.png)" in found


@pytest.mark.parametrize("n", [2, 4])
def test_cameras_in_other_units_are_far_away(tmp_path: Path, n: int) -> None:
    poses = ring(10)
    for pose in poses[:n]:
        pose[:3, 3] *= 1000.0
    found = odd(inspect(scene_with(tmp_path, poses)))
    assert f"far away from all others: {n} of 10 cameras (first: images/000.png)" in found
    assert "or in other units" in found


@pytest.mark.parametrize("unit", [100.0, 1000.0])
def test_cameras_of_which_half_are_in_other_units_are_named(tmp_path: Path, unit: float) -> None:
    poses = ring(10)
    for k, pose in enumerate(poses):
        pose[:3, 3] = (pose[:3, 3] + [4.0, 0.0, 0.0]) * (unit if k % 2 else 1.0)
    found = odd(inspect(scene_with(tmp_path, poses)))
    said = f"in other units: 5 of 10 (first: images/001.png) are about {unit:.2g} times as far"
    assert said in found and "far away" not in found


def in_two_places(
    folder: Path, width: float, other: float, apart: float, is_point: bool = False
) -> str:
    """What is said of 10 cameras in a place so wide, and of as many in another one."""
    rng = np.random.default_rng(3)
    poses = ring(20)
    for k, pose in enumerate(poses):
        off = rng.normal(0.0, 1.0, 3)
        off *= (width if k < 10 else other) / np.linalg.norm(off)
        pose[:3, 3] = off * (not is_point) + [1.0, apart if k >= 10 else 0.0, 0.0]
    return odd(inspect(scene_with(folder, poses)))


@pytest.mark.parametrize(
    "places",
    [
        (0.03, 0.03, 3.0),  # by hand
        (0.03, 0.03, 3.0, True),  # of a panorama's faces
        (0.005, 0.25, 0.02),  # near a thing, and around it
        (0.003, 0.3, 30.0),
        (3.0, 3.0, 30.0),  # two rooms
    ],
)
def test_two_places_are_in_the_same_units(tmp_path: Path, places: tuple[float, ...]) -> None:
    """Neither is far away from all others."""
    said = in_two_places(tmp_path, *places[:3], is_point=len(places) > 3)
    assert "far away" not in said and "units" not in said


@pytest.mark.parametrize(("scale", "says"), [(1e-5, True), (1.0, False)])
def test_degrees_of_longitude_and_latitude_are_named(
    tmp_path: Path, scale: float, says: bool
) -> None:
    poses = ring(9)
    for k, pose in enumerate(poses):
        pose[:3, 3] = pose[:3, 3] * [scale, scale, 1.0] + [18.06, 59.33, 20.0 + 0.3 * k]
    found = odd(inspect(scene_with(tmp_path, poses)))
    assert ("degrees of longitude and latitude" in found) == says


@pytest.mark.parametrize(
    ("offset", "wide"),
    [
        ((0.0, 1.6, 0.0), (0.0, 0.0)),  # a track
        ((3.0, 2.0, 0.0), (1e-4, 1e-4)),  # up a pole
        ((12.0, 8.0, 0.0), (1e-3, 0.0)),
        ((12.0, 8.0, 0.0), (0.0, 1e-3)),
        ((12.0, 8.0, 0.0), (1e-7, 1e-7)),
        ((120.0, 98.0, 0.0), (1e-3, 1e-3)),
        ((12.0, 170.0, 0.0), (0.025, 0.05)),
    ],
)
def test_straight_tracks_are_no_degrees(
    tmp_path: Path, offset: tuple[float, ...], wide: tuple[float, float]
) -> None:
    poses = ring(9)
    for k, pose in enumerate(poses):
        pose[:3, 3] = [wide[0] * (k % 3), wide[1] * (k % 2), -0.3 * k]
        pose[:3, 3] += offset
    assert "degrees" not in odd(inspect(scene_with(tmp_path, poses)))
