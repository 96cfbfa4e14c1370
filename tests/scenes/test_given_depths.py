"""Bounds of depth and depth maps, by what photographs of a room show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import camera_at, look_at, picture, ring, save
from warpnerf.scenes.builtin.room import photograph
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.extent import photo_consistency
from warpnerf.scenes.extent.given_depths import believed_bounds, doubted_depths, pixels_of
from warpnerf.scenes.extent.photo_consistency import Agreement, PhotoConsistency
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import View

SIZE = {"width": 96, "height": 72, "fx": 75.0, "fy": 75.0, "cx": 48.0, "cy": 36.0}


@pytest.fixture(scope="module")
def views() -> list[View]:
    """Along a wall, looking at the opposite one, with true depth."""
    found = []
    for k, y in enumerate(np.linspace(-0.8, 0.8, 12)):
        pose = look_at((1.3, y, 1.2 + 0.2 * np.sin(3.0 * k)), (-1.5, 0.5 * y, 0.7))
        camera = camera_at(pose, **SIZE)
        image, depth = photograph(camera, 1)
        found.append(View(name=f"{k:03d}.png", camera=camera, image=image, depth=depth))
    return found


def told(views: list[View], change: Any) -> str:
    """Of depth maps that are changed."""
    assert all(view.depth is not None for view in views)
    changed = [replace(view, depth=change(view.depth)) for view in views]
    return "; ".join(doubted_depths(PhotoConsistency.of(changed)))


@pytest.mark.parametrize("times", [0.8, 1.0, 1.25])
def test_bounds_that_hold_what_photographs_show_are_used(views: list[View], times: float) -> None:
    bounds = times * np.tile([0.8, 4.5], (len(views), 1))
    found, said = believed_bounds(PhotoConsistency.of(views[1:]), views, bounds)
    assert found is bounds and said == []


@pytest.mark.parametrize("times", [1e-3, 0.1, 10.0, 1e3])
def test_bounds_in_other_units_are_not_used(views: list[View], times: float) -> None:
    bounds = times * np.tile([0.8, 4.5], (len(views), 1))
    found, said = believed_bounds(PhotoConsistency.of(views[1:]), views, bounds)
    assert found is None
    (said,) = said
    assert said.startswith("bounds of depth are not used: what the photographs show is not found")
    assert f"{0.8 * times:.4g} and {4.5 * times:.4g} scene units" in said


def test_photographs_that_fit_nothing_refute_no_depths() -> None:
    """Noise, and photographs that are too few."""
    views = [
        View(
            name=str(k),
            camera=camera_at(pose, **SIZE),
            image=picture(k, width=96, height=72),
            depth=np.full((72, 96), 1e3, np.float32),
        )
        for k, pose in enumerate(ring(9))
    ]
    bounds = np.tile([1e3, 2e3], (9, 1))
    noise = PhotoConsistency.of(views)
    found, said = believed_bounds(noise, views, bounds)
    assert found is bounds and said == []
    assert doubted_depths(noise) == [] == doubted_depths(PhotoConsistency.of(views[:3]))
    assert believed_bounds(noise, views, None) == (None, [])


def test_depth_maps_that_fit_are_believed(views: list[View]) -> None:
    assert told(views, lambda depth: depth) == ""
    holes = np.random.default_rng(0).uniform(size=(72, 96)) < 0.5
    assert told(views, lambda depth: np.where(holes, np.float32(np.nan), depth)) == ""


@pytest.mark.parametrize("lens", [{}, {"k1": -0.2, "p1": 0.01}, {"fisheye": True, "fx": 40.0}])
def test_a_map_is_read_where_the_lens_shows_what_a_pinhole_does(lens: dict[str, Any]) -> None:
    camera = camera_at(ring(1)[0], **(SIZE | lens))
    middles = np.random.default_rng(0).uniform(0.2, 0.8, (50, 2))
    row, column = pixels_of(camera, middles)
    shown = directions(camera, np.stack([column, row], axis=1) + 0.5)
    size, centre = np.array([96.0, 72.0]), np.array([48.0, 36.0])
    straight = (middles * size - centre) / [camera.fx, camera.fy]
    np.testing.assert_allclose(shown[:, :2] / -shown[:, 2:], straight * [1.0, -1.0], atol=0.03)


@pytest.mark.parametrize("unit", [1e-3, 5.0, 3.28084])
def test_depth_maps_in_other_units_are_told(views: list[View], unit: float) -> None:
    said = told(views, lambda depth: (unit * depth).astype(np.float32))
    assert f"do not fit the photographs, but times {1.0 / unit:.4g} they do" in said


def test_inverse_depths_and_depths_of_others_are_told(views: list[View]) -> None:
    said = "depth maps do not fit the photographs in any unit"
    assert told(views, lambda depth: (6.0 / depth).astype(np.float32)).startswith(said)
    assert told(views, lambda depth: np.full_like(depth, np.nan)) == ""


@pytest.mark.ci
def test_a_scene_file_tells_of_its_depths(
    views: list[View], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Metres that are read as millimetres, by .npy; nothing is compared twice."""
    compared: list[bytes] = []

    def agreement(**both: Any) -> Agreement:
        compared.append(both["found"].tobytes())
        return Agreement(**both)

    monkeypatch.setattr(photo_consistency, "Agreement", agreement)
    frames = []
    for view in views:
        Image.fromarray(view.image).save(tmp_path / view.name)
        camera = view.camera
        v, u = np.mgrid[:72, :96] + 0.5
        ray = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)])
        np.save(tmp_path / f"{view.name}.npy", view.depth / np.linalg.norm(ray, axis=0))
        frames.append(
            {
                "file_path": view.name,
                "depth_file_path": f"{view.name}.npy",
                "transform_matrix": [*camera.c2w.tolist(), [0.0, 0.0, 0.0, 1.0]],
            }
        )
    lens = {"w": 96, "h": 72, "fl_x": 75.0}
    for unit, warnings in ((1.0, 0), (1e-3, 1)):
        save(
            tmp_path / "transforms.json",
            {**lens, "depth_unit_scale_factor": unit, "frames": frames},
        )
        compared.clear()
        said = [text for text in load_scene(tmp_path).warnings if text.startswith("depth maps")]
        assert len(said) == warnings
        assert len(compared) == len(set(compared)) > 0
