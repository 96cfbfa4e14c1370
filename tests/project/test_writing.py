"""Files that are written whole or not at all: links to folders, and what errors name."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from warpnerf.writing import StagedWrites, write_atomically


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
