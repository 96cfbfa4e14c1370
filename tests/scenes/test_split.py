"""What is withheld for testing, where that is chosen, and that it is said."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scenes.test_split_lists import names_of
from tests.support.cli_process import command, make_scene
from tests.support.tiny_scenes import ring, write_transforms
from warpnerf.checks import InputError
from warpnerf.runs.run import Run
from warpnerf.runs.scene import load_run_scene
from warpnerf.scenes.formats.load import load_scene
from warpnerf.scenes.split import read_split, withheld

NAMES = [f"images/{n}.png" for n in range(16)]
POSES = ring(16)


@pytest.mark.parametrize(
    ("split", "test", "note"),
    [
        ("all", [], "no photograph is withheld for testing: all 16 are trained on"),
        (5, [0, 5, 10, 15], "4 of 16 photographs, one in 5 by name (first: images/0.png)"),
        (
            2,
            [0, 2, 4, 6, 8, 10, 12, 14],
            "8 of 16 photographs, one in 2 by name (first: images/0.png)",
        ),
        (("11.png", "images/3.png"), [3, 11], "2 of 16 photographs, those of the list (first: "),
        ("sector", [0, 1], "2 of 16 photographs, a sector, side by side (first: images/0.png)"),
    ],
)
def test_what_is_withheld(split: Any, test: list[int], note: str) -> None:
    chosen, said = withheld(split, NAMES, POSES)
    if split == "sector":  # either way around
        test = test if "images/1.png" in chosen else [0, 15]
    assert chosen == {NAMES[k] for k in test}
    assert note in said


def test_a_sector_is_side_by_side_whatever_the_names() -> None:
    rng = np.random.default_rng(0)
    order = rng.permutation(64)
    names, poses = [f"{n:03}" for n in order], ring(64)
    chosen, _ = withheld("sector", names, poses)
    places = sorted(k for k in range(64) if names[k] in chosen)
    gaps = np.diff([*places, places[0] + 64])
    assert len(places) == 8 and "000" in chosen
    assert sorted(gaps)[:-1] == [1] * 7


@pytest.mark.parametrize(
    ("split", "says"),
    [
        (("none.png",), "none.png, which is no photograph of the scene; name them as the scene"),
        (tuple(NAMES), "withholds all 16 photographs"),
    ],
)
def test_what_cannot_be_withheld(split: tuple[str, ...], says: str) -> None:
    with pytest.raises(InputError, match=re.escape(says)):
        withheld(split, NAMES, POSES)


def test_a_file_name_that_is_there_twice() -> None:
    with pytest.raises(InputError, match=r"which is 2 photographs"):
        withheld(("0.png",), ["a/0.png", "b/0.png"], ring(2))


@pytest.mark.parametrize("split", ["everything", 1, 0, -3, True, 2.5, (), [], [3], "images"])
def test_no_split(tmp_path: Path, split: Any) -> None:
    write_transforms(tmp_path)
    with pytest.raises(InputError, match="split must be"):
        load_scene(tmp_path, split=split)


@pytest.mark.parametrize("text", ["0", "1", "1.5", "-2", "sectors", "9" * 400])
def test_no_split_of_the_command(text: str) -> None:
    with pytest.raises(InputError, match="split"):
        read_split(text)


def test_a_list_is_read(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_bytes(b"\xef\xbb\xbfa.png\r\n\r\n b.png \na.png\n")
    assert read_split(str(path)) == ("a.png", "b.png")
    path.write_text("\n\n")
    with pytest.raises(InputError, match="names no photograph"):
        read_split(str(path))
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match="cannot be read as text"):
        read_split(str(path))


def test_a_scene_with_it(tmp_path: Path) -> None:
    write_transforms(tmp_path, 8)
    every = load_scene(tmp_path, split=3)
    assert [name[-7:] for name in names_of(every)["test"]] == ["000.png", "003.png", "006.png"]
    assert len(names_of(every)["train"]) == 5
    assert any(note.startswith("withheld for testing: 3 of 8") for note in every.notes)
    whole = load_scene(tmp_path, split="all")
    assert names_of(whole)["test"] == [] and len(whole.splits["train"]) == 8
    room = load_scene("builtin:room-sparse", downscale=16, split="all")
    assert len(room.splits["train"]) == len(room.views) and not room.splits["test"]


def test_a_run_remembers_it(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    (tmp_path / "list.txt").write_text("001.png\n003.png\n")
    few = ("--steps", "2", "--threads", "1", "--voxels", "512", "--output", "run")
    done = command("train", scene, *few, "--split", "list.txt", folder=tmp_path)
    assert done.code == 0, done.err
    assert "note: withheld for testing: 2 of 4 photographs, those of the list" in done.out
    (tmp_path / "list.txt").unlink()
    test = names_of(load_run_scene(Run(done.run).read_config()))["test"]
    assert [Path(name).name for name in test] == ["001.png", "003.png"]
    assert len(list((done.run / "test").glob("*.png"))) == 2
    done = command("train", scene, *few, "--overwrite", "--split", "all", folder=tmp_path)
    assert done.code == 0, done.err
    assert "no photograph is withheld for testing: all 4" in done.out
    assert len(list((done.run / "test").glob("*.png"))) == 4  # training views
