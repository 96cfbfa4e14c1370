"""Blender / NeRF-synthetic scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import (
    DATA,
    needs_capture,
    picture,
    ring,
    save,
    transforms_content,
    write_blender,
)
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


def test_splits_are_loaded(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(5))
    write_blender(tmp_path, "val", ring(2, height=1.5))
    write_blender(tmp_path, "test", ring(3, height=2.0))
    scene = load_scene(tmp_path)
    names = [view.name for view in scene.views]
    assert names == sorted(names)
    by_split = {split: [names[i] for i in scene.splits[split]] for split in scene.splits}
    assert by_split == {
        "train": [f"train/r_{i}.png" for i in range(5)],
        "val": [f"val/r_{i}.png" for i in range(2)],
        "test": [f"test/r_{i}.png" for i in range(3)],
    }
    view = scene.views[scene.splits["train"][2]]
    np.testing.assert_array_equal(view.image, picture(2, channels=4))
    assert view.camera.fx == pytest.approx(0.5 * 8 / np.tan(0.5 * 0.6911112070083618))
    assert (view.camera.fy, view.camera.cx, view.camera.cy) == (view.camera.fx, 4.0, 3.0)
    assert not scene.unbounded
    # from the training cameras alone
    assert scene.content_distance == pytest.approx(np.sqrt(10.0))
    half = np.sqrt(10.0) * np.tan(0.5 * 0.6911112070083618)
    np.testing.assert_allclose(scene.box_max, half)
    np.testing.assert_allclose(scene.box_min, -half)


@pytest.mark.parametrize("opaque_alpha", [False, True])
def test_without_transparency_content_goes_on_outside(tmp_path: Path, opaque_alpha: bool) -> None:
    write_blender(tmp_path, "train", ring(5), channels=3)
    if opaque_alpha:
        for path in (tmp_path / "train").iterdir():
            Image.open(path).convert("RGBA").save(path)
    assert load_scene(tmp_path).unbounded


def test_without_test_file_every_eighth_image_is_for_testing(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(9))
    scene = load_scene(tmp_path)
    assert scene.splits == {"train": (1, 2, 3, 4, 5, 6, 7), "test": (0, 8)}
    assert any("every 8th image" in note for note in scene.notes)


def test_blender_goes_before_transforms_unless_that_is_named(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(5))
    content = transforms_content(5)
    for i, frame in enumerate(content["frames"]):
        frame["file_path"] = f"train/r_{i}"
    save(tmp_path / "transforms.json", content)
    angle_focal = pytest.approx(11.12, abs=0.01)
    assert load_scene(tmp_path).views[0].camera.fx == angle_focal
    assert load_scene(tmp_path / "transforms_train.json").views[0].camera.fx == angle_focal
    assert load_scene(tmp_path / "transforms.json").views[0].camera.fx == 10.0


def test_extension_and_per_frame_lens_are_accepted(tmp_path: Path) -> None:
    content = write_blender(tmp_path, "train", ring(4))
    content["frames"][0]["file_path"] += ".png"
    content["frames"][1] |= {"fl_x": 9.0, "k1": 0.02}
    save(tmp_path / "transforms_train.json", content)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == [f"train/r_{i}.png" for i in range(4)]
    assert (scene.views[1].camera.fx, scene.views[1].camera.k1) == (9.0, 0.02)


def test_missing_images_are_counted_per_file(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(5))
    write_blender(tmp_path, "test", ring(3))
    (tmp_path / "test/r_1.png").unlink()
    assert any(
        "transforms_test.json: left out 1 of 3 frames for want of an image" in note
        for note in load_scene(tmp_path).warnings
    )


def test_same_images_for_training_and_testing_are_noted(tmp_path: Path) -> None:
    content = write_blender(tmp_path, "train", ring(4))
    save(tmp_path / "transforms_test.json", content)
    scene = load_scene(tmp_path)
    assert scene.splits == {"train": (0, 1, 2, 3), "test": (0, 1, 2, 3)}
    assert any(
        "used for training and for testing: 4 of 4 images" in note for note in scene.warnings
    )


def test_message_names_the_file_of_the_split(tmp_path: Path) -> None:
    write_blender(tmp_path, "train", ring(4))
    content = write_blender(tmp_path, "test", ring(3))
    del content["camera_angle_x"]
    save(tmp_path / "transforms_test.json", content)
    with pytest.raises(InputError, match=r"transforms_test\.json: .*has no focal length"):
        load_scene(tmp_path)


def test_test_file_alone_is_read_only_where_it_is_named(tmp_path: Path) -> None:
    write_blender(tmp_path, "test", ring(4))
    with pytest.raises(InputError, match=r"no scene found: it holds transforms_test\.json; use "):
        load_scene(tmp_path)
    assert len(load_scene(tmp_path / "transforms_test.json").views) == 4


@needs_capture("lego_200")
def test_lego_is_loaded() -> None:
    scene = load_scene(DATA / "lego_200")
    assert {split: len(members) for split, members in scene.splits.items()} == {
        "train": 100,
        "val": 25,
        "test": 50,
    }
    assert not scene.unbounded
    assert scene.content_distance == pytest.approx(4.031, abs=0.001)
    np.testing.assert_allclose(scene.box_max, 1.451, atol=0.001)
    np.testing.assert_allclose(scene.box_min, -1.451, atol=0.001)
    assert scene.views[0].image.shape == (200, 200, 4)


@pytest.mark.parametrize("frames", [3, 0])
def test_a_split_without_pictures_is_not_used(tmp_path: Path, frames: int) -> None:
    """As cameras of a path are written beside renderings for training."""
    write_blender(tmp_path, "train", ring(9))
    content = write_blender(tmp_path, "test", ring(3))
    for image in (tmp_path / "test").iterdir():
        image.unlink()
    save(tmp_path / "transforms_test.json", {**content, "frames": content["frames"][:frames]})
    scene = load_scene(tmp_path)
    assert (len(scene.views), len(scene.splits["test"])) == (9, 2)
    (warning,) = scene.warnings
    first = r" (first: ./test/r_0)" if frames else ""
    assert warning == (
        f"transforms_test.json is not used: none of the {frames} images that it names is in the "
        f"folder{first}"
    )
    for image in (tmp_path / "train").iterdir():
        image.unlink()
    with pytest.raises(InputError, match=r"transforms_train\.json: .* no image of 9 frames is in"):
        load_scene(tmp_path)
