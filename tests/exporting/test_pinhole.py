"""Undistortion: pixels of the new picture show what lies in the same direction in the old one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.exporting.test_cameras import ball_scene
from tests.support.solid_fields import LEVEL, ball_field
from warpnerf.checks import InputError
from warpnerf.exporting.export import ExportOptions, export
from warpnerf.exporting.pinhole import pinhole_scene
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene, View

LENSES: dict[str, dict[str, Any]] = {
    "barrel": {"k1": -0.15, "k2": 0.02, "p1": 0.003},
    "pincushion": {"k1": 0.1},
    "rational": {"k1": 0.3, "k4": 0.2, "k5": 0.01, "k6": 0.002},
    "fisheye": {"fisheye": True, "k1": 0.02, "k2": 0.01},
}


def shown(ways: np.ndarray) -> np.ndarray:
    """What lies in directions, smooth, [..., 3] in [0, 1]."""
    return np.asarray(0.5 + 0.45 * np.sin(4.0 * ways))


def photograph(lens: dict[str, Any]) -> Scene:
    camera = replace(
        Camera(width=120, height=90, fx=80.0, fy=82.0, cx=63.0, cy=43.0, c2w=np.eye(3, 4)), **lens
    )
    u, v = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    ways = directions(camera, np.stack([u.ravel(), v.ravel()], axis=1)).reshape(90, 120, 3)
    image = np.round(255.0 * shown(ways)).astype(np.uint8)
    left = np.broadcast_to(np.arange(120) < 70, (90, 120))
    views = [
        View(name="a/1.jpg", camera=camera, image=image, mask=left),
        View(name="a/2.JPG", camera=camera, image=image),
    ]
    return replace(ball_scene(), views=views, splits={"train": (0, 1), "test": ()})


@pytest.mark.parametrize("name", LENSES)
def test_a_pixel_shows_what_lies_in_its_direction(name: str) -> None:
    scene = photograph(LENSES[name])
    for old, new in zip(scene.views, pinhole_scene(scene).views, strict=True):
        camera = new.camera
        assert not camera.fisheye and camera.k1 == camera.p1 == camera.k4 == 0.0
        assert (camera.width, camera.height, camera.cx, camera.cy) == (120, 90, 60.0, 45.0)
        u, v = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
        x, y = (u - camera.cx) / camera.fx, (camera.cy - v) / camera.fy
        ways = np.stack([x, y, -np.ones_like(x)], axis=-1)
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        np.testing.assert_allclose(new.image / 255.0, shown(ways), atol=0.02)
        if old.mask is None:
            assert new.mask is None or name == "fisheye"
        else:
            assert new.mask is not None
            points = np.stack([x, -y], axis=-1).reshape(-1, 2)
            at = old.camera.distort(points)[0][:, 0] * old.camera.fx + old.camera.cx
            np.testing.assert_array_equal(new.mask.ravel()[at < 69.0], True)
            np.testing.assert_array_equal(new.mask.ravel()[at > 70.5], False)


def test_no_picture_gets_smaller_than_it_has_to() -> None:
    """Some point of two opposite sides lies on the border of the photograph."""
    camera = pinhole_scene(photograph(LENSES["barrel"])).views[0].camera
    old = photograph(LENSES["barrel"]).views[0].camera
    sides = np.linspace(-1.0, 1.0, 101)
    half = (0.5 * 120 / camera.fx, 0.5 * 90 / camera.fy)
    at = [
        old.distort(np.stack([s * half[0] * np.ones(101), sides * half[1]], axis=1))[0]
        * (old.fx, old.fy)
        + (old.cx, old.cy)
        for s in (-1.0, 1.0)
    ]
    assert -0.5 < at[0][:, 0].min() < 1.5 or 118.5 < at[1][:, 0].max() < 120.5


@pytest.mark.ci
def test_the_folder_has_pinhole_cameras_only(tmp_path: Path) -> None:
    scene = ball_scene(k1=0.1, k2=0.02)
    export(
        ball_field(),
        tmp_path / "out",
        scene=scene,
        level=LEVEL,
        options=ExportOptions(pinhole=True),
    )
    lines = (tmp_path / "out" / "sparse" / "0" / "cameras.txt").read_text().splitlines()[1:]
    assert lines and all(line.split()[1] == "PINHOLE" for line in lines)
    assert sorted(path.name for path in (tmp_path / "out" / "images").iterdir())[0] == "a_00.png"
    read = load_scene(tmp_path / "out")
    np.testing.assert_allclose(read.views[3].camera.c2w, scene.views[3].camera.c2w, atol=1e-12)
    with pytest.raises(InputError, match="undistortion is of folders, and there is none"):
        export(
            ball_field(),
            tmp_path / "a.ply",
            scene=scene,
            level=LEVEL,
            options=ExportOptions(pinhole=True),
        )
