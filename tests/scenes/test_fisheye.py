"""A fisheye lens from photographs to pictures: it trains as well as a lens without distortion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import warpnerf as wn
from tests.support.small_model import SQUARED
from tests.support.tiny_scenes import save
from warpnerf.config import GridConfig
from warpnerf.evaluation.evaluate import evaluate
from warpnerf.inspection.inspection import inspect
from warpnerf.media.camera_path import camera_path
from warpnerf.media.scene_plan import plan_picture
from warpnerf.scenes.builtin.room import photograph, room_scene
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import directions
from warpnerf.scenes.scene import Scene, View

LENS: dict[str, Any] = {"fx": 20.0, "fy": 20.0, "k1": 0.06, "k2": -0.02, "fisheye": True}
"""Of pictures of 40 x 30 pixels: 110 degrees across, 137 from corner to corner."""
SOURCE = {"width": 320, "height": 240, "fx": 60.0, "fy": 60.0, "cx": 160.0, "cy": 120.0}
"""A camera without distortion, whose picture holds all that the fisheye sees."""


def through_fisheye(view: View) -> View:
    """A view of the room, photographed again through the lens."""
    camera = replace(view.camera, **LENS)
    picture, _ = photograph(replace(view.camera, **SOURCE), samples=1)
    fine = 4  # samples along each side of a pixel
    v, u = (np.indices((fine * camera.height, fine * camera.width)) + 0.5) / fine
    seen = directions(camera, np.stack([u.ravel(), v.ravel()], axis=1))
    x, y = seen[:, 0] / -seen[:, 2], -seen[:, 1] / -seen[:, 2]
    across = (SOURCE["fx"] * x + SOURCE["cx"] - 0.5).reshape(u.shape).astype(np.float32)
    along = (SOURCE["fy"] * y + SOURCE["cy"] - 0.5).reshape(u.shape).astype(np.float32)
    assert across.min() > 0 and across.max() < 319 and along.min() > 0 and along.max() < 239
    sampled = cv2.remap(picture, across, along, cv2.INTER_LINEAR)
    blocks = sampled.reshape(camera.height, fine, camera.width, fine, 3)
    image = blocks.mean(axis=(1, 3)).round().astype(np.uint8)
    return View(name=view.name, camera=camera, image=image)


@pytest.fixture(scope="module")
def rooms() -> tuple[Scene, Scene]:
    """The room with 40 training views, without distortion and through the fisheye."""
    room = room_scene(4)
    chosen = [*room.splits["test"], *room.splits["train"][::3]]
    views = [replace(room.views[index], depth=None) for index in chosen]
    splits = {"test": tuple(range(10)), "train": tuple(range(10, len(views)))}
    plain = replace(room, views=views, splits=splits, photograph=None)
    return plain, replace(plain, views=[through_fisheye(view) for view in views])


def psnr(train: Scene, test: Scene, device: str) -> float:
    config = wn.TrainConfig(
        model="rgb",
        loss=SQUARED,
        steps=400,
        rays_per_step=2048,
        grid=GridConfig(voxels=32**3),
        device=device,
    )
    return evaluate(wn.train(train, config).field, test).mean["psnr"]


@pytest.mark.slow  # three trainings of seconds
def test_it_trains_as_well_as_a_lens_without_distortion(
    rooms: tuple[Scene, Scene], device: str
) -> None:
    plain, bent = rooms
    with_it = psnr(bent, bent, device)
    assert with_it > psnr(plain, plain, device) - 1.0
    without = {"k1": 0.0, "k2": 0.0, "fisheye": False}
    views = [replace(view, camera=replace(view.camera, **without)) for view in bent.views]
    mistaken = replace(bent, views=views)
    assert psnr(mistaken, mistaken, device) < with_it - 1.0


@pytest.mark.ci
def test_it_is_inspected_drawn_and_filmed(rooms: tuple[Scene, Scene], tmp_path: Path) -> None:
    _, bent = rooms
    frames = []
    for view in bent.views[10:22]:
        Image.fromarray(view.image).save(tmp_path / view.name)
        pose = view.camera.c2w.tolist()
        frames.append({"file_path": view.name, "transform_matrix": pose})
    lens = {"fl_x": 20.0, "k1": 0.06, "k2": -0.02, "camera_model": "OPENCV_FISHEYE"}
    save(tmp_path / "transforms.json", {**lens, "frames": frames})
    found = inspect(tmp_path)
    facts = found.facts()
    assert facts["fisheye"] == 12 and facts["distortion"] == {"k1": [0.06] * 2, "k2": [-0.02] * 2}
    # theta (1 + k1 theta^2 + k2 theta^4) is 1 at half the width, 0.75 at half the height.
    for (low, high), distorted in zip(facts["field_of_view"], (1.0, 0.75), strict=True):
        angle = np.radians(low) / 2
        assert low == high
        assert angle + 0.06 * angle**3 - 0.02 * angle**5 == pytest.approx(distorted)
    assert "fisheye, k1 0.06, k2 -0.02" in str(found)
    assert plan_picture(found).std() > 10.0
    lenses = camera_path(found.scene, "through", n_frames=3)
    assert not any(camera.fisheye or camera.k1 for camera in lenses)
    half = np.radians(facts["field_of_view"][1][0]) / 2
    assert lenses[0].fx == pytest.approx(15.0 / np.tan(half))


def test_a_plan_shows_what_a_wide_lens_sees() -> None:
    """Corners of an image of 240 degrees lie behind the camera's plane."""
    camera = Camera(
        **{"width": 100, "height": 100, "fx": 33.76, "fy": 33.76, "cx": 50.0, "cy": 50.0},
        c2w=np.eye(3, 4),
        fisheye=True,
    )
    corner = directions(camera, np.array([[0.0, 0.0]]))[0]
    assert np.degrees(np.arccos(-corner[2])) == pytest.approx(120.0, abs=0.1)
    np.testing.assert_allclose(
        corner[:2], np.sin(np.radians(120.0)) * np.array([-1, 1]) / 2**0.5, atol=1e-3
    )
