"""LLFF: poses in an array, photographs by order."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import assert_same
from tests.support.tiny_scenes import DATA, needs_capture, ring, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.inspection.inspection import inspect
from warpnerf.scenes.formats.load import load_scene


def rows_of(n: int) -> np.ndarray:
    """[n, 17] of the poses of ``write_transforms``, with a focal length of 10 pixels of 8 x 6."""
    rows = []
    for pose in ring(n):
        right, up, backward, position = pose[:3].T
        matrix = np.stack([-up, right, backward, position, [6.0, 8.0, 10.0]], axis=1)
        rows.append([*matrix.ravel(), 1.0, 9.0])
    return np.array(rows)


def write_llff(folder: Path, n: int = 4) -> Path:
    content = write_transforms(folder, n)
    (folder / "transforms.json").unlink()
    np.save(folder / "poses_bounds.npy", rows_of(n))
    assert content["w"] == 8
    return folder / "poses_bounds.npy"


def test_the_scene_is_that_of_transforms_json(tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "a")
    save(tmp_path / "a" / "transforms.json", content | {"fl_y": 10.0, "cx": 4.0, "cy": 3.0})
    write_llff(tmp_path / "b")
    assert_same(load_scene(tmp_path / "b"), load_scene(tmp_path / "a"))
    assert_same(load_scene(tmp_path / "b" / "poses_bounds.npy"), load_scene(tmp_path / "a"))
    assert inspect(tmp_path / "b").format == "LLFF (poses_bounds.npy)"


def test_reduced_photographs_have_a_reduced_lens(tmp_path: Path) -> None:
    write_llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "images_2")
    for file in (tmp_path / "images_2").iterdir():
        Image.open(file).resize((4, 3)).save(file)
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.width, camera.height) == (4, 3)
    assert (camera.fx, camera.fy) == pytest.approx((5.0, 5.0))


def test_masks_beside_photographs_are_no_photographs(tmp_path: Path) -> None:
    write_llff(tmp_path)
    Image.fromarray(255 * np.eye(6, 8, dtype=np.uint8)).save(tmp_path / "images" / "000.mask.png")
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    (mask,) = [view.mask for view in scene.views if view.mask is not None]
    assert np.array_equal(mask, np.eye(6, 8, dtype=bool))


@pytest.mark.parametrize("place", ["images", ".", "rgb", "input"])
def test_photographs_are_found_and_those_of_macos_are_none(tmp_path: Path, place: str) -> None:
    write_llff(tmp_path)
    (tmp_path / place).mkdir(exist_ok=True)
    for file in sorted((tmp_path / "images").iterdir()):
        file.rename(tmp_path / place / file.name)
        (tmp_path / place / f"._{file.name}").write_bytes(b"\0\5\x16\7")
    if place != "images":
        (tmp_path / "images").rmdir()
    assert len(load_scene(tmp_path).views) == 4


def test_photographs_that_are_links_out_of_the_folder_are_refused(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    write_llff(folder)
    (folder / "images").rename(tmp_path / "images")
    (folder / "images").mkdir()
    for file in (tmp_path / "images").iterdir():
        (folder / "images" / file.name).symlink_to(file)
    with pytest.raises(InputError, match=r"row 0: .images/000.png. follows a link out of the sce"):
        load_scene(folder)


def test_photographs_of_several_folders_are_in_no_order(tmp_path: Path) -> None:
    write_llff(tmp_path)
    (tmp_path / "images").rename(tmp_path / "left")
    (tmp_path / "right").mkdir()
    (tmp_path / "left/003.png").rename(tmp_path / "right/000.png")
    with pytest.raises(InputError, match=r"in 2 folders \(first: left, right\); put those of"):
        load_scene(tmp_path)
    for name in ("left", "right"):
        shutil.rmtree(tmp_path / name)
    with pytest.raises(InputError, match="photographs are not there; put them into images/"):
        load_scene(tmp_path)


@pytest.mark.parametrize("near", [0.0, -1.0])
def test_dummy_bounds_are_not_used(tmp_path: Path, near: float) -> None:
    file = write_llff(tmp_path)
    assert load_scene(tmp_path).bounds is not None
    rows = rows_of(4)
    rows[1:, 15:] = near, 5.0
    np.save(file, rows)
    scene = load_scene(tmp_path)
    assert scene.bounds is None
    said = f"the near bound of 3 of 4 rows is not above 0 (first: row 1, {near:.4g} with 5)"
    assert any(warning.endswith(said) for warning in scene.warnings)


def test_what_is_wrong_is_named(tmp_path: Path) -> None:
    file = write_llff(tmp_path)
    rows = rows_of(4)
    for wrong, says in (
        (rows[:3], "holds 3 poses, but .*images 4 photographs"),
        (rows[:, :16], r"must hold an array \[n, 17\], not \[4, 16\]"),
        (rows[0], r"must hold an array \[n, 17\], not \[17\]"),
        (rows * np.nan, "finite numbers only"),
        (rows * 0.0, "row 0: height, width and focal length must be above 0"),
        (rows.astype(object), "is not readable as an array"),
        (rows * np.where(np.arange(17) < 2, 2.0, 1.0), "row 0: "),
    ):
        np.save(file, wrong, allow_pickle=True)
        with pytest.raises(InputError, match=says):
            load_scene(tmp_path)
    for content in (b"", b"no array", rows.tobytes()):
        file.write_bytes(content)
        with pytest.raises(InputError, match="is not readable as an array"):
            load_scene(tmp_path)


@needs_capture("fern_llff")
def test_a_capture() -> None:
    scene = load_scene(DATA / "fern_llff")
    assert len(scene.views) == 20
    camera = scene.views[0].camera
    assert (camera.width, camera.height) == (504, 378) and 350.0 < camera.fx < 450.0
