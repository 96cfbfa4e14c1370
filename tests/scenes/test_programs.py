"""Exports of programs: what is read is what was meant; test_metashape.py has its lenses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import assert_same
from tests.support.program_exports import (
    HEADER,
    write_metashape,
    write_pictures,
    write_polycam,
    write_reality,
    write_record3d,
)
from tests.support.tiny_scenes import picture, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.contents import is_unposed
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.reality import _pose
from warpnerf.scenes.formats.survey import survey
from warpnerf.scenes.scene import Scene

WRITERS: dict[str, Callable[[Path], Path]] = {
    "Polycam": write_polycam,
    "Record3D": write_record3d,
    "Metashape": write_metashape,
    "RealityCapture": write_reality,
}


def expected(folder: Path, **changes: float) -> Scene:
    write_transforms(folder)
    file = folder / "transforms.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    return load_scene(folder)


@pytest.mark.parametrize("program", WRITERS)
def test_the_scene_is_that_of_transforms_json(tmp_path: Path, program: str) -> None:
    there = WRITERS[program](tmp_path / "b")
    scene = load_scene(tmp_path / "b")
    other = {"fl_y": 10.0} if program == "RealityCapture" else {}  # it has one focal length
    assert_same(scene, expected(tmp_path / "a", **other))
    name = there.relative_to(tmp_path / "b").as_posix()
    assert survey(tmp_path / "b").format == f"{program} ({name})"
    if there.is_file():
        assert_same(load_scene(there), scene)
        assert survey(there).format == f"{program} ({name})"


@pytest.mark.parametrize("program", WRITERS)
def test_another_form_is_read_first_and_this_one_mentioned(tmp_path: Path, program: str) -> None:
    WRITERS[program](tmp_path / "b")
    (tmp_path / "b/images").mkdir(exist_ok=True)
    write_pictures(tmp_path / "b/images", [f"{k:03d}.png" for k in range(4)])
    write_transforms(tmp_path / "a")
    (tmp_path / "a/transforms.json").rename(tmp_path / "b/transforms.json")
    scene = load_scene(tmp_path / "b")
    assert any(
        note.startswith(f"also in the folder, and not read: {program} (") for note in scene.notes
    )
    assert survey(tmp_path / "b").format == "instant-ngp / nerfstudio (transforms.json)"


@pytest.mark.parametrize("program", WRITERS)
def test_photographs_without_cameras_and_cameras_without_photographs(
    tmp_path: Path, program: str
) -> None:
    there = WRITERS[program](tmp_path)
    first = sorted(path for path in tmp_path.rglob("*.png") if "depth" not in path.parts)[-1]
    first.rename(first.with_name("unknown.png"))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 3
    said = "\n".join(scene.warnings)
    assert f"{there.name}: left out 1 of 4 cameras for want of a photograph (first: " in said
    assert f"1 of 4 photographs have no camera in {there.name} (first: " in said
    for path in tmp_path.rglob("*.png"):
        path.unlink()
    with pytest.raises(InputError, match=r"none of its 4 photographs is in .*\); put them there"):
        load_scene(tmp_path)
    Image.new("RGB", (8, 6)).save(first.with_name("unknown.png"))
    with pytest.raises(InputError, match=r"in .*, but 1 other is \(first: .*unknown.png\); put"):
        load_scene(tmp_path)


# --- Polycam ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("n", "warns"), [(20, None), (18, False), (17, True)])
def test_polycam_keyframes_that_were_not_corrected_are_said(
    tmp_path: Path, n: int, warns: bool | None
) -> None:
    write_polycam(tmp_path, 20, corrected=False)
    shutil.rmtree(tmp_path / "keyframes/depth")
    write_polycam(tmp_path, n)
    scene = load_scene(tmp_path)
    assert len(scene.views) == n
    said = (
        f"corrected_cameras has {n} of the 20 keyframes of cameras, which are read where "
        "corrected_cameras is not in the folder"
    )
    assert (said in scene.warnings, said in scene.notes) == (warns is True, warns is False)
    shutil.rmtree(tmp_path / "keyframes/corrected_images")
    scene = load_scene(tmp_path)
    said = "corrected_cameras are used with images, as there are no corrected_images"
    assert said in scene.notes


def test_polycam_depth_is_in_millimetres(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    view = load_scene(tmp_path).views[2]
    assert view.depth is not None
    along = np.asarray(view.depth)[3, 4]
    assert along == pytest.approx(1.002, rel=0.01)  # the pixel beside the principal point
    assert np.asarray(view.depth).shape == (6, 8)


def test_polycam_depth_of_another_shape_is_left_out(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    Image.fromarray(np.ones((9, 4), np.uint16)).save(tmp_path / "keyframes/depth/102.png")
    scene = load_scene(tmp_path)
    assert [view.depth is None for view in scene.views] == [False, False, True, False]
    assert any("left out 1 depth maps of another shape" in warning for warning in scene.warnings)


def test_polycam_corrected_cameras_come_first(tmp_path: Path) -> None:
    write_polycam(tmp_path, corrected=False)
    plain = load_scene(tmp_path)
    assert plain.views[0].name == "keyframes/images/100.png"
    write_polycam(tmp_path / "b")
    (tmp_path / "b/keyframes/corrected_cameras").rename(tmp_path / "keyframes/corrected_cameras")
    assert load_scene(tmp_path).views[0].name == "keyframes/images/100.png"
    assert survey(tmp_path).format == "Polycam (keyframes/corrected_cameras)"
    assert survey(tmp_path / "keyframes").format == "Polycam (corrected_cameras)"
    assert_same(load_scene(tmp_path / "keyframes"), plain)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"fx": 0}, r"101.json: \$.fx: 0 is no focal length in pixels; export"),
        ({"width": 8.5}, r"101.json: \$.width: 8.5 is no size in pixels; export"),
        ({"t_00": 7.0}, r"101.json: t_00 to t_23: "),
        ({"fy": "wide"}, r"101.json: expected `float`, got `str`, at `\$.fy`; correct"),
        ({"width": 12, "height": 6}, "is for images of 12x6 pixels, but .*101.png has 8x6"),
    ],
)
def test_polycam_damage_is_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    file = write_polycam(tmp_path) / "101.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


# --- Record3D -----------------------------------------------------------------------------------


def test_record3d_lens_is_scaled_to_its_photographs(tmp_path: Path) -> None:
    write_record3d(tmp_path, scale=3)
    scene = load_scene(tmp_path)
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (24, 18)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30.0, 33.0, 12.75, 8.25)
    assert any("4 of 4 photographs are of another size" in note for note in scene.notes)


def test_record3d_lens_of_each_frame_and_by_rows(tmp_path: Path) -> None:
    each = [[10.0 + k, 11.0, 4.0, 3.0] for k in range(4)]
    write_record3d(tmp_path / "a", perFrameIntrinsicCoeffs=each)
    scene = load_scene(tmp_path / "a")
    assert [view.camera.fx for view in scene.views] == [10.0, 11.0, 12.0, 13.0]
    rows = [10.0, 0.0, 4.25, 0.0, 11.0, 2.75, 0.0, 0.0, 1.0]
    write_record3d(tmp_path / "b", K=rows)
    camera = load_scene(tmp_path / "b").views[0].camera
    assert (camera.cx, camera.cy) == (4.25, 2.75)


def test_record3d_unpacked_and_its_depth_mentioned(tmp_path: Path) -> None:
    file = write_record3d(tmp_path)
    file.rename(tmp_path / "metadata")
    (tmp_path / "rgbd/0.depth").write_bytes(b"lzfse")
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert any("1 depth files in rgbd are not read" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"K": [1.0] * 8}, r"\$.K: holds 8 numbers, not 9; export"),
        ({"K": [0.0] * 9}, r"\$.K: its focal lengths must be above 0; export"),
        ({"w": 0}, r"\$.w: 0 is no size in pixels; export"),
        ({"w": 12}, r"\$.w: the file is for images of 12x6 pixels"),
        ({"poses": []}, r"\$.poses: is empty; export"),
        ({"poses": [[0.0] * 7] * 4}, r"\$.poses\[0\]: its quaternion .* is none; export"),
        ({"poses": [[1.0] * 6] * 4}, r"\$.poses\[0\]: holds 6 numbers, not a quaternion"),
        ({"perFrameIntrinsicCoeffs": [[1.0] * 4] * 3}, r"is for 3 frames, but there are 4 poses"),
        ({"perFrameIntrinsicCoeffs": [[1.0] * 3] * 4}, r"\[0\]: holds 3 numbers, not fx, fy, cx"),
    ],
)
def test_record3d_damage_is_named(tmp_path: Path, change: dict[str, Any], says: str) -> None:
    write_record3d(tmp_path, **change)
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


# --- RealityCapture -----------------------------------------------------------------------------


def test_reality_angles_are_those_of_its_own_matrix() -> None:
    """One camera exported both ways, from Epic's forum, topic 710449: world to camera by rows."""
    row = {"heading": 163.736597399311, "pitch": 83.4154313461628, "roll": 174.386496244756}
    pose = _pose({**row, "x": 1.0, "y": 2.0, "alt": 3.0})
    matrix = [
        [0.982594073038806, 0.185426733553445, -0.0112166890261935],
        [-0.032113633044729, 0.11008102707942, -0.993403685341366],
        [-0.18296885582437, 0.976472781986697, 0.114],
    ]
    np.testing.assert_allclose((pose[:, :3] * [1.0, -1.0, -1.0]).T, matrix, atol=2e-4)
    assert pose[:, 3].tolist() == [1.0, 2.0, 3.0]


def test_reality_lens(tmp_path: Path) -> None:
    write_reality(tmp_path / "a", lens="-0.05,0.02,-0.01,0,0.001,-0.002")
    camera = load_scene(tmp_path / "a").views[0].camera
    assert (camera.k1, camera.k2, camera.k3) == (-0.05, 0.02, -0.01)
    assert (camera.p1, camera.p2) == (-0.002, 0.001)
    write_reality(tmp_path / "b", lens="-0.05,0.02,-0.01,0.005,0,0")
    assert any("BROWN lens" in note for note in load_scene(tmp_path / "b").notes)


def test_reality_focal_length_is_by_the_longer_side(tmp_path: Path) -> None:
    file = write_reality(tmp_path)
    for k in range(4):
        upright = picture(k, width=6, height=8)
        Image.fromarray(upright).save(tmp_path / f"images/{k:03d}.png")
    camera = load_scene(file).views[0].camera
    assert (camera.width, camera.height, camera.fx) == (6, 8, pytest.approx(10.0))
    assert (camera.cx, camera.cy) == pytest.approx((3.25, 3.75))


def test_reality_does_not_say_whether_photographs_are_turned(tmp_path: Path) -> None:
    file = write_reality(tmp_path)
    exif = Image.Exif()
    exif[274] = 6
    file.write_text(file.read_text().replace(".png", ".jpg"))
    for path in (tmp_path / "images").iterdir():
        Image.open(path).save(path.with_suffix(".jpg"), exif=exif)
        path.unlink()
    assert any("stored turned, with an EXIF rotation" in w for w in load_scene(file).warnings)


@pytest.mark.parametrize("delimiter", [";", "\t"])
def test_reality_decimal_commas(tmp_path: Path, delimiter: str) -> None:
    file = write_reality(tmp_path)
    expected = load_scene(tmp_path)
    text = file.read_text().replace(".png", "*png").replace(",", delimiter).replace(".", ",")
    file.write_text(text.replace("*png", ".png"))
    assert_same(load_scene(tmp_path), expected)
    file.write_text(text.replace("*png", ".png").replace("45,0", "1.345,0"))
    with pytest.raises(InputError, match=r"f: '1\.345,0' is no finite number"):
        load_scene(tmp_path)


def test_reality_in_utf_16(tmp_path: Path) -> None:
    """As PowerShell and Excel write text; poses are not estimated in place of those."""
    file = write_reality(tmp_path)
    expected = load_scene(tmp_path)
    file.write_bytes(file.read_text().encode("utf-16"))
    assert_same(load_scene(tmp_path), expected)


def test_reality_columns_of_a_template(tmp_path: Path) -> None:
    file = write_reality(tmp_path)
    rows = [line.split(",")[:8] for line in file.read_text().splitlines()]
    rows[0] = ["#Name", "X", "Y", "Alt", "Heading", "Pitch", "Roll", "F"]
    file.write_text("#cameras 4\n" + "\n".join(";".join(row) for row in rows) + "\n")
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.fx, camera.cx, camera.cy) == (pytest.approx(10.0), 4.0, 3.0)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("001.png,", "001.png,wide,", "line 3: x: 'wide' is no finite number; export"),
        ("001.png,", "001.png", "line 3: has 15 columns, but the header 16; export"),
        (",45.0,", ",-1.0,", "line 2: f: -1 is no focal length; export"),
        ("001.png", "000.png", "1 cameras are of a photograph that another one is of; remove"),
        ("001.png,", "001.png,1e300,", "line 3: x, y, alt: holds numbers beyond"),
    ],
)
def test_reality_damage_is_named(tmp_path: Path, old: str, new: str, says: str) -> None:
    file = write_reality(tmp_path)
    text = file.read_text()
    assert old in text
    if new.count(",") > old.count(","):  # in place of a value
        at = text.index(old) + len(old)
        text = text[:at] + text[text.index(",", at) + 1 :]
    file.write_text(text.replace(old, new))
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_reality_without_rows_is_refused(tmp_path: Path) -> None:
    write_reality(tmp_path).write_text(HEADER + "\n")
    with pytest.raises(InputError, match="has no row below its header; export"):
        load_scene(tmp_path)


@pytest.mark.parametrize("write", [write_metashape, write_reality])
def test_files_among_the_photographs_are_found(
    tmp_path: Path, write: Callable[[Path], Path]
) -> None:
    file = write(tmp_path)
    plain = load_scene(tmp_path)
    file.rename(tmp_path / "images" / file.name)
    assert f"(images/{file.name})" in survey(tmp_path).format
    assert_same(load_scene(tmp_path), plain)
    assert not is_unposed(tmp_path)
    (tmp_path / "images").rename(tmp_path / "scan")
    with pytest.raises(InputError, match=r"its folder scan holds one; use .*scan"):
        load_scene(tmp_path)


@pytest.mark.parametrize("name", ["poly.zip", "scan.R3D"])
def test_archives_are_to_be_unpacked(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"PK")
    with pytest.raises(InputError, match="is an archive; unpack it, and give the folder"):
        load_scene(tmp_path / name)


def test_other_files_of_the_same_endings_are_no_scenes(tmp_path: Path) -> None:
    write_pictures(tmp_path / "images", ["a.png", "b.png"])
    (tmp_path / "list.csv").write_text("name,x,y\na,1,2\n")
    (tmp_path / "page.xml").write_text("<html/>")
    (tmp_path / "cameras").mkdir()
    (tmp_path / "cameras/a.json").write_text('{"position": [0, 0, 0]}')
    (tmp_path / "metadata.json").write_text('{"poses": [], "K": []}')
    assert survey(tmp_path).format == "none"
    with pytest.raises(InputError, match="no scene found"):
        load_scene(tmp_path)


def beside_the_file(folder: Path, write: Callable[[Path], Path]) -> None:
    """As exported, but with the photographs beside the file."""
    write(folder)
    for path in (folder / "images").iterdir():
        path.rename(folder / path.name)
    (folder / "images").rmdir()


@pytest.mark.parametrize("write", [write_metashape, write_reality])
@pytest.mark.parametrize(
    ("files", "inside"),
    [
        (("config.json", "log.jsonl"), "test"),
        (("config.json", "test/metrics.json"), "test"),
        (("config.json", "log.jsonl"), "scene/photographs"),
        (("pose.json", "transforms.json"), "photographs"),
    ],
)
def test_a_run_in_the_folder_holds_no_photographs(
    tmp_path: Path, write: Callable[[Path], Path], files: tuple[str, ...], inside: str
) -> None:
    beside_the_file(tmp_path, write)
    run = tmp_path / "runs" / "a"
    for name in files:
        (run / name).parent.mkdir(parents=True, exist_ok=True)
        (run / name).touch()
    write_pictures(run / inside, ["000.png", "001.png.png"])
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == [f"{k:03d}.png" for k in range(4)]
    assert not any("have no camera" in said for said in (*scene.notes, *scene.warnings))


def test_an_exact_file_name_comes_before_a_stem(tmp_path: Path) -> None:
    beside_the_file(tmp_path, write_reality)
    write_pictures(tmp_path / "rendered", ["000.png.png"])
    assert "000.png" in [view.name for view in load_scene(tmp_path).views]
