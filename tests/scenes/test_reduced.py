"""images_2 beside images: used for --downscale 2 where it is the same reduced, else mentioned."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import scene_with_model
from tests.support.tiny_scenes import picture, write_transforms
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.images.images import box_filter


def write_reduced(folder: Path, suffix: str = ".png") -> None:
    """images_2, each pixel of which is brighter by one than the mean of four."""
    (folder / "images_2").mkdir()
    for path in (folder / "images").iterdir():
        small = np.minimum(box_filter(np.array(Image.open(path)), 2), 254) + 1
        Image.fromarray(small).save(folder / "images_2" / f"{path.stem}{suffix}")


def smaller(folder: Path) -> None:
    Image.fromarray(picture(0, width=3, height=3)).save(folder / "images_2/001.png")


def another(folder: Path) -> None:
    Image.fromarray(picture(9, width=4, height=3)).save(folder / "images_2/000.png")


def fewer(folder: Path) -> None:
    (folder / "images_2/002.png").unlink()


def damaged(folder: Path) -> None:
    (folder / "images_2/002.png").write_bytes(b"none")


def with_alpha(folder: Path) -> None:
    Image.fromarray(picture(0, width=4, height=3, channels=4)).save(folder / "images_2/001.png")


@pytest.mark.parametrize("colmap", [False, True])
def test_reduced_photographs_are_used(tmp_path: Path, colmap: bool) -> None:
    if colmap:
        scene_with_model(tmp_path)
    else:
        write_transforms(tmp_path)
    plain = load_scene(tmp_path, downscale=2)
    write_reduced(tmp_path)
    scene = load_scene(tmp_path, downscale=2)
    for view, before in zip(scene.views, plain.views, strict=True):
        path = tmp_path / "images_2" / Path(view.name).name
        assert np.array_equal(view.image, np.array(Image.open(path)))
        assert view.camera.fx == before.camera.fx
        assert view.camera.cx == before.camera.cx
    assert any("the photographs of images_2 are used" in note for note in scene.notes)
    assert load_scene(tmp_path).views[0].image.shape == (6, 8, 3)
    whole = load_scene(tmp_path, downscale=3)
    assert whole.views[0].image.shape == (2, 2, 3)
    assert not scene.warnings


def test_reduced_photographs_whose_alpha_is_ignored_are_used(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for path in (tmp_path / "images").iterdir():
        pixels = np.dstack([np.array(Image.open(path)), np.full((6, 8), 255, np.uint8)])
        Image.fromarray(pixels).save(path)
    write_reduced(tmp_path)
    scene = load_scene(tmp_path, downscale=2)
    for view in scene.views:
        path = tmp_path / "images_2" / Path(view.name).name
        assert np.array_equal(view.image, np.array(Image.open(path))[..., :3])


def test_reduced_photographs_may_have_another_extension(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    for k in range(4):  # noise of so few pixels would not survive JPEG
        Image.new("RGB", (8, 6), (10 * k, 20, 30)).save(tmp_path / f"images/{k:03d}.png")
    write_reduced(tmp_path, suffix=".jpg")
    scene = load_scene(tmp_path, downscale=2)
    assert np.abs(scene.views[2].image - [21.0, 21.0, 31.0]).max() < 5.0
    assert any("the photographs of images_2 are used" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("act", "says"),
    [
        (smaller, "001.png has 3x3 pixels there and 8x6 in images, which is not 2 times as many"),
        (another, "000.png shows something else there"),
        (fewer, "it lacks 1 of 4 photographs (first: images/002.png)"),
        (damaged, "one of its photographs, or of the others, is damaged"),
        (with_alpha, "001.png has alpha there or in images, but not in both"),
    ],
)
def test_others_are_not_used_and_said(
    tmp_path: Path, act: Callable[[Path], None], says: str
) -> None:
    write_transforms(tmp_path)
    plain = load_scene(tmp_path, downscale=2)
    write_reduced(tmp_path)
    act(tmp_path)
    scene = load_scene(tmp_path, downscale=2)
    assert np.array_equal(scene.views[0].image, plain.views[0].image)
    assert any(f"images_2 is not used, as {says}" in note for note in scene.notes)
