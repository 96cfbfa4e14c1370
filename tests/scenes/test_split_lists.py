"""Lists of photographs beside a COLMAP model are its split."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.scenes.test_colmap import scene_with_model
from tests.support.tiny_scenes import save, write_transforms
from warpnerf.checks import InputError
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.scene import Scene


def names_of(scene: Scene) -> dict[str, list[str]]:
    return {
        split: [scene.views[index].name for index in indices]
        for split, indices in scene.splits.items()
    }


def test_the_lists_are_the_split(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "train_list.txt").write_text("000.png\r\n002.png\r\n")
    (tmp_path / "test_list.txt").write_text("\n003.png\n")
    scene = load_scene(tmp_path)
    assert names_of(scene) == {"train": ["000.png", "002.png"], "test": ["003.png"]}
    notes = " ".join(scene.notes)
    assert "training photographs are those of train_list.txt, test photographs are" in notes
    assert "test photographs are those of test_list.txt" in notes
    assert "in no split and not used: 1 of 4 images (first: 001.png)" in notes


def test_what_is_not_for_testing_is_for_training(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "test_list.txt").write_text("images/001.png\n")
    assert names_of(load_scene(tmp_path)) == {
        "train": ["000.png", "002.png", "003.png"],
        "test": ["001.png"],
    }


def test_what_is_not_for_training_is_for_testing(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "train_list.txt").write_bytes(b"\xef\xbb\xbf" + b"images\\000.png\n./002.png\n")
    scene = load_scene(tmp_path)
    assert names_of(scene) == {"train": ["000.png", "002.png"], "test": ["001.png", "003.png"]}
    assert "training photographs are those of train_list.txt, all others are for testing" in (
        scene.notes
    )
    assert not any("no test split" in note or "not used" in note for note in scene.notes)
    (tmp_path / "train_list.txt").write_text("\n".join(f"{k:03}.png" for k in range(4)))
    assert names_of(load_scene(tmp_path))["test"] == ["000.png"]


def test_notes_say_what_a_list_is_used_for(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "validation_list.txt").write_text("001.png\n")
    (tmp_path / "test_list.txt").write_text("\n \n")
    scene = load_scene(tmp_path)
    assert "validation photographs are those of validation_list.txt" in scene.notes
    assert scene.warnings == ("test_list.txt: is empty, and not used",)
    assert names_of(scene) == {"train": ["002.png", "003.png"], "test": ["000.png"]} | {
        "val": ["001.png"]
    }


def test_photographs_that_are_in_the_model_but_not_there(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "images" / "003.png").unlink()
    (tmp_path / "test_list.txt").write_text("003.png\n001.png\n")
    scene = load_scene(tmp_path)
    assert names_of(scene)["test"] == ["001.png"]
    assert not any("not in the model" in said for said in scene.warnings)
    (tmp_path / "test_list.txt").write_text("003.png\n")
    with pytest.raises(InputError, match=r"none of the model's photographs .* \(first: 003\.png\)"):
        load_scene(tmp_path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes with names")
def test_a_pipe_is_refused(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    os.mkfifo(tmp_path / "train_list.txt")
    with pytest.raises(InputError, match=r"train_list\.txt: is a pipe"):
        load_scene(tmp_path)


def test_photographs_that_are_not_in_the_model_are_said(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "test_list.txt").write_text("001.png\ngone.png\n")
    (warning,) = load_scene(tmp_path).warnings
    assert warning == "test_list.txt: 1 of 2 photographs are not in the model (first: gone.png)"


@pytest.mark.parametrize("content", [b"a.jpg\nb.jpg\n", b"\xff\xfe\x00"])
def test_a_list_of_something_else_is_refused(tmp_path: Path, content: bytes) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "train_list.txt").write_bytes(content)
    with pytest.raises(InputError, match=r"train_list\.txt: .* remove (it|the file)\."):
        load_scene(tmp_path)


@pytest.mark.parametrize(
    ("file", "lines"),
    [("sparse/0/test.txt", "001.png"), ("test.txt", "001"), ("test_list.txt", "images/001")],
)
def test_lists_as_of_3dgs(tmp_path: Path, file: str, lines: str) -> None:
    scene_with_model(tmp_path)
    (tmp_path / file).write_text(lines + "\n")
    scene = load_scene(tmp_path)
    assert names_of(scene)["test"] == ["001.png"] and len(names_of(scene)["train"]) == 3
    assert f"test photographs are those of {file}" in scene.notes


@pytest.mark.parametrize("content", [b"remember the milk\n", b"\xff\xfe\x00", b"\n"])
def test_another_text_of_such_a_name_is_not_used(tmp_path: Path, content: bytes) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "train.txt").write_bytes(content)
    scene = load_scene(tmp_path)
    (warning,) = scene.warnings
    assert warning.startswith("train.txt: ") and warning.endswith("not used")
    assert names_of(scene)["test"] == ["000.png"]


def test_lists_beside_transforms_json(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    (tmp_path / "test_list.txt").write_text("001.png\nimages/003\nlost.png\n")
    scene = load_scene(tmp_path)
    assert names_of(scene)["test"] == ["images/001.png", "images/003.png"]
    assert "test photographs are those of test_list.txt" in scene.notes
    assert scene.warnings == (
        "test_list.txt: 1 of 3 photographs are not in the scene (first: lost.png)",
    )
    every = load_scene(tmp_path, split="all")
    assert every.warnings == () and not any("test_list" in note for note in every.notes)
    save(tmp_path / "transforms.json", content | {"test_filenames": ["images/002.png"]})
    assert names_of(load_scene(tmp_path))["test"] == ["images/002.png"]


def test_a_short_name_of_two_photographs_is_that_of_none(tmp_path: Path) -> None:
    content = write_transforms(tmp_path)
    (tmp_path / "more").mkdir()
    (tmp_path / "images" / "003.png").rename(tmp_path / "more" / "001.png")
    content["frames"][3]["file_path"] = "more/001.png"
    save(tmp_path / "transforms.json", content)
    (tmp_path / "test_list.txt").write_text("001\nmore/001\n000\n")
    scene = load_scene(tmp_path)
    assert names_of(scene)["test"] == ["images/000.png", "more/001.png"]
    assert "1 of 3 photographs are not in the scene (first: 001)" in " ".join(scene.warnings)


def test_a_text_that_names_some_photographs_only_is_no_list(tmp_path: Path) -> None:
    write_transforms(tmp_path, 12)
    lines = [f"{k:03}" for k in range(9)]
    (tmp_path / "train.txt").write_text("\n".join([*lines, "epoch"]))
    scene = load_scene(tmp_path)
    assert len(names_of(scene)["train"]) == 9
    assert "train.txt: 1 of 10 photographs are not in the scene (first: epoch)" in scene.warnings
    (tmp_path / "train.txt").write_text("\n".join([*lines, "epoch", "loss"]))
    scene = load_scene(tmp_path)
    assert len(names_of(scene)["train"]) == 10
    said = "train.txt: names no photograph of the scene in 2 of 11 lines (first: epoch), and is not"
    assert f"{said} used" in scene.warnings
    (tmp_path / "train.txt").rename(tmp_path / "train_list.txt")
    assert len(names_of(load_scene(tmp_path))["train"]) == 9


def test_lists_of_two_places_or_programs_are_not_combined(tmp_path: Path) -> None:
    scene_with_model(tmp_path)
    (tmp_path / "train_list.txt").write_text("000.png\n001.png\n")
    for other in ("test.txt", "sparse/0/test_list.txt"):
        (tmp_path / other).write_text("001.png\n")
    scene = load_scene(tmp_path)
    assert names_of(scene) == {"train": ["000.png", "001.png"], "test": ["002.png", "003.png"]}
    assert "not used, beside these lists: test.txt, sparse/0/test_list.txt" in scene.notes
    (tmp_path / "train_list.txt").rename(tmp_path / "train.txt")
    (tmp_path / "test.txt").write_text("remember the milk\n")
    (tmp_path / "train.txt").write_text("step 1\n")
    assert names_of(load_scene(tmp_path))["test"] == ["001.png"]  # of the model's folder
