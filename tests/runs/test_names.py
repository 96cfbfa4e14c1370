"""What runs and scenes are called."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from warpnerf.checks import InputError
from warpnerf.runs.names import new_folder, scene_name


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("/a/room", "room"),
        ("/a/room.v2", "room.v2"),
        ("/a/room.v2/", "room.v2"),
        ("/a/room/transforms.json", "room"),
        ("/a/room/poses_bounds.npy", "room"),
        ("/a/room.npz", "room"),
        ("/a/walk.MP4", "walk"),
        ("/a/room/sparse/0", "room"),
        ("/a/room/sparse", "room"),
        ("/a/room/colmap/sparse/12", "room"),
        ("/a/captures/1", "1"),
        ("builtin:room", "builtin:room"),
    ],
)
def test_scenes(source: str, name: str) -> None:
    assert scene_name(source) == name


def test_a_folder_named_as_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "room.npz").mkdir()
    assert scene_name(str(tmp_path / "room.npz")) == "room.npz"
    monkeypatch.chdir(tmp_path / "room.npz")
    assert scene_name(".") == "room.npz"


def test_runs_of_one_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda how: "now")
    with new_folder("builtin:room") as first, new_folder("builtin:room") as second:
        assert (first.name, second.name) == ("room-now", "room-now-2")
        (second / "a").touch()
    assert list((tmp_path / "runs").iterdir()) == [tmp_path / second]


def test_a_folder_that_stays_empty_goes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with new_folder("builtin:room"):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("dangling", [True, False])
def test_a_file_or_a_link_that_leads_nowhere_in_place_of_all_runs(
    dangling: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if dangling:
        Path("runs").symlink_to(tmp_path / "gone")
    else:
        Path("runs").touch()
    says = r"^runs cannot be written: File exists"
    with pytest.raises(InputError, match=says), new_folder("builtin:room"):
        pass


def test_a_name_that_is_too_long(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="too long"), new_folder("a" * 250):
        pass
