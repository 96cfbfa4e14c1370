"""transforms.json: every way to get one wrong."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_transforms import load_changed
from tests.support.tiny_scenes import (
    save,
    transforms_content,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


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
