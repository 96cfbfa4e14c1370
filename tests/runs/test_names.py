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
    (tmp_path / "runs").touch()
    with pytest.raises(InputError, match="cannot be written"), new_folder("builtin:room"):
        pass
