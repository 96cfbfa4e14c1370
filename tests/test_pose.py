"""From photographs to a scene, around COLMAP: what is asked of it, and what is made of its answer.

COLMAP's answer is made up here; tests/test_pose_colmap.py asks COLMAP itself.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image
from tiny_scenes import picture, ring, write_transforms

from warpnerf.checks import InputError
from warpnerf.scenes.load import load_scene
from warpnerf.sfm import pose as module
from warpnerf.sfm.config import PoseConfig
from warpnerf.sfm.pose import is_made_of, pose
from warpnerf.sfm.summary import Posing

N = 12
PLY = """ply
format ascii 1.0
element vertex 1
property float x
property float y
property float z
end_header
0 0 0
"""


class Colmap:
    """Stands for ``sfm.worker.estimate``: places photographs on a ring."""

    def __init__(self) -> None:
        self.job: dict[str, Any] = {}
        self.changes: dict[str, Any] = {}
        self.lost: tuple[str, ...] = ()
        self.lens: dict[str, Any] = {"model": "SIMPLE_RADIAL"}

    def __call__(self, job: dict[str, Any], on_report: Any) -> dict[str, Any]:
        self.job = job
        names = [p["name"] for p in job["photographs"]]
        for name in names:
            assert (Path(job["images"]) / name).is_file()
        on_report("features", len(names), len(names))
        placed = [name for name in names if name not in self.lost]
        Path(job["model"]).mkdir(parents=True)
        (Path(job["model"]) / "points.bin").touch()
        Path(job["points"]).write_text(PLY)
        poses = zip(placed, ring(len(placed)), strict=True)
        lens = {"w": 8, "h": 6, "fl_x": 10.0, "fl_y": 10.0, "cx": 4.0, "cy": 3.0, "k1": 0.01}
        return {
            "registered": {name: p[:3].tolist() for name, p in poses},
            "cameras": dict.fromkeys(placed, lens | self.lens),
            "points": 321,
            "error": 0.5,
            "groups": [placed],
            "features": dict.fromkeys(names, 1000),
            "links": {},
        } | self.changes


@pytest.fixture
def colmap(monkeypatch: pytest.MonkeyPatch) -> Colmap:
    made_up = Colmap()
    monkeypatch.setattr(module, "estimate", made_up)
    monkeypatch.setattr(module, "require_pycolmap", lambda: None)
    return made_up


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    return photographs(tmp_path / "photos")


def photographs(folder: Path, n: int = N, times: int = 1) -> Path:
    folder.mkdir(parents=True)
    for k in range(n):
        Image.fromarray(picture(k, width=8 * times, height=6 * times)).save(folder / f"{k:02}.png")
    return folder


def listing(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_a_scene_of_its_own_is_whole_and_the_photographs_stay(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    before = listing(photos)
    posing = pose(photos, tmp_path / "new" / "scene")
    assert listing(photos) == before
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["scene"]
    assert (posing.registered, posing.photographs, posing.points) == (N, N, 321)
    scene = load_scene(tmp_path / "new" / "scene")
    assert [view.name for view in scene.views] == [f"images/{k:02}.png" for k in range(N)]
    assert not scene.warnings
    camera = scene.views[3].camera
    assert (camera.fx, camera.cx, camera.k1, camera.k2) == (10.0, 4.0, 0.01, 0.0)
    np.testing.assert_allclose(camera.c2w, ring(N)[3][:3], atol=1e-12)
    content = json.loads((tmp_path / "new" / "scene" / "transforms.json").read_text())
    assert content["ply_file_path"] == "sparse_pc.ply" and "k1" not in content["frames"][0]


@pytest.mark.parametrize("inside", ["", "images"])
def test_the_scene_may_be_the_photographs_folder(
    tmp_path: Path, colmap: Colmap, inside: str
) -> None:
    folder = tmp_path / "capture"
    photographs(folder / inside)
    before = listing(folder)
    pose(folder, folder)
    assert before.items() <= listing(folder).items()
    assert {"transforms.json", "pose.json", "sparse_pc.ply"} <= listing(folder).keys()
    assert len(list(folder.rglob("*.png"))) == N  # none of them twice
    assert len(load_scene(folder).views) == N
    with pytest.raises(InputError, match=r"holds a posed scene already; .*--overwrite"):
        pose(folder, folder)
    pose(folder, folder, overwrite=True)
    assert len(load_scene(folder).views) == N


def test_overwriting_removes_what_was_written_and_nothing_else(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    pose(photos, tmp_path / "scene")
    (tmp_path / "scene" / "images" / "mine.txt").write_text("mine")
    pose(photographs(tmp_path / "others", 4), tmp_path / "scene", overwrite=True)
    assert len(load_scene(tmp_path / "scene").views) == 4
    assert len(list((tmp_path / "scene" / "images").iterdir())) == 5
    assert len(list(photos.iterdir())) == N


def test_a_scene_can_be_posed_anew_in_place(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    scene = tmp_path / "scene"
    pose(photos, scene)
    for path in photos.iterdir():
        path.unlink()  # its photographs are the only ones now
    pose(scene, scene, overwrite=True)
    assert len(load_scene(scene).views) == N
    pose(photographs(tmp_path / "others", 4), scene, overwrite=True)  # they still go with it
    assert len(load_scene(scene).views) == len(list((scene / "images").iterdir())) == 4


def test_interrupted_at_any_file_of_the_new_scene_a_whole_one_is_there(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = photographs(tmp_path / "others", 4)
    replace_file, done = Path.replace, 0

    def cut(self: Path, target: Path) -> Path:
        nonlocal done
        if done == last:
            raise KeyboardInterrupt
        done += 1
        return replace_file(self, target)

    for last in range(8):
        scene, done = tmp_path / f"scene {last}", 0
        pose(photos, scene)
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Path, "replace", cut)
            pose(others, scene, overwrite=True)
        assert len(json.loads((scene / "transforms.json").read_text())["frames"]) == N
        assert all((scene / "images" / f"{k:02}.png").exists() for k in range(N))
        pose(others, scene, overwrite=True)
        assert len(load_scene(scene).views) == 4


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


def test_a_record_from_elsewhere_removes_nothing_outside(
    tmp_path: Path, photos: Path, colmap: Colmap
) -> None:
    pose(photos, tmp_path / "scene")
    record = json.loads((tmp_path / "scene" / "pose.json").read_text())
    record["written"] += ["../photos/00.png", str(photos / "01.png"), "."]
    (tmp_path / "scene" / "pose.json").write_text(json.dumps(record))
    pose(photos, tmp_path / "scene", overwrite=True)
    assert len(list(photos.iterdir())) == N


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda out: out.write_text(""), "is a file"),
        (lambda out: write_transforms(out), "holds a scene already"),
        (lambda out: photographs(out), "holds other files"),
    ],
)
def test_a_folder_that_is_taken_is_refused(
    tmp_path: Path, photos: Path, colmap: Colmap, make: Any, says: str
) -> None:
    make(tmp_path / "scene")
    with pytest.raises(InputError, match=f"--output .*scene {says}"):
        pose(photos, tmp_path / "scene", overwrite=True)
    assert not colmap.job


def test_what_fails_leaves_nothing_behind(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(job: dict[str, Any], on_report: Any) -> dict[str, Any]:
        assert len(list(tmp_path.iterdir())) == 2
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "estimate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        pose(photos, tmp_path / "runs" / "scene")
    assert list(tmp_path.iterdir()) == [photos]
    assert len(list(photos.iterdir())) == N


def test_what_a_killed_process_left_is_swept(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    dead, alive = tmp_path / ".scene.4194304999.tmp", tmp_path / f".scene.{os.getppid()}.tmp"
    for folder in (dead, alive):
        (folder / "work").mkdir(parents=True)
    pose(photos, tmp_path / "scene")
    assert alive.exists() and not dead.exists()


def test_a_disk_that_cannot_be_written_is_named(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module, "put_into", full)
    with pytest.raises(InputError, match=r"--output .*scene cannot be written: No space left"):
        pose(photos, tmp_path / "scene")
    assert list(tmp_path.iterdir()) == [photos]


# --- What is asked of COLMAP --------------------------------------------------------------------


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


def test_a_scene_knows_what_it_is_made_of(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    scene, config = tmp_path / "scene", PoseConfig()
    assert not is_made_of(scene, photos, config)
    posing: Posing = pose(photos, scene, config)
    assert posing.folder == scene
    assert is_made_of(scene, photos, PoseConfig(threads=1))
    assert not is_made_of(scene, photos, PoseConfig(mapper="global"))
    Image.fromarray(picture(99)).save(photos / "new.png")
    assert not is_made_of(scene, photos, config)


def test_the_same_masks_named_from_elsewhere_are_the_same(
    tmp_path: Path, photos: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    photographs(tmp_path / "masks")
    pose(photos, tmp_path / "scene", PoseConfig(masks=tmp_path / "masks"))
    monkeypatch.chdir(tmp_path)
    assert is_made_of(Path("scene"), Path("photos"), PoseConfig(masks=Path("masks")))


def test_half_a_scene_is_made_again(tmp_path: Path, photos: Path, colmap: Colmap) -> None:
    pose(photos, tmp_path / "scene")
    assert is_made_of(tmp_path / "scene", photos, PoseConfig())
    (tmp_path / "scene" / "transforms.json").unlink()
    assert not is_made_of(tmp_path / "scene", photos, PoseConfig())


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
