"""transforms.json: tiny scenes and real captures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_points import write_ply
from tests.support.tiny_scenes import (
    DATA,
    needs_capture,
    picture,
    save,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.scenes.files import by_number
from warpnerf.scenes.formats.load import load_scene


def load_changed(folder: Path, change: Callable[[dict[str, Any]], None], n: int = 4) -> Any:
    content = write_transforms(folder, n)
    change(content)
    save(folder / "transforms.json", content)
    return load_scene(folder)


@pytest.mark.parametrize("root", ["/home/other/data/scene/", "C:\\data\\scene\\"])
def test_files_of_another_machine_are_found_in_the_folder(tmp_path: Path, root: str) -> None:
    """Their absolute paths were refused, though the files lie there."""
    content = write_transforms(tmp_path)
    (tmp_path / "masks").mkdir()
    mask = np.full((6, 8), 255, np.uint8)
    mask[:2] = 0
    for frame in content["frames"]:
        name = frame["file_path"].rpartition("/")[2]
        Image.fromarray(mask).save(tmp_path / "masks" / name)
        frame["mask_path"] = f"{root}masks/{name}"
    content["ply_file_path"] = f"{root}points.ply"
    content["test_filenames"] = [f"{root}images/002.png"]
    save(tmp_path / "transforms.json", content)
    write_ply(tmp_path / "points.ply", np.random.default_rng(0).normal(0.0, 0.3, (200, 3)))
    scene = load_scene(tmp_path)
    assert all(view.mask is not None for view in scene.views) and scene.points is not None
    assert [scene.views[i].name for i in scene.splits["test"]] == ["images/002.png"]
    (tmp_path / "points.ply").unlink()
    with pytest.raises(InputError, match=r"ply_file_path: .* leaves the scene's folder"):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("masks", "named"),
    [
        ("", "/home/other/scene/masks/images/{k:03d}.png"),
        ("", "/home/other/scene/images/{k:03d}.png"),
        ("masks", "/home/other/masks{k}/masks/000.png"),
        (".", "/home/other/{k:03d}/000.png"),
        (".", "C:\\data\\scene\\mask_{k:03d}.png"),
    ],
)
def test_files_of_another_machine_are_none_of_another_path(
    tmp_path: Path, masks: str, named: str
) -> None:
    """Photographs were taken for their own masks, and one file for those of all."""
    content = write_transforms(tmp_path)
    for k, frame in enumerate(content["frames"]):
        frame["mask_path"] = named.format(k=k)
        if masks:
            (tmp_path / masks).mkdir(exist_ok=True)
            for name in (f"{k:03d}.png", f"mask_{k:03d}.png"):
                Image.new("L", (8, 6), 255).save(tmp_path / masks / name)
    save(tmp_path / "transforms.json", content)
    with pytest.raises(InputError, match=r"mask_path: .* leaves the scene's folder"):
        load_scene(tmp_path)


@pytest.mark.parametrize("listed", ["002.png", "002", "./images/002.png", "scene/images/002.png"])
def test_lists_may_name_photographs_by_the_ends_of_their_paths(tmp_path: Path, listed: str) -> None:
    content = write_transforms(tmp_path)
    for frame in content["frames"]:
        frame["file_path"] = (
            f"scene/{frame['file_path']}" if "scene" in listed else frame["file_path"]
        )
    save(tmp_path / "transforms.json", content | {"test_filenames": [listed]})
    scene = load_scene(tmp_path)
    assert [scene.views[i].name for i in scene.splits["test"]] == ["images/002.png"]
    assert not scene.warnings


def test_tiny_scene_is_loaded(tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "ring", 9)
    scene = load_scene(tmp_path / "ring")
    assert scene.name == "ring"
    assert [view.name for view in scene.views] == [f"images/{i:03d}.png" for i in range(9)]
    assert scene.splits == {"train": (1, 2, 3, 4, 5, 6, 7), "test": (0, 8)}
    assert scene.unbounded
    assert scene.content_distance == pytest.approx(np.sqrt(10.0))
    np.testing.assert_allclose(scene.box_min, -0.75 * np.sqrt(10.0))
    np.testing.assert_allclose(scene.box_max, 0.75 * np.sqrt(10.0))
    for i, view in enumerate(scene.views):
        np.testing.assert_array_equal(view.image, picture(i))
        np.testing.assert_allclose(view.camera.c2w, content["frames"][i]["transform_matrix"][:3])
        assert (view.camera.width, view.camera.height) == (8, 6)
        assert (view.camera.fx, view.camera.fy) == (10.0, 11.0)
        assert (view.camera.cx, view.camera.cy) == (4.25, 2.75)
    assert any("every 8th image" in note for note in scene.notes)
    assert any("content distance 3.16: median depth of the point" in note for note in scene.notes)


def test_file_may_be_named_and_have_another_name(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    content["fl_x"] = 20.0
    save(tmp_path / "transforms_v2.json", content)
    assert load_scene(str(tmp_path / "transforms.json")).views[0].camera.fx == 10.0
    assert load_scene(tmp_path / "transforms_v2.json").views[0].camera.fx == 20.0


def test_relative_folder_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_transforms(tmp_path / "ring")
    monkeypatch.chdir(tmp_path)
    assert load_scene("ring").name == "ring"
    monkeypatch.chdir(tmp_path / "ring")
    assert load_scene(".").name == "ring"
    assert load_scene("transforms.json").name == "ring"


def test_frames_are_sorted_by_name(tmp_path: Path) -> None:
    scene = load_changed(tmp_path, lambda c: c["frames"].reverse())
    names = [view.name for view in scene.views]
    assert names == sorted(names)
    np.testing.assert_array_equal(scene.views[0].image, picture(0))


def test_split_of_the_file_is_used(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["train_filenames"] = ["images/000.png", r".\images\001.png", "images/009.png"]
        content["val_filenames"] = ["images/002.png"]
        content["test_filenames"] = ["images/003.png"]

    scene = load_changed(tmp_path, change, n=5)
    assert scene.splits == {"train": (0, 1), "val": (2,), "test": (3,)}
    assert len(scene.views) == 4
    assert any(
        "not among the frames: 1 of 3 train_filenames (first: images/009.png)" in note
        for note in scene.warnings
    )
    assert any(
        "in no split and not used: 1 of 5 images (first: images/004.png)" in note
        for note in scene.notes
    )


def test_split_without_training_names_trains_on_the_rest(tmp_path: Path) -> None:
    scene = load_changed(tmp_path, lambda c: c.update(test_filenames=["images/002.png"]))
    assert scene.splits == {"train": (0, 1, 3), "test": (2,)}


def test_image_in_both_splits_is_noted(tmp_path: Path) -> None:
    names = [f"images/{i:03d}.png" for i in range(4)]
    scene = load_changed(
        tmp_path, lambda c: c.update(train_filenames=names, test_filenames=names[:1])
    )
    assert scene.splits == {"train": (0, 1, 2, 3), "test": (0,)}
    assert any(
        "used for training and for testing: 1 of 4 images" in note for note in scene.warnings
    )


def test_missing_images_are_counted(tmp_path: Path) -> None:
    write_transforms(tmp_path, 6)
    (tmp_path / "images/001.png").unlink()
    (tmp_path / "images/004.png").unlink()
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert any(
        "left out 2 of 6 frames for want of an image (first: images/001.png)" in note
        for note in scene.warnings
    )


def test_image_listed_twice_is_noted(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        again = dict(content["frames"][1], file_path="./images/../images/001.png")
        content["frames"].append(again)

    scene = load_changed(tmp_path, change)
    assert len(scene.views) == 4
    assert any(
        "left out 1 of 5 frames for naming an image again" in note for note in scene.warnings
    )


def test_keys_that_change_the_picture_are_named(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        content["frames"][2]["white_transparent"] = True
        content["frames"][2]["depth_file_path"] = "depth/002.png"
        content |= {"aabb_scale": 4, "scale": 0.33, "offset": [0.5, 0.5, 0.5]}
        content |= {"rolling_shutter": [0, 0.0, 0, 0], "mask_color": []}
        content["applied_transform"] = np.eye(4)[:3].tolist()

    scene = load_changed(tmp_path, change)
    assert [note for note in scene.warnings if "is not used" in note] == [
        "transforms.json: white_transparent is not used: white stays opaque"
    ]
    scene = load_changed(tmp_path / "b", lambda c: c.update(rolling_shutter=[0, 0, 0.1, 0]))
    assert scene.warnings == (
        "transforms.json: rolling_shutter is not used: each image is taken at one instant",
    )
    assert scene.content_distance == pytest.approx(np.sqrt(10.0))


def test_lens_of_a_frame_goes_before_that_of_the_file(tmp_path: Path) -> None:
    scene = load_changed(tmp_path, lambda c: c["frames"][1].update(fl_x=12.0, k1=0.01))
    assert [view.camera.fx for view in scene.views] == [10.0, 12.0, 10.0, 10.0]
    assert [view.camera.k1 for view in scene.views] == [0.0, 0.01, 0.0, 0.0]


def with_sizes(folder: Path, other: tuple[int, int], **lens: float) -> list[str]:
    """Warnings of lenses, where one of four images of 8x6 pixels has another size."""
    content = write_transforms(folder)
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del content[key]
    save(folder / "transforms.json", content | lens)
    width, height = other
    Image.fromarray(picture(1, width=width, height=height)).save(folder / "images/001.png")
    warnings = load_scene(folder).warnings
    return [warning for warning in warnings if "sizes" in warning or "is used" in warning]


def test_one_lens_for_images_of_other_sizes_is_told(tmp_path: Path) -> None:
    """An angle holds for reduced images, and across its own direction for cropped ones."""
    first = "images of 2 sizes (first: images/001.png 6x8, images/000.png 8x6) have one "
    assert with_sizes(tmp_path / "pixels", (6, 8), fl_x=10.0) == [
        f"{first}lens in pixels: give each frame a lens of its own"
    ]
    assert with_sizes(tmp_path / "angle", (6, 8), camera_angle_x=np.pi / 2) == [
        f"{first}field of view, and so focal lengths of 3 and 4 pixels: if one camera took them, "
        "turned or cropped, give each frame its fl_x"
    ]
    assert with_sizes(tmp_path / "reduced", (4, 3), camera_angle_x=np.pi / 2) == []
    assert with_sizes(tmp_path / "cropped", (8, 4), camera_angle_x=np.pi / 2) == []


@pytest.mark.parametrize(
    ("height", "lens", "says"),
    [
        (12, {}, True),
        (8, {}, False),
        (12, {"camera_angle_y": 2.0}, False),
        (12, {"fl_x": 4.0}, False),
    ],
)
def test_an_angle_across_the_width_of_portraits_is_said(
    tmp_path: Path, height: int, lens: dict[str, float], says: bool
) -> None:
    with_sizes(tmp_path, (8, 6), camera_angle_x=np.pi / 2, **lens)
    for k in range(4):
        Image.fromarray(picture(k, width=8, height=height)).save(tmp_path / f"images/{k:03d}.png")
    said = (
        "transforms.json: camera_angle_x is taken to be across the width of all images, which "
        "stand upright (first: images/000.png), a focal length of 4 pixels; Blender's, with sensor "
        "fit Auto, is along the height: if Blender wrote it, give fl_x, 6"
    )
    assert [w for w in load_scene(tmp_path).warnings if "upright" in w] == [said] * says


def test_a_lens_that_contradicts_itself_is_told_once(tmp_path: Path) -> None:
    (told,) = with_sizes(tmp_path, (8, 6), camera_angle_x=np.pi / 2, fl_x=8.0)
    assert told.startswith(
        "transforms.json: the lens of 4 of 4 images (first: images/000.png) contradicts itself: "
        "$.fl_x is 8 pixels"
    )


def test_downscale_averages_blocks_and_scales_the_lens(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    view = load_scene(tmp_path, downscale=4).views[0]
    expected = picture(0)[:4].reshape(1, 4, 2, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(view.image, expected, atol=0.5)
    camera = view.camera
    assert (camera.width, camera.height) == (2, 1)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (2.5, 2.75, 1.0625, 0.6875)


def test_downscale_does_not_let_hidden_colour_bleed(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    pixels = np.zeros((6, 8, 4), np.uint8)
    pixels[:, ::2] = [200, 100, 50, 255]
    pixels[:, 1::2] = [0, 255, 0, 0]
    pixels[4:, :] = [7, 7, 7, 0]
    for i in range(4):
        Image.fromarray(pixels).save(tmp_path / content["frames"][i]["file_path"])
    image = load_scene(tmp_path, downscale=2).views[0].image
    assert image.shape == (3, 4, 4)
    assert np.unique(image[:2].reshape(-1, 4), axis=0).tolist() == [[200, 100, 50, 128]]
    assert image[2, :, 3].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("downscale", [0, -1, 1.5, True, "2"])
def test_downscale_that_is_no_factor_is_refused(tmp_path: Path, downscale: Any) -> None:
    with pytest.raises(InputError, match="downscale must be a whole number"):
        load_scene(tmp_path, downscale=downscale)


def test_downscale_beyond_the_image_is_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    with pytest.raises(InputError, match=r"downscale is 7, but .*images/000\.png has 8x6 pixels"):
        load_scene(tmp_path, downscale=7)


@needs_capture("fox_q")
def test_fox_is_loaded() -> None:
    scene = load_scene(DATA / "fox_q")
    assert len(scene.views) == 50
    assert [len(scene.splits[split]) for split in ("train", "test")] == [43, 7]
    assert scene.unbounded
    assert scene.content_distance == pytest.approx(5.02, abs=0.01)
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (270, 480)
    assert (camera.fx, camera.cx, camera.k1, camera.p2) == (343.88, 138.6395, 0.0578421, 0.00015575)


@needs_capture("stitch")
def test_stitch_is_loaded() -> None:
    scene = load_scene(DATA / "stitch", downscale=4)
    assert [len(scene.splits[split]) for split in ("train", "test")] == [70, 11]
    assert scene.content_distance == pytest.approx(4.44, abs=0.01)  # its points say
    assert scene.views[0].image.shape == (120, 120, 3)


@needs_capture("lund_door")
def test_lund_door_is_loaded() -> None:
    scene = load_scene(DATA / "lund_door")
    assert [len(scene.splits[split]) for split in ("train", "test")] == [10, 2]
    assert scene.content_distance == pytest.approx(20.4, abs=0.1)  # its points say


def test_numbers_in_names_count_as_numbers_for_every_8th(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 20)
    for frame, number in zip(content["frames"], range(20), strict=True):
        path = tmp_path / frame["file_path"]
        path.rename(path.with_name(f"frame_{number}.png"))
        frame["file_path"] = f"images/frame_{number}.png"
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    tested = {scene.views[index].name for index in scene.splits["test"]}
    assert tested == {f"images/frame_{number}.png" for number in (0, 8, 16)}


def test_names_are_sorted_by_their_numbers() -> None:
    names = ["b", "a10b2", "a2", "a10b10", "a01", "a1", "10", "9"]
    expected = ["9", "10", "a01", "a1", "a2", "a10b2", "a10b10", "b"]
    assert sorted(names, key=by_number) == expected
