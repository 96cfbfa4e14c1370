"""What a scene's files say twice, or cannot mean, is refused in one sentence that names it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.scenes.test_colmap import write_model
from tests.scenes.test_llff import write_llff
from tests.support.tiny_scenes import save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats import colmap_points
from warpnerf.scenes.formats.load import load_scene

Row = list[str]


def edited(folder: Path, name: str, change: Callable[[list[Row]], list[Row]]) -> Path:
    """A COLMAP model in text, one file of which has other rows."""
    write_transforms(folder)
    (folder / "transforms.json").unlink()
    file = write_model(folder, text=True) / name
    rows = [line.split() for line in file.read_text().splitlines() if not line.startswith("#")]
    if name == "images.txt":
        rows = [row for row in rows if len(row) == 10]
    after = "\n\n" if name == "images.txt" else "\n"
    file.write_text("".join(" ".join(row) + after for row in change(rows)))
    return folder


@pytest.mark.parametrize(
    ("name", "change", "says"),
    [
        ("cameras.txt", lambda rows: [*rows, rows[0]], "two cameras have the number 7"),
        (
            "images.txt",
            lambda rows: [*rows[:-1], [rows[0][0], *rows[-1][1:]]],
            "2 images have the number 1; remove",
        ),
        (
            "images.txt",
            lambda rows: [*rows, ["99", *rows[0][1:]]],
            "2 images have the name 000.png; remove",
        ),
    ],
)
def test_what_is_given_twice(
    name: str, change: Callable[[list[Row]], list[Row]], says: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"{name}: {says}"):
        load_scene(edited(tmp_path / "scene", name, change))


def test_an_image_whose_name_is_that_of_a_folder(tmp_path: Path) -> None:
    folder = edited(
        tmp_path / "scene", "images.txt", lambda rows: [[*rows[0][:-1], "."], *rows[1:]]
    )
    scene = load_scene(folder)
    assert len(scene.views) == 3
    assert any("left out 1 of 4 images for want of a photograph" in w for w in scene.warnings)


@pytest.mark.parametrize("bounds", [(9.0, 1.0), (2.0, 2.0), (0.0, 0.0), (0.0, -3.0)])
def test_bounds_in_the_wrong_order(bounds: tuple[float, float], tmp_path: Path) -> None:
    file = write_llff(tmp_path / "scene")
    rows = np.load(file)
    rows[1, -2:] = bounds
    np.save(file, rows)
    with pytest.raises(InputError, match="row 1: the near bound must be below the far"):
        load_scene(tmp_path / "scene")


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_a_distortion_of_no_lens(model: str, tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "scene")
    save(tmp_path / "scene/transforms.json", content | {"camera_model": model, "k1": 1e300})
    assert json.loads((tmp_path / "scene/transforms.json").read_text())["k1"] == 1e300
    with pytest.raises(InputError, match=r"k1 = 1e\+300 is the distortion of no lens"):
        load_scene(tmp_path / "scene")


def test_points_that_do_not_fit_the_memory_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = edited(tmp_path / "scene", "cameras.txt", lambda rows: rows)
    (folder / "sparse/0/points3D.bin").write_bytes(bytes(1000))

    def full(file: Path) -> None:
        raise MemoryError

    monkeypatch.setattr(colmap_points, "_of_bytes", full)
    with pytest.raises(InputError, match=r"points3D.bin: has 1e-06 GB, more than the memory"):
        load_scene(folder)


def test_a_shape_of_booleans(tmp_path: Path) -> None:
    """Python takes True for 1, and NumPy does not always."""
    file = write_llff(tmp_path / "scene")
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (True, 17), }"
    file.write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(136))
    with pytest.raises(InputError, match=r"has the shape \[True, 17\]; save it again"):
        load_scene(tmp_path / "scene")


def test_different_photographs_at_one_pose_are_named(tmp_path: Path) -> None:
    """As of poses that were repeated where none was found."""
    content = write_transforms(tmp_path, 9)
    for k in (4, 5):
        content["frames"][k]["transform_matrix"] = content["frames"][3]["transform_matrix"]
    (tmp_path / "images/005.png").write_bytes((tmp_path / "images/003.png").read_bytes())
    save(tmp_path / "transforms.json", content)
    said = [warning for warning in load_scene(tmp_path).warnings if "003" in warning]
    assert said[0].startswith(
        "different photographs at the same pose: 1 of 9 images (first: images/004.png, as images/0"
    )
    assert said[1].startswith("the same photograph from the same place: 1 of 9 images")
    assert len(said) == 2
