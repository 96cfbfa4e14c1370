"""A folder without a scene: what it holds, and the one command for it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import scene_with_model
from tests.support.tiny_scenes import picture, save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats import contents
from warpnerf.scenes.formats.contents import is_unposed, photographs_in, what_is_there
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.formats.survey import survey


def photographs(folder: Path, n: int = 4, ending: str = "jpg") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(n):
        Image.fromarray(picture(k)).save(folder / f"{k}.{ending}")


def empty_file(name: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()

    return make


def half_a_model(folder: Path) -> None:
    """That poses are taken from, or nothing: others are not estimated unasked."""
    photographs(folder / "images")
    empty_file("sparse/0/cameras.bin")(folder)
    assert not is_unposed(folder)


def a_run(folder: Path) -> None:
    photographs(folder / "run", ending="png")
    for name in ("config.json", "log.jsonl"):
        (folder / "run" / name).touch()


def two_scenes(folder: Path) -> None:
    write_transforms(folder / "a")
    write_transforms(folder / "b")


def beside_photographs(name: str, content: str = "") -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        photographs(folder / "images")
        empty_file(name)(folder)
        (folder / name).write_text(content)

    return make


def renamed(*names: str) -> Callable[[Path], None]:
    """Files of frames of other names than those that are looked for."""

    def make(folder: Path) -> None:
        content = write_transforms(folder)
        (folder / "transforms.json").unlink()
        for name in names:
            save(folder / name, content)
        assert not is_unposed(folder)

    return make


def a_model_below_sparse(folder: Path) -> None:
    scene_with_model(folder)
    (folder / "sparse" / "0").rename(folder / "sparse" / "mine")
    assert not is_unposed(folder)


def test_frames_of_any_name_are_read_where_they_are_named(tmp_path: Path) -> None:
    renamed("cam1.json")(tmp_path)
    assert len(load_scene(tmp_path / "cam1.json").views) == 4
    assert survey(tmp_path / "cam1.json").format == "instant-ngp / nerfstudio (cam1.json)"


def two_npz(folder: Path) -> None:
    for name in ("a", "b"):
        np.savez(folder / f"{name}.npz", images=np.zeros(1), poses=np.zeros(1))
    np.savez(folder / "other.npz", density=np.zeros(1))


def many_folders(folder: Path) -> None:
    """More than are looked into, the first of them a scene."""
    write_transforms(folder / "days/0")
    for k in range(1, 201):
        (folder / f"days/{k}").mkdir()


def photographs_and_heic(folder: Path) -> None:
    photographs(folder)
    empty_file("a.HEIC")(folder)


def two_cameras(folder: Path) -> None:
    photographs(folder / "left", 3)
    photographs(folder / "right", 4)


def stray_scanner(folder: Path) -> None:
    empty_file("rgb.mp4")(folder)
    (folder / "odometry.csv").write_text("timestamp, frame, x, y, z, qx, qy, qz, qw\n")


def few_above(folder: Path) -> None:
    photographs(folder, 3)
    photographs(folder / "images", 4)


UNREAD = r"holds poses in a form that is not read \({}\); .*, or .* `warpnerf pose .*s --output"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (renamed("transforms_all.json"), "it holds transforms_all.json; use .*/transforms_all.js"),
        (renamed("transforms_test.json", "transforms_val.json"), "test.json, transforms_val.json;"),
        (renamed("cam1.json", "cam2.json"), r"it holds cam1\.json, cam2\.json; use .*/cam1\.json"),
        (a_model_below_sparse, "its COLMAP model is in sparse/mine; use .*/s/sparse/mine"),
        (two_npz, r"it holds a\.npz, b\.npz; use .*/s/a\.npz"),
        (beside_photographs("scene.nvm"), UNREAD.format(r"scene\.nvm")),
        (beside_photographs("images/0.xmp", '<a xcr:Rotation="1">'), UNREAD.format(".*0.xmp")),
        (beside_photographs("a.csv", "#name,x,y,heading,pitch,roll"), UNREAD.format(".*a.csv")),
        (beside_photographs("a.txt", "# X, Y, Z, Omega, Phi, Kappa"), UNREAD.format(".*a.txt")),
        (beside_photographs("images/0.XMP", "<xcr:Position>"), UNREAD.format(".*0.XMP")),
        (beside_photographs("a.xml", "<?xml?>\n<BlocksExchange "), UNREAD.format("a.xml")),
        (
            beside_photographs("params/a.txt", "imageName X Y Z Omega Phi Kappa"),
            UNREAD.format("params/a.txt"),
        ),
        *(
            (beside_photographs(name, content), UNREAD.format(name.replace(".", r"\.")))
            for name, content in (
                ("cams/00000000_cam.txt", "extrinsic"),
                ("traj.txt", "1 0 0 0"),
                ("poses.txt", "1 0 0 0"),
                ("poses.npy", ""),
                ("frame-000000.pose.txt", "1 0 0 0"),
                ("groundtruth.txt", "# timestamp tx ty tz qx qy qz qw"),
                ("frame_00000.json", '{"cameraPoseARFrame": [1, 0, 0, 0]}'),
                ("meta_data.json", '{"frames": [{"camtoworld": [[1]]}]}'),
                ("predictions.npz", ""),
            )
        ),
        (
            beside_photographs("images/frame_0.json", '{"exposure": 1}'),
            "it holds 4 photographs without",
        ),
        (stray_scanner, r"that is not read \(odometry\.csv\); .*, or .* pose .*/rgb\.mp4 --output"),
        (empty_file("VID_1.insv"), r"holds 1 recording of a 360-degree camera .*VID_1\.insv"),
        (beside_photographs("a.json", '{"frames": []}'), "it holds 4 photographs without"),
        (beside_photographs("images/0.xmp", "<crs:Exposure/>"), "it holds 4 photographs without"),
        (empty_file("camera/0.json"), r"that is not read \(camera/0\.json\); export"),
        (photographs_and_heic, "it holds 4 photographs without poses, and 1 as HEIC, to be conv"),
        (two_cameras, "2 of its folders hold 7 photographs .* those of right alone by .*/s/right"),
        (few_above, "it holds 3 photographs without poses, and 4 in images; .* pose .*/s/images"),
        (photographs, "holds 4 photographs without poses; .*`warpnerf pose .*s --output SCENE`"),
        (lambda f: photographs(f / "images"), "holds 4 photographs without poses"),
        (lambda f: photographs(f, 2), "holds 2 photographs, and poses need at least 3"),
        (lambda f: photographs(f, 1), "holds 1 photograph, and"),
        (lambda f: photographs(f / "day 1"), r"its folder day 1 .* pose '.*day 1' --output"),
        (empty_file("walk.MOV"), r"holds the video walk\.MOV; .*`warpnerf pose .*walk\.MOV "),
        (empty_file("a.HEIC"), "holds 1 photographs as HEIC; convert them to JPEG"),
        (lambda f: write_transforms(f / "room"), "its folder room holds one; use .*s/room"),
        (
            lambda f: write_transforms(f / "home/capture 1/a"),
            r"its folder home/capture 1/a holds o",
        ),
        (lambda f: write_transforms(f / "a/b/c/d"), "neither poses nor photographs nor a video"),
        (two_scenes, r"2 of its folders hold one each \(first: a\); use .*s/a"),
        (many_folders, "neither poses nor photographs nor a video"),
        (empty_file("sparse/0/cameras.bin"), "its COLMAP model lacks sparse/0/images.bin"),
        (half_a_model, r"lacks sparse/0/images\.bin; .* again, or .* `warpnerf pose .*s --output"),
        (empty_file("images.txt"), r"its COLMAP model lacks cameras\.txt"),
        (empty_file("database.db"), "a database of COLMAP but no model"),
        (a_run, "it holds neither poses nor photographs nor a video"),
        (empty_file("notes.odt"), "neither poses nor photographs nor a video"),
        (lambda f: None, "it is empty"),
    ],
)
def test_what_a_folder_without_a_scene_holds(
    tmp_path: Path, make: Callable[[Path], object], says: str
) -> None:
    folder = tmp_path / "s"
    folder.mkdir()
    make(folder)
    with pytest.raises(InputError, match=rf"s: no scene found: .*{says}"):
        load_scene(folder)


def test_photographs_of_a_scene_lead_to_it(tmp_path: Path) -> None:
    write_transforms(tmp_path / "s")
    images = tmp_path / "s" / "images"
    assert not is_unposed(images)
    says = f"it is a folder of the scene s; use {tmp_path / 's'}, or estimate other poses by"
    assert what_is_there(images).startswith(says)
    assert is_unposed(images.rename(tmp_path / "s" / "others"))


@pytest.mark.parametrize("name", ["transforms_all.json", "transforms_test.json"])
def test_a_file_of_frames_of_any_name_is_read_where_it_is_named(tmp_path: Path, name: str) -> None:
    renamed(name)(tmp_path)
    assert len(load_scene(tmp_path / name).views) == 4
    assert survey(tmp_path / name).format == f"instant-ngp / nerfstudio ({name})"


def test_what_is_missing_is_installed_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contents.importlib.util, "find_spec", lambda name: None)
    photographs(tmp_path)
    assert '`pip install "warpnerf[sfm]"` and `warpnerf pose' in what_is_there(tmp_path)


def test_a_video_is_no_scene_but_one_can_be_made_of_it(tmp_path: Path) -> None:
    (tmp_path / "a b.mp4").touch()
    with pytest.raises(InputError, match=r"is a video, .*`warpnerf pose '.*a b\.mp4' --output"):
        load_scene(tmp_path / "a b.mp4")


def test_photographs_directly_in_a_folder_come_before_those_in_images(tmp_path: Path) -> None:
    photographs(tmp_path / "images", ending="png")
    (tmp_path / "images" / ".hidden.png").touch()
    assert [path.name for path in photographs_in(tmp_path)] == [f"{k}.png" for k in range(4)]
    photographs(tmp_path, 3)
    assert [path.name for path in photographs_in(tmp_path)] == ["0.jpg", "1.jpg", "2.jpg"]


def test_what_poses_can_be_estimated_of(tmp_path: Path) -> None:
    photographs(tmp_path / "photos")
    photographs(tmp_path / "few", 2)
    write_transforms(tmp_path / "scene")
    np.save(tmp_path / "few" / "poses_bounds.npy", np.zeros((2, 17)))
    (tmp_path / "walk.mp4").touch()
    unposed = {path.name for path in tmp_path.iterdir() if is_unposed(path)}
    assert unposed == {"photos", "walk.mp4"}
    assert not is_unposed(tmp_path / "nowhere.mp4")


def test_an_exported_volume_does_not_make_photographs_a_scene(tmp_path: Path) -> None:
    photographs(tmp_path)
    np.savez(tmp_path / "volume.npz", density=np.zeros((2, 2, 2)))
    assert is_unposed(tmp_path)
    with pytest.raises(InputError, match="it holds 4 photographs without poses"):
        load_scene(tmp_path)
    np.savez(tmp_path / "volume.npz", images=np.zeros(1), poses=np.zeros(1), focal=1.0)
    assert not is_unposed(tmp_path)
