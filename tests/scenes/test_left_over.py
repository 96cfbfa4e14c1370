"""What lies in a scene's folder and is not read is said: masks, depth maps, points, photographs."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes.test_colmap import scene_with_model, write_model
from tests.scenes.test_llff import write_llff
from tests.scenes.test_points import write_ply
from tests.support.program_exports import write_metashape, write_polycam, write_reality
from tests.support.tiny_scenes import picture, ring, save, write_blender, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene


def blender(folder: Path) -> None:
    write_blender(folder, "train", ring(4))


SCENES: dict[str, tuple[Callable[[Path], object], str]] = {
    "transforms": (write_transforms, "001.png"),
    "COLMAP": (scene_with_model, "001.png"),
    "LLFF": (write_llff, "001.png"),
    "Blender": (blender, "r_1.png"),
    "Metashape": (write_metashape, "001.png"),
    "RealityCapture": (write_reality, "001.png"),
}


def gray(path: Path, size: tuple[int, int] = (8, 6)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = np.full(size[::-1], 255, np.uint8)
    mask[:2] = 0
    Image.fromarray(mask).save(path)


@pytest.mark.parametrize("kind", SCENES)
@pytest.mark.parametrize("folder", ["mask", "sky_masks"])
def test_masks_that_no_frame_has_are_said(tmp_path: Path, kind: str, folder: str) -> None:
    make, name = SCENES[kind]
    make(tmp_path)
    gray(tmp_path / folder / name)
    place = tmp_path / folder
    said = f"{place} is not used, as no frame has a mask of it: --masks {place} ignores what is "
    assert any(warning.startswith(said) for warning in load_scene(tmp_path).warnings)
    given = load_scene(tmp_path, masks=place)
    assert sum(view.mask is not None for view in given.views) == 1
    assert not any("is not used" in warning for warning in given.warnings)


def test_masks_may_lie_beside_the_folder_of_photographs(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    gray(tmp_path / "keyframes" / "masks" / "100.png")
    said = f"--masks {tmp_path / 'keyframes' / 'masks'} ignores"
    assert any(said in warning for warning in load_scene(tmp_path).warnings)


def test_masks_that_are_named_after_nothing_are_said(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    gray(tmp_path / "masks" / "person.png")
    (warning,) = load_scene(tmp_path).warnings
    assert warning.endswith(
        "none of its images is named after a photograph; name them as 000.png.png or 000.png"
    )


@pytest.mark.parametrize("folder", ["masks", "masks_2", "unmasked"])
def test_what_is_no_folder_of_masks_is_not_said(tmp_path: Path, folder: str) -> None:
    content = write_transforms(tmp_path)
    gray(tmp_path / folder / "001.png")
    if folder == "masks":  # one of them is used
        content["frames"][1]["mask_path"] = "masks/001.png"
        save(tmp_path / "transforms.json", content)
    assert load_scene(tmp_path).warnings == ()


@pytest.mark.parametrize("name", ["001_mask.png", "mask_001.png", "001.mask.png"])
def test_names_of_masks_in_their_folder(tmp_path: Path, name: str) -> None:
    scene_with_model(tmp_path)
    gray(tmp_path / "masks" / name)
    scene = load_scene(tmp_path)
    assert [view.mask is not None for view in scene.views] == [False, True, False, False]
    assert scene.warnings == ()
    gray(tmp_path / "mask" / "dynamic_mask_002.png")  # of instant-ngp, white is ignored
    mask = load_scene(tmp_path, masks=tmp_path / "mask").views[2].mask
    assert mask is not None and mask[:2].all() and not mask[2:].any()


@pytest.mark.parametrize("kind", SCENES)
def test_depth_maps_that_no_frame_has_are_said(tmp_path: Path, kind: str) -> None:
    make, name = SCENES[kind]
    make(tmp_path)
    gray(tmp_path / "depths" / name)
    notes = [note for note in load_scene(tmp_path).notes if "depth maps in depths" in note]
    assert len(notes) == 1 and "depth_file_path" in notes[0]


def test_depth_maps_that_are_used_are_not_said(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    assert not any("depth maps" in note for note in load_scene(tmp_path).notes)


# points


def cloud(file: Path) -> None:
    write_ply(file, np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3)))


@pytest.mark.parametrize("kind", ["transforms", "Metashape", "RealityCapture"])
def test_a_single_ply_is_the_scene_s_points(tmp_path: Path, kind: str) -> None:
    SCENES[kind][0](tmp_path)
    assert load_scene(tmp_path).observations is None
    cloud(tmp_path / "cloud.ply")
    scene = load_scene(tmp_path)
    assert scene.observations is not None
    assert "the points of cloud.ply, the only .ply in the folder, are tried" in scene.notes
    cloud(tmp_path / "other.ply")
    scene = load_scene(tmp_path)
    assert scene.observations is None
    assert any("not used as points: cloud.ply, other.ply; beside" in note for note in scene.notes)


@pytest.mark.parametrize("kind", ["transforms", "Metashape"])
def test_points_of_something_else_are_tried_without_a_warning(tmp_path: Path, kind: str) -> None:
    SCENES[kind][0](tmp_path)
    before = load_scene(tmp_path).warnings
    write_ply(tmp_path / "mesh.ply", np.full((500, 3), 90.0))
    scene = load_scene(tmp_path)
    assert scene.points is None and scene.warnings == before
    said = "the points of mesh.ply, the only .ply in the folder, are tried, and not used: they are"
    assert f"{said} not what the cameras see" in scene.notes


@pytest.mark.parametrize("kind", ["COLMAP", "LLFF", "Blender"])
def test_points_that_are_not_used_are_said(tmp_path: Path, kind: str) -> None:
    SCENES[kind][0](tmp_path)
    cloud(tmp_path / "cloud.ply")
    scene = load_scene(tmp_path)
    assert scene.observations is None and not any("tried" in note for note in scene.notes)
    assert any("not used as points: cloud.ply; beside" in note for note in scene.notes)


def test_points_that_cannot_be_read_are_said(tmp_path: Path) -> None:
    write_transforms(tmp_path / "s")
    for name in ("a.las", "b.pcd", "c.ply", "d.e57"):
        (tmp_path / "s" / name).write_text("no points")
    scene = load_scene(tmp_path / "s")
    assert any("points: a.las, b.pcd, c.ply, ...;" in note for note in scene.notes)
    cloud(tmp_path / "outside.ply")
    (tmp_path / "s" / "c.ply").unlink()
    (tmp_path / "s" / "c.ply").symlink_to(tmp_path / "outside.ply")
    assert load_scene(tmp_path / "s").observations is None


@pytest.mark.parametrize("ending", ["bmp", "tif", "webp"])
def test_masks_of_other_endings_are_said_and_read(tmp_path: Path, ending: str) -> None:
    """They were neither."""
    write_transforms(tmp_path)
    mask = np.full((6, 8), 255, np.uint8)
    mask[:2] = 0
    (tmp_path / "masks").mkdir()
    options = {"lossless": True} if ending == "webp" else {}
    Image.fromarray(mask).save(tmp_path / f"masks/001.{ending}", **options)
    said = f"--masks {tmp_path / 'masks'} ignores what is black there"
    assert any(said in warning for warning in load_scene(tmp_path).warnings)
    (given,) = (
        v.mask
        for v in load_scene(tmp_path, masks=tmp_path / "masks").views
        if v.name == "images/001.png"
    )
    assert given is not None and np.array_equal(given, mask > 0)


@pytest.mark.parametrize("inner", ["person/001.png", "001.npy"])
def test_masks_in_folders_of_their_folder_or_as_arrays_are_said(tmp_path: Path, inner: str) -> None:
    scene_with_model(tmp_path)
    if inner.endswith(".png"):
        gray(tmp_path / "masks" / inner)
    else:
        (tmp_path / "masks").mkdir()
        np.save(tmp_path / "masks" / inner, np.ones((6, 8), bool))
    said = "is not used, as no frame has a mask of it: none of its images is named"
    assert any(said in warning for warning in load_scene(tmp_path).warnings)


def test_clouds_of_points_in_folders_are_said(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "lidar").mkdir()
    (tmp_path / "lidar/scan.xyz").write_text("0 0 0\n")
    write_ply(tmp_path / "lidar/scan.ply", np.zeros((4, 3)))
    said = "not used as points: lidar/scan.ply, lidar/scan.xyz; beside"
    assert any(said in note for note in load_scene(tmp_path).notes)


# photographs


def test_masks_outside_the_folder_of_photographs_are_none_of_these(tmp_path: Path) -> None:
    """More of them than there are frames ended in a traceback."""
    content = write_transforms(tmp_path)
    for k in range(8):
        Image.new("L", (8, 6), 255 * (k % 2)).save(tmp_path / f"{k:03d}.png")
    for k, frame in enumerate(content["frames"]):
        frame["mask_path"] = f"{2 * k + 1:03d}.png"
    Image.fromarray(picture(9)).save(tmp_path / "images/009.png")
    save(tmp_path / "transforms.json", content)
    said = "1 of 5 photographs in images are not in transforms.json (first: 009.png)"
    assert said in load_scene(tmp_path).warnings


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("right", True),
        ("labels", True),
        ("images_2", False),
        ("thumbs", False),
        ("others", False),
    ],
)
def test_photographs_of_the_same_names_in_a_folder_beside_are_said(
    tmp_path: Path, place: str, said: bool
) -> None:
    """As of the other camera of a pair."""
    content = write_transforms(tmp_path)
    (tmp_path / "images").rename(tmp_path / "left")
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].replace("images", "left")
    save(tmp_path / "transforms.json", content)
    (tmp_path / place).mkdir()
    for k in range(4):
        name = f"other_{k}.png" if place == "others" else f"{k:03d}.png"
        Image.fromarray(picture(k + 9)).save(tmp_path / place / name)
    note = (
        f"also in the folder, and not used: {place}, with 4 "
        f"{'images' if place == 'labels' else 'photographs'} of the same names, which "
        "transforms.json does not name"
    )
    assert (note in load_scene(tmp_path).notes) == said


def test_photographs_that_transforms_json_does_not_name_are_said(tmp_path: Path) -> None:
    content = write_transforms(tmp_path, 12)
    for name in ("001_depth.png", "depth_002.png", "normal.004.jpg", "005.tif"):  # of 001.png, ...
        Image.fromarray(picture(1)).save(tmp_path / "images" / name)
    left = content["frames"].pop(3)
    save(tmp_path / "transforms.json", content)
    scene = load_scene(tmp_path)
    said = "1 of 12 photographs in images are not in transforms.json (first: 003.png)"
    assert said in scene.notes and scene.warnings == ()
    content["frames"].pop()
    save(tmp_path / "transforms.json", content)
    assert load_scene(tmp_path).warnings == (said.replace("1 of", "2 of"),)
    content["frames"][0]["mask_path"] = left["file_path"]  # what it names otherwise is none
    content["frames"][0]["depth_file_path"] = "images/011.png"
    for name in ("003.png", "011.png"):
        gray(tmp_path / "images" / name)
    save(tmp_path / "transforms.json", content)
    assert not any("are not in" in said for said in load_scene(tmp_path).warnings)


def test_a_model_of_more_photographs_is_named(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    write_model(tmp_path)
    assert not any("are not in" in said for said in load_scene(tmp_path).warnings)
    content["frames"].pop()
    save(tmp_path / "transforms.json", content)
    (warning,) = (said for said in load_scene(tmp_path).warnings if "are not in" in said)
    assert warning.endswith(
        f"; name {tmp_path / 'sparse' / '0'} to read the COLMAP model, which has 4"
    )


def test_a_model_beside_a_file_that_is_refused_is_named(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    save(tmp_path / "transforms.json", {"frames": []})
    with pytest.raises(InputError, match=r"a scene needs posed images\.$"):
        load_scene(tmp_path)
    model = write_model(tmp_path)
    way_out = re.escape(f"; or name the COLMAP model beside it, {model}.") + "$"
    with pytest.raises(InputError, match=rf"transforms\.json: .*{way_out}"):
        load_scene(tmp_path)
    write_model(tmp_path / "s")
    write_transforms(tmp_path / "t")
    (tmp_path / "t" / "images").rename(tmp_path / "s" / "images")
    (tmp_path / "t" / "transforms.json").rename(tmp_path / "s" / "transforms.json")
    with pytest.raises(InputError, match=r"is no folder; name the folder of the masks\.$"):
        load_scene(tmp_path / "s", masks=tmp_path / "none")
