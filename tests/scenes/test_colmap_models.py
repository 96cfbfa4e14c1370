"""Captures that COLMAP has split into several models."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.scenes.test_colmap import scene_with_model, write_model
from tests.support.tiny_scenes import write_transforms
from warpnerf.checks import InputError
from warpnerf.inspection.inspection import inspect
from warpnerf.scenes.formats.colmap_models import find_model
from warpnerf.scenes.formats.colmap_points import read_points
from warpnerf.scenes.formats.contents import is_unposed, what_is_there
from warpnerf.scenes.formats.load import load_scene


def two_models(folder: Path, text: bool) -> None:
    """sparse/0 of 4 images, sparse/1 of 9, of 12 photographs."""
    write_transforms(folder, 12)
    (folder / "transforms.json").unlink()
    write_model(folder, 9, text=text).rename(folder / "sparse" / "1")
    write_model_into(folder, 4, text)


def write_model_into(folder: Path, n: int, text: bool) -> None:
    write_model(folder / "part", n, text=text).rename(folder / "sparse" / "0")


@pytest.mark.parametrize("text", [False, True])
def test_the_largest_model_is_read_and_the_others_are_named(tmp_path: Path, text: bool) -> None:
    two_models(tmp_path, text)
    for path in (tmp_path, tmp_path / "sparse"):
        scene = load_scene(path)
        assert len(scene.views) == 9
        assert "the model sparse/1 of 9 images is read; sparse/0 has 4" in scene.notes
    assert inspect(tmp_path).format.startswith("COLMAP (sparse/1, ")
    said = "3 of 12 photographs in images are not in the model (first: 009.png)"
    assert said in scene.warnings


def test_a_model_that_is_named_is_read_and_a_larger_one_is_a_warning(tmp_path: Path) -> None:
    two_models(tmp_path, False)
    scene = load_scene(tmp_path / "sparse" / "0")
    assert len(scene.views) == 4
    assert "the model sparse/0 of 4 images is read; sparse/1 has 9" in scene.warnings


def in_both_forms(folder: Path, n_binary: int, n_text: int) -> Path:
    """Photographs, and sparse/0 as .bin and as .txt, each with points; returns its folder."""
    write_transforms(folder, 9)
    (folder / "transforms.json").unlink()
    model = write_model(folder, n_binary)
    (model / "points3D.bin").write_bytes(bytes(8))
    for file in write_model(folder / "copy", n_text, text=True).iterdir():
        file.rename(model / file.name)
    shutil.rmtree(folder / "copy")
    comment = f"# Number of images: {n_text}, mean observations per image: 0\n"
    (model / "images.txt").write_text(comment + (model / "images.txt").read_text())
    (model / "points3D.txt").write_text("1 0 0 0 9 9 9 0.5\n")
    return model


@pytest.mark.parametrize("larger", ["bin", "txt"])
def test_of_a_model_in_both_forms_the_larger_is_read(tmp_path: Path, larger: str) -> None:
    other, sizes = ("txt", (9, 4)) if larger == "bin" else ("bin", (4, 9))
    model = in_both_forms(tmp_path, *sizes)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 9
    (warning,) = scene.warnings
    assert warning.startswith(
        f"sparse/0/images.{larger} of 9 images is read, and not images.{other}, which has 4; remove"
    )
    points = read_points(model, {}, tmp_path)
    assert points is not None and points.source == f"sparse/0/points3D.{larger}"


def test_a_copy_of_a_model_in_the_other_form_needs_no_word(tmp_path: Path) -> None:
    text = in_both_forms(tmp_path, 9, 9) / "images.txt"
    found = inspect(tmp_path)
    assert found.format == "COLMAP (sparse/0, binary)"
    assert not any("is read" in said for said in found.diagnostics)
    text.write_text("".join(text.read_text().splitlines(keepends=True)[1:]))  # no comment
    assert not any("is read" in said for said in load_scene(tmp_path).warnings)


@pytest.mark.parametrize(
    ("times", "sign", "says"), [(1.0 + 5e-5, 1.0, False), (1.01, 1.0, True), (1.0, -1.0, False)]
)
def test_a_model_in_the_other_form_that_has_other_poses_is_said(
    tmp_path: Path, times: float, sign: float, says: bool
) -> None:
    """As where images.txt was edited; q and -q are one rotation."""
    text = in_both_forms(tmp_path, 9, 9) / "images.txt"
    lines = text.read_text().splitlines()
    for k in range(2, len(lines), 2):
        number, *pose = lines[k].split()[:8]
        values = [value * (sign if i < 4 else times) for i, value in enumerate(map(float, pose))]
        lines[k] = " ".join([number, *map(repr, values), *lines[k].split()[8:]])
    text.write_text("\n".join(lines) + "\n")
    said = (
        "sparse/0/images.bin of 9 images is read, and not images.txt, which has other poses; "
        "remove the files of the one that is out of date"
    )
    assert (said in load_scene(tmp_path).warnings) == says


def test_rounded_poses_in_the_other_form_are_the_same(tmp_path: Path) -> None:
    """Where a camera is at the origin, quaternions have another length, images another order."""
    text = in_both_forms(tmp_path, 9, 9) / "images.txt"
    lines = text.read_text().splitlines()
    images = [lines[k : k + 2] for k in range(2, len(lines), 2)]
    for image in images:
        number, *pose = image[0].split()[:8]
        values = [1.001 * float(v) if i < 4 else float(v) + 1e-7 for i, v in enumerate(pose)]
        image[0] = " ".join([number, *map(repr, values), *image[0].split()[8:]])
    turned = [line for image in [*images[3:], *images[:3]] for line in image]
    text.write_text("\n".join([*lines[:2], *turned]) + "\n")
    assert not any("has other poses" in said for said in load_scene(tmp_path).warnings)


def test_a_model_at_another_place_is_named(tmp_path: Path) -> None:
    two_models(tmp_path, False)
    (tmp_path / "colmap" / "sparse").mkdir(parents=True)
    (tmp_path / "sparse" / "1").rename(tmp_path / "colmap" / "sparse" / "0")
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert "the model sparse/0 of 4 images is read; colmap/sparse/0 has 9" in scene.warnings
    scene = load_scene(tmp_path / "colmap" / "sparse" / "0")
    assert "the model colmap/sparse/0 of 9 images is read; sparse/0 has 4" in scene.notes


def test_a_damaged_model_is_refused_and_not_replaced_by_a_fragment(tmp_path: Path) -> None:
    two_models(tmp_path, False)
    (tmp_path / "sparse" / "1" / "images.bin").write_bytes(b"no")
    with pytest.raises(InputError, match=r"sparse/1/images\.bin: .*another model .*sparse/0\.$"):
        load_scene(tmp_path)
    scene = load_scene(tmp_path / "sparse" / "0")
    assert "the model sparse/0 of 4 images is read; sparse/1 is damaged" in scene.warnings


@pytest.mark.parametrize("text", [False, True])
def test_a_damaged_fragment_does_not_refuse_a_whole_model(tmp_path: Path, text: bool) -> None:
    two_models(tmp_path, text)
    file = tmp_path / "sparse" / "0" / ("images.txt" if text else "images.bin")
    data = file.read_bytes()
    file.write_bytes(data.replace(b" 7 002.png", b"") if text else data[:-9])
    scene = load_scene(tmp_path)
    assert len(scene.views) == 9
    assert "the model sparse/1 of 9 images is read; sparse/0 is damaged" in scene.warnings
    # Cut to the length of a fragment, it still says how large it was.
    stated = b"# Number of images: 9, mean\n" if text else (9).to_bytes(8, "little")
    file.write_bytes(stated + file.read_bytes()[0 if text else 8 :])
    with pytest.raises(InputError, match=r"sparse/0/images\..*another model .*sparse/1\.$"):
        load_scene(tmp_path)


def test_numbered_captures_are_not_models_of_one_scene(tmp_path: Path) -> None:
    for number in (1, 2):
        capture = tmp_path / str(number)
        write_transforms(capture, 3 * number)
        (capture / "transforms.json").unlink()
        for file in write_model(capture, 3 * number).iterdir():
            file.rename(capture / file.name)
    scene = load_scene(tmp_path / "1")
    assert (scene.name, len(scene.views)) == ("1", 3)
    assert not [said for said in (*scene.notes, *scene.warnings) if "the model" in said]
    with pytest.raises(InputError, match=r"2 of its folders hold one each \(first: 1\)"):
        load_scene(tmp_path)
    (tmp_path / "1" / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=r"is in .*/1/images .*; put them there"):
        load_scene(tmp_path / "1")


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_sparse_folder_may_be_a_link(tmp_path: Path, elsewhere: bool) -> None:
    capture = tmp_path / "capture"
    two_models(capture, False)
    out = tmp_path / "disk" / "a" / "b" / "out" if elsewhere else capture / "out"
    out.parent.mkdir(parents=True, exist_ok=True)
    (capture / "sparse").rename(out)
    (capture / "sparse").symlink_to(out)
    assert not is_unposed(capture)
    for path in (capture, capture / "sparse", capture / "sparse" / "1"):
        scene = load_scene(path)
        assert (scene.name, len(scene.views)) == ("capture", 9)
        assert any(note.endswith("out/0 has 4") for note in scene.notes)


def test_models_may_lie_beside_their_photographs(tmp_path: Path) -> None:
    two_models(tmp_path, True)
    for number in "01":
        (tmp_path / "sparse" / number).rename(tmp_path / number)
    assert not is_unposed(tmp_path)
    for path in (tmp_path, tmp_path / "1"):
        scene = load_scene(path)
        assert len(scene.views) == 9
        assert "the model 1 of 9 images is read; 0 has 4" in scene.notes


def test_photographs_in_the_folder_itself_are_not_those_of_the_one_above(tmp_path: Path) -> None:
    for name in ("one", "two"):
        scene_with_model(tmp_path / name)
        for file in (tmp_path / name / "images").iterdir():
            file.rename(tmp_path / name / file.name)
        (tmp_path / name / "images").rmdir()
        shutil.copy(tmp_path / name / "000.png", tmp_path / name / "sparse/0/preview.png")
    (tmp_path / "images").mkdir()
    shutil.copy(tmp_path / "one/000.png", tmp_path / "images/other.png")
    scene = load_scene(tmp_path / "one")
    assert scene.name == "one"
    assert [view.name for view in scene.views] == [f"{i:03d}.png" for i in range(4)]


def test_models_in_a_renamed_folder_are_named_and_no_poses_are_estimated(tmp_path: Path) -> None:
    two_models(tmp_path, False)
    (tmp_path / "sparse").rename(tmp_path / "out")
    assert find_model(tmp_path) is None
    assert not is_unposed(tmp_path)
    assert "its folder out holds one; use" in what_is_there(tmp_path)
    assert len(load_scene(tmp_path / "out").views) == 9


def test_masks_and_thumbnails_below_the_photographs_are_none(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    for name in ("masks", "thumbs"):
        shutil.copytree(tmp_path / "images", tmp_path / "images" / name, ignore=ignore_folders)
    assert not any("not in the model" in said for said in load_scene(tmp_path).warnings)


def ignore_folders(folder: str, names: list[str]) -> list[str]:
    return [name for name in names if (Path(folder) / name).is_dir()]


def test_one_model_of_all_photographs_needs_no_word(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    scene = load_scene(tmp_path)
    assert not any("model" in text for text in (*scene.notes, *scene.warnings))


@pytest.mark.parametrize(
    "text", ["# Number of images: 400, mean\n", "# Number of images: 400\n9 9"]
)
def test_a_text_that_only_states_more_images_is_not_read(tmp_path: Path, text: str) -> None:
    model = in_both_forms(tmp_path, 9, 4)
    (model / "images.txt").write_text(text)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 9
    size = "is damaged" if "9 9" in text else "has 0"
    assert any(
        f"images.bin of 9 images is read, and not images.txt, which {size};" in said
        for said in scene.warnings
    )


def test_a_text_of_a_few_images_more_is_not_read(tmp_path: Path) -> None:
    in_both_forms(tmp_path, 8, 9)
    scene = load_scene(tmp_path)
    assert len(scene.views) == 8
    assert any("not images.txt, which has 9;" in said for said in scene.warnings)


def test_a_text_is_read_where_the_binary_form_cannot_be(tmp_path: Path) -> None:
    model = in_both_forms(tmp_path, 9, 4)
    data = (model / "images.bin").read_bytes()
    (model / "images.bin").write_bytes(data[:-9])
    scene = load_scene(tmp_path)
    assert len(scene.views) == 4
    assert any(
        "of 4 images is read, and not images.bin, which is damaged;" in said
        for said in scene.warnings
    )
    (model / "images.txt").write_text("9 9")
    with pytest.raises(InputError, match=r"images\.bin: is damaged"):
        load_scene(tmp_path)
