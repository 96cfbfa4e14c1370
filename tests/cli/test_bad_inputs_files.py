"""Scene files and paths that are broken, missing or hostile, one by one, through the command."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.cli_process import Change, assert_refused, assert_trained, make_scene, train
from tests.support.tiny_scenes import ring

pytestmark = pytest.mark.usefixtures("compiled_kernels")


# --- 1 to 10: the folder, and JSON as text ------------------------------------------------------


def empty_folder(folder: Path) -> Path:
    (folder / "scene").mkdir()
    return folder / "scene"


def unknown_format(folder: Path) -> Path:
    scene = empty_folder(folder)
    (scene / "cameras.txt").write_text("1 PINHOLE 16 12 20 22 8 6")
    return scene


def unknown_file(folder: Path) -> Path:
    (folder / "scene.ply").write_text("ply")
    return folder / "scene.ply"


def json_text(edit: Callable[[str], str | bytes]) -> Callable[[Path], Path]:
    """A scene whose transforms.json is edited as text."""

    def make(folder: Path) -> Path:
        scene = make_scene(folder)
        text = edit((scene / "transforms.json").read_text())
        (scene / "transforms.json").write_bytes(text if isinstance(text, bytes) else text.encode())
        return scene

    return make


def replaced(old: str, new: str) -> Callable[[Path], Path]:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return json_text(edit)


def json_pipe(folder: Path) -> Path:
    scene = make_scene(folder)
    (scene / "transforms.json").unlink()
    os.mkfifo(scene / "transforms.json")
    return scene


JSON = "transforms.json: "


@pytest.mark.parametrize(
    ("make", "says"),
    [
        pytest.param(
            lambda folder: folder / "none", ["none: does not exist"], id="1-missing-folder"
        ),
        pytest.param(
            empty_folder, ["scene: no scene found", "transforms.json"], id="2-empty-folder"
        ),
        pytest.param(
            unknown_format, ["scene: no scene found", "COLMAP"], id="3-unknown-format-folder"
        ),
        pytest.param(unknown_file, ["scene.ply: is not a scene"], id="3-unknown-format-file"),
        pytest.param(json_text(lambda _: ""), [JSON + "is empty"], id="4-empty-file"),
        pytest.param(
            replaced("}]}", "},]}"), [JSON + "is not valid JSON", "line 1"], id="6-trailing-comma"
        ),
        pytest.param(
            json_text(lambda _: "[" * 100_000), [JSON + "brackets nested"], id="7-100k-deep-lists"
        ),
        pytest.param(
            json_text(lambda _: '{"frames":' * 100_000),
            [JSON + "brackets nested"],
            id="7-100k-deep-objects",
        ),
        pytest.param(
            replaced('"fl_x": 20.0', '"fl_x": NaN'),
            [JSON + "$.fl_x: is not a finite number"],
            id="8-NaN",
        ),
        pytest.param(
            replaced('"fl_x": 20.0', '"fl_x": 1e999'),
            [JSON + "$.fl_x: is not a finite number"],
            id="8-1e999",
        ),
        pytest.param(
            replaced('"fl_x"', '"fl_x": 9.0, "fl_x"'),
            [JSON, "key fl_x is given twice"],
            id="9-duplicate-key",
        ),
        pytest.param(
            replaced('"fl_x": 20.0', f'"fl_x": {"9" * 5000}'),
            [JSON + "$.fl_x: is not a finite number, or too large"],
            id="10-5000-digit-integer",
        ),
    ],
)
def test_scene_file(tmp_path: Path, make: Callable[[Path], Path], says: list[str]) -> None:
    assert_refused(train(make(tmp_path), folder=tmp_path), *says)


def test_5_byte_order_mark(tmp_path: Path) -> None:
    scene = json_text(lambda text: b"\xef\xbb\xbf" + text.encode())(tmp_path)
    assert_trained(train(scene, folder=tmp_path))


# --- 11 to 25: frames, poses and lenses ---------------------------------------------------------


def pose(matrix: Any) -> Change:
    """Replace the second frame's pose."""
    return lambda content: content["frames"][1].update(transform_matrix=matrix)


def turned(change: Callable[[np.ndarray], Any]) -> Change:
    """Replace the second frame's pose [4, 4] by what a function makes of it."""
    return pose(change(ring(4)[1]).tolist())


def scaled(*factors: float) -> Change:
    """Stretch the second camera's axes."""
    return turned(lambda c2w: c2w @ np.diag([*factors, 1.0]))


def lens(**values: Any) -> Change:
    return lambda content: content.update(values)


def one_place(content: dict[str, Any]) -> None:
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] = 1.0


def angle_only(value: float) -> Change:
    def change(content: dict[str, Any]) -> None:
        del content["fl_x"], content["fl_y"]
        content["camera_angle_x"] = value

    return change


SHEAR = np.eye(4) + 0.2 * np.eye(4, k=1) * [1, 1, 0, 0]
MATRIX = "$.frames[1].transform_matrix"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        pytest.param(lambda c: c.pop("frames"), ["`frames`"], id="11-no-frames-key"),
        pytest.param(lens(frames=[]), ["$.frames", "is empty"], id="11-no-frames-in-list"),
        pytest.param(
            lambda c: c["frames"][1].pop("transform_matrix"),
            ["`transform_matrix`", "$.frames[1]"],
            id="12-no-transform_matrix",
        ),
        pytest.param(pose(np.eye(3).tolist()), [MATRIX, "3x3"], id="13-3x3-matrix"),
        pytest.param(pose([[1, 0, 0, 0], [0, 1], [0, 0, 1, 0]]), [MATRIX, "3x2/4"], id="13-ragged"),
        pytest.param(pose("identity"), [MATRIX, "expected `array`"], id="13-string-matrix"),
        pytest.param(pose([["1"] * 4] * 4), [MATRIX + "[0][0]", "`str`"], id="13-strings-in-it"),
        pytest.param(pose([[math.inf] * 4] * 4), [MATRIX + "[0][0]", "finite"], id="14-inf-pose"),
        pytest.param(pose([[math.nan] * 4] * 4), [MATRIX + "[0][0]", "finite"], id="14-NaN-pose"),
        pytest.param(pose([[0] * 4] * 4), [MATRIX, "last row"], id="15-zero-4x4-matrix"),
        pytest.param(pose([[0] * 4] * 3), [MATRIX, "length zero"], id="15-zero-3x4-matrix"),
        pytest.param(turned(lambda c2w: c2w @ SHEAR), [MATRIX, "shears"], id="16-shear"),
        pytest.param(scaled(-1, 1, 1), [MATRIX, "is mirrored"], id="17-mirrored"),
        pytest.param(scaled(2, 2, 2), [MATRIX, "scales by 2;"], id="18-uniform-scale-2"),
        pytest.param(turned(np.transpose), [MATRIX, "last row", "transpose"], id="19-bad-last-row"),
        pytest.param(lens(fl_x=0), ["$.fl_x", "0 is no focal length"], id="20-zero-focal"),
        pytest.param(lens(fl_y=-5.0), ["$.fl_y", "-5 is no focal length"], id="20-negative-focal"),
        pytest.param(lens(fl_x=math.nan), ["$.fl_x: is not a finite number"], id="20-NaN-focal"),
        pytest.param(angle_only(3.15), ["$.camera_angle_x", "3.15"], id="21-angle-above-pi"),
        pytest.param(angle_only(np.pi), ["$.camera_angle_x", "3.14"], id="21-angle-pi"),
        pytest.param(lens(w=32), ["$.w", "32x12", "000.png has 16x12"], id="22-size-of-the-image"),
        pytest.param(
            lens(camera_model="FISHEYE"), ["$.camera_model"], id="23-unknown-camera-model"
        ),
        pytest.param(lens(k1=-3.0), ["$.k1 = -3", "folds over"], id="24-distortion-no-inverse"),
        pytest.param(one_place, ["transform_matrix", "at one point"], id="25-cameras-at-one-point"),
    ],
)
def test_frames(tmp_path: Path, change: Change, says: list[str]) -> None:
    scene = make_scene(tmp_path, change)
    assert_refused(train(scene, folder=tmp_path), f"{scene}/transforms.json: ", *says)


# --- 27 to 35: paths ----------------------------------------------------------------------------


def named(path: str, prepare: Callable[[Path], object] = lambda scene: None) -> Any:
    """A scene whose second image is named so; ``prepare`` makes what is to be found there."""

    def make(folder: Path) -> Path:
        text = path.replace("FOLDER", str(folder))
        scene = make_scene(folder, lambda c: c["frames"][1].update(file_path=text))
        (folder / "outside.png").write_bytes((scene / "images/001.png").read_bytes())
        prepare(scene)
        return scene

    return make


def link(name: str, target: str) -> Callable[[Path], object]:
    return lambda scene: (scene / name).symlink_to(target)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        pytest.param(
            named("../../../etc/passwd"), ["passwd", "leaves the scene's folder"], id="27-dots"
        ),
        pytest.param(
            named("images/../../outside.png"), ["leaves the scene's"], id="27-dots-within"
        ),
        pytest.param(named("FOLDER/outside.png"), ["leaves the scene's"], id="28-absolute-path"),
        pytest.param(
            named("a.png", link("a.png", "../outside.png")),
            ["a.png", "follows a link out of the scene's folder"],
            id="29-link-out-of-the-folder",
        ),
        pytest.param(
            named("up/outside.png", link("up", "..")),
            ["follows a link out of the scene's folder"],
            id="29-linked-folder",
        ),
        pytest.param(named("a.png", link("a.png", "a.png")), ["a.png", "links"], id="30-link-loop"),
        pytest.param(
            named("a.png", lambda scene: os.mkfifo(scene / "a.png")),
            ["a.png", "is a pipe or a device"],
            id="31-FIFO-as-image",
        ),
        pytest.param(json_pipe, ["transforms.json: is a pipe"], id="31-FIFO-as-scene-file"),
        pytest.param(
            named("images/\0.png"), ["\\u0000.png", "is not a path"], id="32-NUL-in-a-name"
        ),
        pytest.param(named("n" * 300), ['"nnn', "too long"], id="33-300-character-name"),
        pytest.param(named("images"), ["images: is a folder"], id="35-a-folder-as-image"),
    ],
)
def test_path(tmp_path: Path, make: Callable[[Path], Path], says: list[str]) -> None:
    scene = make(tmp_path)
    outcome = train(scene, folder=tmp_path)
    assert_refused(outcome, *says)
    assert str(scene) in outcome.err


def test_name_that_is_not_UTF_8(tmp_path: Path) -> None:
    """Read like any other, and shown as well as the terminal can."""
    name = os.fsdecode(b"images/\xff.png")

    def change(content: dict[str, Any]) -> None:
        content["frames"][0]["file_path"] = name
        content["test_filenames"] = [name]

    scene = make_scene(tmp_path, change)
    (scene / "images/000.png").rename(scene / name)
    outcome = train(scene, folder=tmp_path)
    assert_trained(outcome)
    assert "images/\\udcff.png" in outcome.out


@pytest.mark.parametrize("name", ["images/\x1b[2J.png", "images/a\nb.png"])
def test_name_that_would_steer_the_terminal(tmp_path: Path, name: str) -> None:
    outcome = train(named(name)(tmp_path), folder=tmp_path)
    assert_refused(outcome, "$.frames[1].file_path: ", "is not a path")


def test_34_backslashes(tmp_path: Path) -> None:
    def change(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].replace("/", "\\")

    assert_trained(train(make_scene(tmp_path, change), folder=tmp_path))
