"""transforms.json: tiny scenes, real captures, and every way to get one wrong."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.tiny_scenes import (
    DATA,
    needs_capture,
    picture,
    save,
    transforms_content,
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


def test_places_without_a_scene_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("hello")
    for name, message in [
        ("empty", r"empty: no scene found: .*transforms_train\.json .*transforms\.json"),
        ("none", r"none: does not exist; .*builtin:room"),
        ("notes.txt", r"notes\.txt: is not a scene"),
        ("n" * 5000, "does not exist"),
        ("a\0b", "has a character of code 0"),
    ]:
        with pytest.raises(InputError, match=message):
            load_scene(tmp_path / name)
    for name in ("moon", "room-", "sparse"):
        known = "builtin:room, builtin:room-sparse, builtin:building-N"
        message = f"builtin:{name}: no such .* are {known}\\.$"
        with pytest.raises(InputError, match=message):
            load_scene(f"builtin:{name}")


@pytest.mark.parametrize("raw", ["", "{", "{,}", "[" * 100_000, '{"frames": NaN}', "[]"])
def test_broken_json_is_refused(tmp_path: Path, raw: str) -> None:
    (tmp_path / "transforms.json").write_text(raw)
    with pytest.raises(InputError, match=r"transforms\.json: "):
        load_scene(tmp_path)


def in_frame(**changes: Any) -> Callable[[dict[str, Any]], None]:
    """Change frame 1."""
    return lambda content: content["frames"][1].update(changes)


def in_file(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda content: content.update(changes)


def without(key: str, *, frame: bool = False) -> Callable[[dict[str, Any]], None]:
    def change(content: dict[str, Any]) -> None:
        del (content["frames"][1] if frame else content)[key]

    return change


def with_pose(change: Callable[[np.ndarray], Any]) -> Callable[[dict[str, Any]], None]:
    def apply(content: dict[str, Any]) -> None:
        frame = content["frames"][1]
        frame["transform_matrix"] = np.asarray(change(np.array(frame["transform_matrix"]))).tolist()

    return apply


def at_one_point(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        for row, value in enumerate([3.0, 1.0, 2.0]):
            frame["transform_matrix"][row][3] = value


FRAME = r"\$\.frames\[1\]"
POSE = rf"{FRAME}\.transform_matrix"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("frames"), r"missing required field `frames`, at `\$`"),
        (in_file(frames=[]), r"\$\.frames: is empty"),
        (in_file(frames={}), r"expected `array`, got `object`, at `\$\.frames`"),
        (without("file_path", frame=True), rf"missing required field `file_path`, at `{FRAME}`"),
        (without("transform_matrix", frame=True), rf"`transform_matrix`, at `{FRAME}`"),
        (without("fl_x"), None),
        (in_frame(file_path=7), rf"expected `str`, got `int`, at `{FRAME}\.file_path`"),
        (in_frame(transform_matrix="eye"), rf"expected `array`, got `str`, at `{POSE}`"),
        (in_frame(transform_matrix=[["1"]]), rf"got `str`, at `{POSE}\[0\]\[0\]`"),
        (in_frame(transform_matrix=[1.0] * 16), rf"got `float`, at `{POSE}\[0\]`"),
        (in_frame(transform_matrix=[[1.0] * 16]), rf"{POSE}: is 1x16, but"),
        (with_pose(lambda m: m[:2]), rf"{POSE}: is 2x4, but"),
        (with_pose(lambda m: 0.0 * m + np.diag([0, 0, 0, 1.0])), rf"{POSE}: .*length zero"),
        (with_pose(lambda m: m @ np.diag([1, 1, -1.0, 1])), rf"{POSE}: is mirrored"),
        (with_pose(lambda m: m @ np.diag([2.0, 2, 2, 1])), rf"{POSE}: scales by 2"),
        (with_pose(lambda m: m @ (np.eye(4) + 0.1 * np.eye(4, k=1))), rf"{POSE}: shears"),
        (with_pose(lambda m: m.T), rf"{POSE}: its last row is"),
        (in_file(fl_x=0), r"\$\.fl_x: 0 is no focal length"),
        (in_file(fl_x="10"), r"expected `float \| null`, got `str`, at `\$\.fl_x`"),
        (in_file(fl_y=-5.0), r"\$\.fl_y: -5 is no focal length"),
        (in_frame(camera_angle_x=3.2), rf"{FRAME}\.camera_angle_x: 3.2 is not a field of view"),
        (in_file(w=16, h=12), r"\$\.w: .* 16x12 pixels, but images/000\.png has 8x6"),
        (in_file(k1=-3.0), r"\$\.k1 = -3 folds over within the image images/000\.png"),
        (in_file(ftheta_p0=0.1), r"\$\.ftheta_p0"),
        (in_file(k4=0.01), r"\$\.k4"),
        (in_frame(camera_model="FOV"), rf"{FRAME}\.camera_model: 'FOV' is none of OPENCV"),
        (in_frame(file_path="../a.png"), rf'{FRAME}\.file_path: "\.\./a\.png" leaves the scene'),
        (in_frame(file_path="/a.png"), rf'{FRAME}\.file_path: "/a\.png" leaves the scene'),
        (in_frame(file_path=""), rf'{FRAME}\.file_path: "" is not a path'),
        (in_file(test_filenames=["x.png"]), r"\$\.test_filenames: names no image"),
        (in_file(test_filenames=["../x.png"]), r"\$\.test_filenames\[0\]: .* leaves the scene"),
        (at_one_point, r"transform_matrix: all training cameras are at one point"),
    ],
)
def test_bad_content_is_refused_by_name(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str | None
) -> None:
    if message is None:  # fl_y alone will do
        assert load_changed(tmp_path, change).views[0].camera.fx == 11.0
        return
    with pytest.raises(InputError, match=rf"transforms\.json: .*{message}"):
        load_changed(tmp_path, change)


def test_pose_with_a_number_out_of_range_is_refused(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    content["frames"][1]["transform_matrix"][0][3] = "HERE"
    save(tmp_path / "transforms.json", content)
    text = (tmp_path / "transforms.json").read_text()
    for number in ("1e999", "NaN", "-Infinity"):
        (tmp_path / "transforms.json").write_text(text.replace('"HERE"', number))
        with pytest.raises(InputError, match=rf"{POSE}\[0\]\[3\]: is not a finite number"):
            load_scene(tmp_path)


def test_no_image_left_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "transforms.json", transforms_content(3))
    with pytest.raises(
        InputError, match=r"transforms\.json: .*file_path: no image of 3 frames .*images/000\.png"
    ):
        load_scene(tmp_path)


@pytest.mark.parametrize(("n", "message"), [(1, "no image is left to train on"), (2, "at least 2")])
def test_too_few_images_are_refused(tmp_path: Path, n: int, message: str) -> None:
    write_transforms(tmp_path, n)
    with pytest.raises(InputError, match=rf"transforms\.json: .*{message}"):
        load_scene(tmp_path)


def make_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def make_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def make_link_outside(path: Path) -> None:
    outside = path.parents[2] / "outside.png"
    path.rename(outside)
    path.symlink_to(outside)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.write_bytes(b""), r"images/001\.png: is empty"),
        (lambda path: path.write_bytes(path.read_bytes()[:90]), r"images/001\.png: is cut short"),
        (lambda path: path.write_text("hello"), r"images/001\.png: is not an image"),
        (
            lambda path: Image.new("CMYK", (8, 6)).save(path, "JPEG"),
            r"images/001\.png: its pixels are CMYK",
        ),
        (
            lambda path: Image.new("RGB", (6, 8)).save(path),
            r"transforms\.json: \$\.w: .*8x6 pixels, but images/001\.png has 6x8",
        ),
        (make_pipe, r"images/001\.png: is a pipe"),
        (make_folder, r"images/001\.png: is a folder"),
        (make_link_outside, rf"transforms\.json: {FRAME}\.file_path: .* follows a link out of"),
    ],
)
def test_bad_image_is_refused_by_name(
    tmp_path: Path, damage: Callable[[Path], Any], message: str
) -> None:
    write_transforms(tmp_path / "scene")
    damage(tmp_path / "scene/images/001.png")
    with pytest.raises(InputError, match=message):
        load_scene(tmp_path / "scene")


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
