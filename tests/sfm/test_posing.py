"""From photographs to a scene, around COLMAP: what is asked of it, and what is made of its answer.

COLMAP's answer is made up; tests/sfm/test_colmap_itself.py asks COLMAP itself.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from tests.support.fake_colmap import Colmap, N, photographs
from tests.support.tiny_scenes import picture
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.sfm import pose as module
from warpnerf.sfm.config import PoseConfig
from warpnerf.sfm.pose import pose


def test_few_photographs_are_all_compared_and_many_with_neighbours(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    pose(photos, tmp_path / "a")
    assert colmap.job["matching"] == "exhaustive"
    monkeypatch.setattr(module, "EXHAUSTIVE_UP_TO", N - 1)
    posing = pose(photos, tmp_path / "b")
    assert colmap.job["matching"] == "sequential"
    assert any("--matching exhaustive" in note for note in posing.notes)
    pose(photos, tmp_path / "c", PoseConfig(matching="exhaustive"))
    assert colmap.job["matching"] == "exhaustive"


def test_a_lens_that_few_share_is_a_simple_one(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    pose(photos, tmp_path / "a")
    assert {p["camera_model"] for p in colmap.job["photographs"]} == {"RADIAL"}
    pose(photos, tmp_path / "b", PoseConfig(lenses="each"))
    assert {p["camera_model"] for p in colmap.job["photographs"]} == {"SIMPLE_RADIAL"}
    pose(photos, tmp_path / "c", PoseConfig(lenses="each", camera_model="PINHOLE"))
    assert {p["camera_model"] for p in colmap.job["photographs"]} == {"PINHOLE"}


def test_fisheye_lenses_come_through(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    colmap.lens = {"model": "OPENCV_FISHEYE", "k3": 0.02, "k4": -0.01}
    pose(photos, tmp_path / "scene", PoseConfig(camera_model="OPENCV_FISHEYE"))
    assert {p["camera_model"] for p in colmap.job["photographs"]} == {"OPENCV_FISHEYE"}
    camera = load_scene(tmp_path / "scene").views[0].camera
    assert camera.fisheye and (camera.k1, camera.k3, camera.k4) == (0.01, 0.02, -0.01)


def test_masks_are_where_colmap_looks_and_the_scene_names_them(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    masks = tmp_path / "my masks"
    masks.mkdir()
    white = np.zeros((6, 8, 3), np.uint8)
    white[:, 4:] = 255
    Image.fromarray(white).save(masks / "03.png")

    def checked(job: dict[str, Any], on_report: Any) -> dict[str, Any]:
        (mask,) = Path(job["masks"]).iterdir()
        assert mask.name == "03.png.png"
        assert np.asarray(Image.open(mask)).sum() == 6 * 4
        return colmap(job, on_report)

    monkeypatch.setattr(module, "estimate", checked)
    pose(photos, tmp_path / "scene", PoseConfig(masks=masks))
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    named = {frame["file_path"]: frame.get("mask_path") for frame in frames}
    assert named["images/03.png"] == "masks/03.png" and named["images/04.png"] is None
    view = load_scene(tmp_path / "scene").views[3]
    assert view.mask is not None and np.array_equal(view.mask, white[..., 0] > 0)


def test_masks_that_a_scene_cannot_name_are_named(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    for name in ("dynamic_mask_03.png", "dynamic_mask_05.png", "04.png.mask.png"):
        Image.new("L", (8, 6), 255).save(photos / name)
    (note,) = pose(photos, tmp_path / "scene").notes
    assert "white is ignored are not used" in note and "2 (first: dynamic_mask_03.png)" in note
    assert "name them as 00.png.mask.png" in note


def test_masks_that_do_not_fit_are_left_aside(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    Image.new("L", (4, 3), 255).save(photos / "03.mask.png")
    Image.new("L", (8, 6), 255).save(photos / "04.mask.png")
    (note,) = pose(photos, tmp_path / "scene").notes
    assert note.startswith("not used as masks: 1 images") and "(first: 03.mask.png)" in note
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    assert [frame["mask_path"] for frame in frames if "mask_path" in frame] == ["masks/04.mask.png"]


def test_photographs_of_one_name_may_share_a_mask(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    Image.open(photos / "03.png").save(photos / "03.jpg")
    masks = tmp_path / "my masks"
    masks.mkdir()
    Image.new("L", (8, 6), 255).save(masks / "03.png")
    pose(photos, tmp_path / "scene", PoseConfig(masks=masks))
    frames = json.loads((tmp_path / "scene" / "transforms.json").read_text())["frames"]
    named = [frame["file_path"] for frame in frames if frame.get("mask_path") == "masks/03.png"]
    assert sorted(named) == ["images/03.jpg", "images/03.png"]


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"camera_model": "FISHEYE"}, "camera_model must be one of auto, SIMPLE_PINHOLE"),
        ({"matching": "all"}, "matching must be one of auto, exhaustive, sequential"),
        ({"frames": 2}, "frames must be a whole number of at least 3"),
        ({"max_image_size": 20}, "max_image_size must be a whole number of at least 100"),
        ({"threads": 0}, "threads must be"),
        ({"masks": Path("nowhere")}, "masks: nowhere is no folder"),
    ],
)
def test_a_wrong_configuration_is_refused(wrong: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        PoseConfig(**wrong)


# --- What is said of its answer -----------------------------------------------------------------


def test_it_says_who_was_not_placed_and_why(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    colmap.lost = ("01.png", "02.png", "03.png", "04.png")
    colmap.changes = {
        "features": dict.fromkeys((f"{k:02}.png" for k in range(N)), 1000) | {"01.png": 41},
        "groups": [["00.png"], ["02.png", "03.png", "04.png", "05.png"], ["01.png", "05.png"]],
        "links": {"02.png": (90, "03.png")},
    }
    posing = pose(photos, tmp_path / "scene")
    assert posing.registered == N - 4
    assert posing.missing == {
        "01.png": "only 41 features: blurred, dark, or of something plain",
        "02.png": "in a group of 3 that shares too little with the others",
        "03.png": "in a group of 3 that shares too little with the others",
        "04.png": "in a group of 3 that shares too little with the others",
    }
    (note,) = posing.notes
    assert note.startswith("the photographs fall into 2 groups that share too little (8, 3)")
    assert "registered 8 of 12 photographs; 321 points" in str(posing)
    assert "not registered: 04.png: in a group of 3" in str(posing)
    assert "lens SIMPLE_RADIAL for 8 x 6: focal length 10.0 pixels, k1 0.0100" in str(posing)
    assert len(load_scene(tmp_path / "scene").views) == N - 4


def test_it_says_how_little_lonely_photographs_share(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    colmap.lost = ("03.png", "04.png")
    colmap.changes = {"links": {"04.png": (17, "05.png")}}
    posing = pose(photos, tmp_path / "scene")
    assert posing.missing == {
        "03.png": "shares nothing with any other photograph",
        "04.png": "shares 17 points with 05.png, too few or too uncertain to place it",
    }
    assert not posing.notes


@pytest.mark.parametrize(
    ("features", "links", "says"),
    [
        (40, {}, "12 of them show too little .first: 00.png, 40 features.; take sharp"),
        (900, {}, "no two of them show the same; neighbours should share"),
        (900, {"a": (31, "b.png")}, r"though some match \(at most 31 points, with b.png\); move"),
    ],
)
def test_nothing_placed_is_one_sentence(
    tmp_path: Path, photos: Path, colmap: Colmap, features: int, links: Any, says: str
) -> None:
    names = [f"{k:02}.png" for k in range(N)]
    colmap.changes = {
        "registered": {},
        "features": dict.fromkeys(names, features),
        "links": links,
    }
    with pytest.raises(InputError, match=rf"photos: none of 12 photographs .*{says}"):
        pose(photos, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


def test_few_photographs_and_mixed_sizes_are_noted(tmp_path: Path, colmap: Colmap) -> None:
    photos = photographs(tmp_path / "photos", 5)
    (photos / "phone.heic").touch()
    Image.fromarray(picture(9, width=6, height=8)).save(photos / "tall.png")
    colmap.lost = ("tall.png",)
    notes = pose(photos, tmp_path / "scene").notes
    assert len(notes) == 3
    assert notes[0].startswith("left out 1 files whose format is not read (first: phone.heic)")
    assert notes[1].startswith("photographs of 2 sizes (first: tall.png 6x8, 00.png 8x6)")
    assert notes[2].startswith("only 6 photographs: ")


def test_photographs_of_the_shape_of_panoramas_are_noted(tmp_path: Path, colmap: Colmap) -> None:
    (tmp_path / "photos").mkdir()
    for k in range(N):
        Image.fromarray(picture(k, width=12, height=6)).save(tmp_path / "photos" / f"{k}.png")
    (note,) = pose(tmp_path / "photos", tmp_path / "scene").notes
    assert note.startswith("all photographs are exactly twice as wide as high: if they are pano")
    Image.fromarray(picture(0, width=8, height=6)).save(tmp_path / "photos" / "0.png")
    notes = pose(tmp_path / "photos", tmp_path / "scene", overwrite=True).notes
    assert not any("twice" in note for note in notes)


def test_a_photograph_that_colmap_cannot_read_is_named(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    colmap.changes = {"unread": ["04.png"]}
    with pytest.raises(
        InputError, match=r"photos: COLMAP cannot read 04\.png; save it as JPEG or PNG"
    ):
        pose(photos, tmp_path / "scene")


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("none", "none: does not exist; name a folder of photographs, or a video"),
        ("empty", "empty: no photographs to pose: it is empty"),
        ("notes.txt", r"notes\.txt: is neither a folder of photographs nor a video"),
    ],
)
def test_what_holds_no_photographs_is_refused(
    tmp_path: Path, colmap: Colmap, name: str, says: str
) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(InputError, match=says):
        pose(tmp_path / name, tmp_path / "scene")


def test_masks_do_not_go_with_a_video(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    (tmp_path / "a.mp4").touch()
    with pytest.raises(InputError, match="--masks go with photographs"):
        pose(tmp_path / "a.mp4", tmp_path / "scene", PoseConfig(masks=photos))


def test_without_pycolmap_it_says_what_to_install(
    tmp_path: Path, photos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r'pip install "warpnerf\[sfm\]"'):
        pose(photos, tmp_path / "scene")


def test_photographs_stored_turned_are_no_cause_for_a_warning(
    tmp_path: Path, colmap: Colmap
) -> None:
    (tmp_path / "photos").mkdir()
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    for k in range(N):
        Image.fromarray(picture(k)).save(tmp_path / "photos" / f"{k:02}.jpg", exif=exif)
    pose(tmp_path / "photos", tmp_path / "scene")
    assert not load_scene(tmp_path / "scene").warnings
    (tmp_path / "scene" / "pose.json").unlink()  # as if another program had made the scene
    (warning,) = load_scene(tmp_path / "scene").warnings
    assert warning.startswith("stored turned")
