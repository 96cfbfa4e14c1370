"""Files that are written whole or not at all: links to folders, and what errors name."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from warpnerf.checks import cannot_write
from warpnerf.writing import StagedWrites, temporary_name, write_atomically


def test_a_link_to_an_empty_folder_is_filled_and_stays(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to("there")
    with StagedWrites() as staged:
        staged.add(tmp_path / "a.txt", b"a")
        staged.add_folder(tmp_path / "link", lambda folder: write_atomically(folder / "b", b"b"))
    assert (tmp_path / "link").is_symlink() and (tmp_path / "there/b").read_bytes() == b"b"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.txt", "link", "there"]


def test_errors_name_the_file_and_not_its_temporary_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(FileNotFoundError) as caught:
        write_atomically(tmp_path / "none" / "a.glb", b"a")
    assert caught.value.filename == str(tmp_path / "none" / "a.glb")

    def full(file: int, piece: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with StagedWrites() as staged:
        staged.add(tmp_path / "a", b"a")
        monkeypatch.setattr(os, "write", full)
        with pytest.raises(OSError, match="No space left") as refused:
            staged.add(tmp_path / "c", b"c")
        assert refused.value.filename == str(tmp_path / "c")
        monkeypatch.undo()
        staged._ready.pop()


@pytest.mark.parametrize("letter", ["y", "\u00e9", "\U0001f600"])
def test_names_as_long_as_they_may_be_are_written(tmp_path: Path, letter: str) -> None:
    long = letter * (250 // len(letter.encode()))
    names = [temporary_name(f"{number}{long}.gz") for number in "12"]
    assert len(set(names)) == 2 and all(len(os.fsencode(name)) < 255 for name in names)
    with StagedWrites() as staged:
        for number in "12":  # which differ at their beginnings alone
            staged.add(tmp_path / f"{number}{long}.gz", number.encode())
        staged.add_folder(tmp_path / long, lambda folder: write_atomically(folder / long, b"a"))
    assert (tmp_path / long / long).read_bytes() == b"a"
    assert [(tmp_path / f"{n}{long}.gz").read_text() for n in "12"] == ["1", "2"]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_longer_name_is_what_is_said(tmp_path: Path) -> None:
    for name in ("y" * 256, "/".join(["y" * 250] * 20)):
        with pytest.raises(OSError, match="File name too long") as refused:
            write_atomically(tmp_path / name, b"a")
        assert refused.value.filename == str(tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_what_cannot_be_removed_hides_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError

    with pytest.raises((ValueError, PermissionError)) as caught, StagedWrites() as staged:
        staged.add(tmp_path / "a", b"a")
        monkeypatch.setattr(Path, "unlink", refuse)
        raise ValueError("what went wrong")
    assert str(caught.value) == "what went wrong"


def test_a_loop_of_links_is_to_be_removed(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(FileExistsError) as refused:
        (tmp_path / "loop").mkdir(parents=True, exist_ok=True)
    assert str(cannot_write("--output loop", refused.value)) == (
        "--output loop cannot be written: File exists; remove the file or the link of that name, "
        "or name another place."
    )


def test_a_link_in_place_of_a_temporary_file_is_not_followed(tmp_path: Path) -> None:
    """Its name can be known: numbers of processes come again."""
    precious, path = tmp_path / "precious", tmp_path / "a.json"
    precious.write_bytes(b"old")
    (tmp_path / f".a.json.{os.getpid()}.tmp").symlink_to(precious)
    write_atomically(path, b"new")
    assert precious.read_bytes() == b"old"
    assert path.read_bytes() == b"new" and not path.is_symlink()
