"""Photographs that are not where a scene's file says: found by their names, or refused by them."""

from __future__ import annotations

import json
import shutil
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import change, scene_with_model, write_model
from tests.support.tiny_scenes import (
    picture,
    ring,
    save,
    transforms_content,
    write_blender,
    write_transforms,
)
from warpnerf.checks import InputError
from warpnerf.scenes.files import OTHER_IMAGES
from warpnerf.scenes.formats import frame_images
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene

FOUND = "4 of 4 photographs have another path than the file says, and are found by their names"
ELSEWHERE = (
    "4 of 4 photographs are found by their names only, in a folder that the file does not name"
)


def photographs(folder: Path, names: list[str]) -> None:
    """The photographs of ``write_transforms`` under other names."""
    for seed, name in enumerate(names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(picture(seed)).save(folder / name)


def named(folder: Path, names: list[str], **changes: Any) -> dict[str, Any]:
    """A transforms.json of ``write_transforms`` that gives the photographs other names."""
    content = transforms_content(len(names)) | changes
    for frame, name in zip(content["frames"], names, strict=True):
        frame["file_path"] = name
    folder.mkdir(parents=True, exist_ok=True)
    save(folder / "transforms.json", content)
    return content


def assert_read(scene: Scene) -> None:
    """Each photograph has the pose that the file gives it."""
    assert len(scene.views) == 4
    for view in scene.views:
        seed = next(i for i in range(4) if np.array_equal(view.image, picture(i)))
        np.testing.assert_allclose(view.camera.c2w, ring(4)[seed][:3], atol=1e-12)


def four(pattern: str) -> list[str]:
    return [pattern.format(f"{i:03d}") for i in range(4)]


ACCENT = unicodedata.normalize("NFC", "images/é{}.png")


@pytest.mark.parametrize(
    ("said", "there"),
    [
        ("images/{}.jpg", "images/{}.png"),
        ("images/{}.png", "images/{}.PNG"),
        ("images/{}", "images/{}.PNG"),
        ("images/img_{}.png", "images/IMG_{}.png"),
        (ACCENT, unicodedata.normalize("NFD", ACCENT)),
        (unicodedata.normalize("NFD", ACCENT), ACCENT),
        ("/home/me/capture/images/{}.png", "images/{}.png"),
        ("/home/me/capture/train/{}.png", "train/{}.png"),
        (r"C:\capture\images\{}.png", "images/{}.png"),
        ("../capture/images/{}.png", "images/{}.png"),
        ("/home/me/photographs/{}.png", "images/{}.png"),
        ("images/{}.png", "{}.png"),
        ("images/{}.png", "Images/{}.png"),
        ("{}.png", "Images/{}.png"),
        ("{}.png", "images/cam/{}.png"),
        ("/home/me/capture/train/{}.jpg", "train/{}.png"),
        ("/home/me/capture/renders/{}.png", "renders/{}.png"),
        ("images/{}.png", "images_2/{}.png"),
        ("images_4/{}.png", "images/{}.png"),
    ],
)
def test_photographs_are_found_by_their_names(tmp_path: Path, said: str, there: str) -> None:
    photographs(tmp_path, four(there))
    (tmp_path / "masks").mkdir()
    shutil.copy(tmp_path / four(there)[0], tmp_path / "masks" / Path(four(there)[0]).name)
    named(tmp_path, four(said), train_filenames=four(said)[1:], test_filenames=four(said)[:1])
    scene = load_scene(tmp_path)
    assert_read(scene)
    assert f"{FOUND} (first: {four(there)[0]} for " in "\n".join(scene.notes)
    assert [view.name for view in scene.views] == four(there)
    assert [scene.views[i].name for i in scene.splits["test"]] == four(there)[:1]


@pytest.mark.parametrize(
    ("said", "there"),
    [
        ("images/{}.png", "rgb/{}.png"),
        ("cam_1/{}.png", "images/cam_2/{}.png"),
        ("train/{}.png", "test/{}.png"),
        ("{}.jpg", "rgb/{}.png"),  # perhaps masks, or depths
        ("images/{}.jpg", "{}.png"),
        ("images/{}.png", "photographs/IMG_{}.png"),
    ],
)
def test_photographs_of_other_names_are_mentioned(tmp_path: Path, said: str, there: str) -> None:
    photographs(tmp_path, four(there))
    named(tmp_path, four(said))
    says = rf"no image of 4 frames .*, but 4 others are \(first: {four(there)[0]}\); put"
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def without_photographs(folder: Path, model: bool) -> None:
    """A scene of four photographs that are not there, by a COLMAP model or a transforms.json."""
    if model:
        scene_with_model(folder)
        shutil.rmtree(folder / "images")
    else:
        named(folder, four("{}.png"))


@pytest.mark.parametrize("ending", ["png", "PNG"])
@pytest.mark.parametrize("model", [False, True])
def test_photographs_of_a_folder_of_any_name_are_warned_of(
    tmp_path: Path, model: bool, ending: str
) -> None:
    without_photographs(tmp_path, model)
    photographs(tmp_path, four(f"rgb/{{}}.{ending}"))
    scene = load_scene(tmp_path)
    assert_read(scene)
    first = f"{ELSEWHERE} (first: rgb/000.{ending} for 000.png): if they are others, put the right"
    assert any(first in warning for warning in scene.warnings)
    assert not any("names" in note for note in scene.notes)


@pytest.mark.parametrize(
    "place",
    [
        *("normals", "sky_masks", "depth_maps", "semantic", "Thumbnails", "confidence"),
        *("renders", "test_renderings", "renders/masks", "out/normal-maps"),
    ],
)
@pytest.mark.parametrize("model", [False, True])
def test_images_that_are_named_after_photographs_are_none(
    tmp_path: Path, model: bool, place: str
) -> None:
    without_photographs(tmp_path, model)
    photographs(tmp_path, four(place + "/{}.png"))
    with pytest.raises(InputError, match=r"no image of 4 frames|none of the model's 4"):
        load_scene(tmp_path)


def test_folders_of_other_images_have_their_names() -> None:
    for name in ("mask", "sky_masks", "depth", "mono-depth_maps", "Normal_Images", "disparities"):
        assert OTHER_IMAGES.fullmatch(name)
    for name in ("images", "rgb", "photos_2024", "left", "masked_man", "abnormal"):
        assert not OTHER_IMAGES.fullmatch(name)


def test_names_of_every_folder_are_looked_up_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps grow as photographs do, though all folders have the same names."""
    steps = [0, 0]
    normalised = frame_images.normalised
    for run, n in enumerate((10, 40)):
        folder = tmp_path / str(n)
        names = [f"{i:03d}/cam{c}.png" for i in range(n) for c in range(2)]
        for name in names:
            path = folder / "images" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()

        def counted(name: str, run: int = run) -> str:
            steps[run] += 1
            return normalised(name)

        monkeypatch.setattr(frame_images, "normalised", counted)
        moved = [f"/home/me/images/{name}" for name in names]
        found, _ = frame_images.find_photographs(folder, folder, moved, str)
        assert [found[i] for i in range(2 * n)] == [folder / "images" / name for name in names]
    assert steps[1] < 5 * steps[0]


def test_what_another_name_leads_to_is_not_taken(tmp_path: Path) -> None:
    photographs(tmp_path, ["images/000.png", "images/001.png", "images/002.png"])
    named(tmp_path, ["images/000.png", "images/000.PNG", "images/001.png", "images/002.png"])
    scene = load_scene(tmp_path)
    assert len(scene.views) == 3
    assert "left out 1 of 4 frames for want of an image (first: images/000.PNG)" in str(
        scene.warnings
    )


def test_another_format_is_not_taken_where_others_have_the_files(tmp_path: Path) -> None:
    photographs(tmp_path, ["images/000.png", "images/001.png", "images/002.png", "images/003.bmp"])
    named(tmp_path, four("images/{}.png"))
    scene = load_scene(tmp_path)
    assert len(scene.views) == 3
    assert any("left out 1 of 4 frames" in warning for warning in scene.warnings)


def test_photographs_elsewhere_are_not_taken_for_a_few_that_are_missing(tmp_path: Path) -> None:
    photographs(tmp_path, four("{}.png"))
    (tmp_path / "blurred").mkdir()
    (tmp_path / "002.png").rename(tmp_path / "blurred/002.png")
    named(tmp_path, four("{}.png"))
    assert len(load_scene(tmp_path).views) == 3


@pytest.mark.parametrize("model", [False, True])
@pytest.mark.parametrize("kept", [False, True])
def test_photographs_that_were_converted_are_found(tmp_path: Path, model: bool, kept: bool) -> None:
    """Of formats that are not read, with or without the originals beside, and a few were not."""
    photographs(tmp_path, ["images/000.jpeg", *four("images/{}.png")[1:]])
    (tmp_path / "images/000.jpeg").rename(tmp_path / "images/000.png")
    if kept:
        for name in four("images/{}.HEIC"):
            (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic")
    names = [*four("{}.HEIC")[:3], "003.png"]
    if model:
        write_model(tmp_path, text=True)
        for old, new in zip(four("{}.png"), names, strict=True):
            change(tmp_path / "sparse/0/images.txt", old, new)
    else:
        named(tmp_path, [f"images/{name}" for name in names])
    scene = load_scene(tmp_path)
    assert sorted(view.name.rpartition("/")[2] for view in scene.views) == four("{}.png")
    assert any("3 of 4 photographs have another path than the file says" in n for n in scene.notes)


def test_photographs_that_are_to_be_converted_are_named(tmp_path: Path) -> None:
    named(tmp_path, four("images/{}.HEIC"))
    (tmp_path / "images").mkdir()
    for name in four("images/{}.HEIC"):
        (tmp_path / name).write_bytes(b"\0\0\0\x18ftypheic")
    with pytest.raises(InputError, match=r"images/00\d\.HEIC: is a HEIC file, .*; convert it to"):
        load_scene(tmp_path)


def test_photographs_are_read_whatever_their_ending_says(tmp_path: Path) -> None:
    """JPEG that a phone has called HEIC, for one."""
    photographs(tmp_path, four("images/{}.png"))
    named(tmp_path, four("images/{}.HEIC"))
    for old, new in zip(four("images/{}.png"), four("images/{}.HEIC"), strict=True):
        (tmp_path / old).rename(tmp_path / new)
    scene = load_scene(tmp_path)
    assert [view.name for view in scene.views] == four("images/{}.HEIC")


def both_endings(folder: Path) -> None:
    photographs(folder, [*four("images/{}.png"), *four("images/{}.bmp")])
    named(folder, four("images/{}.jpg"))


def two_folders(folder: Path) -> None:
    photographs(folder, [*four("left/{}.png"), *four("right/{}.png")])
    named(folder, four("{}.png"))


def two_frames(folder: Path) -> None:
    photographs(folder, four("images/{}.png"))
    named(folder, [*four("/home/me/cam_1/{}.png")[:3], "/home/me/cam_2/000.png"])


def a_link_out(folder: Path) -> None:
    photographs(folder / "..", four("{}.png"))
    (folder / "images").mkdir(parents=True)
    for name in four("{}.png"):
        (folder / "images" / name).symlink_to(folder.parent / name)
    named(folder, four("images/{}.jpg"))


def one_outside(folder: Path) -> None:
    photographs(folder, four("images/{}.png"))
    named(folder, ["/home/me/images/000.png", *four("images/{}.png")[1:]])


def none_there(folder: Path) -> None:
    (folder / "images").mkdir(parents=True)
    named(folder, four("/home/me/images/{}.png"))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (both_endings, r"'000.jpg' is the name of 2 photographs \(images/000.bmp, images/000.png"),
        (two_folders, r"'000.png' is the name of 2 photographs \(left/000.png, right/000.png"),
        (two_frames, r"cam_2/000.png' and '/home/me/cam_1/000.png' both lead to images/000.png"),
        (a_link_out, "follows a link out of the scene's folder"),
        (one_outside, "leaves the scene's folder"),
        (none_there, "leaves the scene's folder"),
    ],
)
def test_what_is_not_certain_is_refused(
    tmp_path: Path, make: Callable[[Path], None], says: str
) -> None:
    make(tmp_path / "scene")
    with pytest.raises(InputError, match=rf"\$.frames\[\d\].file_path: .*{says}"):
        load_scene(tmp_path / "scene")


def test_test_photographs_that_are_missing_are_not_those_for_training(tmp_path: Path) -> None:
    for split in ("train", "val", "test"):
        write_blender(tmp_path, split, ring(4), channels=3)
    shutil.rmtree(tmp_path / "test")
    scene = load_scene(tmp_path)
    assert {view.name.split("/")[0] for view in scene.views} == {"train", "val"}
    assert any("transforms_test.json is not used" in warning for warning in scene.warnings)


def test_photographs_for_training_are_not_found_for_testing(tmp_path: Path) -> None:
    for split in ("train", "test"):
        content = write_blender(tmp_path, split, ring(4), channels=3)
    shutil.rmtree(tmp_path / "test")
    (tmp_path / "train").rename(tmp_path / "images")
    content = json.loads((tmp_path / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("train", "images")
    save(tmp_path / "transforms_train.json", content)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert not set(scene.splits["train"]) & set(scene.splits["test"])
    assert any("transforms_test.json is not used: none of the 4" in w for w in scene.warnings)


def test_photographs_of_all_splits_may_be_moved(tmp_path: Path) -> None:
    for split in ("train", "test"):
        write_blender(tmp_path, split, ring(4), channels=3)
        content = json.loads((tmp_path / f"transforms_{split}.json").read_text())
        for frame in content["frames"]:
            frame["file_path"] = f"/home/me/{frame['file_path'].removeprefix('./')}"
        save(tmp_path / f"transforms_{split}.json", content)
    scene = load_scene(tmp_path)
    assert [len(scene.splits[split]) for split in ("train", "test")] == [4, 4]


def test_reduced_photographs_need_the_size_that_the_lens_is_for(tmp_path: Path) -> None:
    write_transforms(tmp_path, scale=2)
    (tmp_path / "images").rename(tmp_path / "images_2")
    for file in (tmp_path / "images_2").iterdir():
        Image.open(file).resize((8, 6)).save(file)
    camera = load_scene(tmp_path).views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10.0, 11.0, 4.25, 2.75)
    content = transforms_content(4, 2)
    del content["w"], content["h"]
    save(tmp_path / "transforms.json", content)
    with pytest.raises(
        InputError, match=r"only in images_2, and without w and h .*; add the w and"
    ):
        load_scene(tmp_path)
    del content["fl_x"], content["fl_y"], content["cx"], content["cy"]
    save(tmp_path / "transforms.json", content | {"camera_angle_x": 1.0})
    assert load_scene(tmp_path).views[0].camera.fx == pytest.approx(4.0 / np.tan(0.5))


@pytest.mark.parametrize(
    ("said", "there", "names"),
    [
        ("images/{}.png", "images/{}.png", "{}.png"),
        ("{}.jpg", "images/{}.png", "{}.png"),
        ("{}.png", "images/cam/{}.png", "cam/{}.png"),
        ("cam/{}.png", "images/{}.png", "{}.png"),
        ("/home/me/capture/images/{}.png", "images/{}.png", "{}.png"),
        (r"C:\capture\{}.png", "images/{}.png", "{}.png"),
        ("{}.png", "Images/{}.png", "Images/{}.png"),
    ],
)
def test_a_models_photographs_are_found_by_their_names(
    tmp_path: Path, said: str, there: str, names: str
) -> None:
    model = scene_with_model(tmp_path, text=True)
    for old, new in zip(four("{}.png"), four(said), strict=True):
        change(model / "images.txt", f" {old}", f" {new}")
    shutil.rmtree(tmp_path / "images")
    photographs(tmp_path, four(there))
    (tmp_path / "test_list.txt").write_text(four(said)[1])
    (tmp_path / "masks").mkdir()
    Image.fromarray(255 * np.eye(6, 8, dtype=np.uint8)).save(
        tmp_path / "masks" / f"{Path(four(said)[2]).name}.png"
        if ".jpg" in said
        else tmp_path / f"masks/{four(names)[2].rpartition('/')[2]}"
    )
    scene = load_scene(tmp_path)
    assert_read(scene)
    assert f"{FOUND} (first: {four(names)[0]} for " in "\n".join(scene.notes)
    assert [view.name for view in scene.views] == four(names)
    assert [scene.views[i].name for i in scene.splits["test"]] == [four(names)[1]]
    if "/" not in names:
        assert [view.mask is not None for view in scene.views] == [False, False, True, False]


@pytest.mark.parametrize("place", [".", "input", "images_2", "distorted"])
def test_a_models_photographs_may_be_in_other_folders(tmp_path: Path, place: str) -> None:
    model = scene_with_model(tmp_path)
    if place == "distorted":  # as 3DGS's convert.py leaves them before it undistorts
        shutil.move(tmp_path / "images", tmp_path / "input")
        shutil.move(model.parent, tmp_path / "distorted/sparse")
        assert_read(load_scene(tmp_path / "distorted"))
        return
    (tmp_path / place).mkdir(exist_ok=True)
    for file in sorted((tmp_path / "images").iterdir()):
        file.rename(tmp_path / place / file.name)
    (tmp_path / "images/._000.png").touch()
    scene = load_scene(tmp_path)
    assert_read(scene)
    assert [view.name for view in scene.views] == four("{}.png")


def test_photographs_in_an_archive_are_mentioned(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    shutil.rmtree(tmp_path / "images")
    (tmp_path / "images.zip").write_bytes(b"PK")
    says = r"first: images/000\.png\), but the archive images\.zip is: unpack it; put the images"
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)


def test_a_models_photographs_of_other_names_are_mentioned(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    shutil.rmtree(tmp_path / "images")
    photographs(tmp_path, four("rgb/IMG_{}.png"))
    says = r"is in .*/images \(first: 000.png\), but 4 others are \(first: rgb/IMG_000.png\); put"
    with pytest.raises(InputError, match=says):
        load_scene(tmp_path)
