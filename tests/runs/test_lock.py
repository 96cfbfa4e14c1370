"""A run's folder has one writer at a time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from warpnerf.checks import InputError
from warpnerf.runs.lock import only_writer
from warpnerf.runs.run import Run

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="nothing is locked there")

HOLD = """
import sys, time
from pathlib import Path
from warpnerf.runs.lock import only_writer
with only_writer(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    with only_writer(tmp_path):
        says = f"process {os.getpid()} is training into this folder"
        with pytest.raises(InputError, match=says), only_writer(tmp_path):
            pass
        assert (tmp_path / ".lock").exists()
    assert not any(tmp_path.iterdir())
    with Run(tmp_path / "new" / "folder").only_writer():
        assert (tmp_path / "new" / "folder").is_dir()
    assert not any(tmp_path.iterdir())  # folders go that were made for nothing


def test_a_process_that_is_killed_holds_nothing(tmp_path: Path) -> None:
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE)
    assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
    with pytest.raises(InputError, match=f"process {holder.pid} is"), only_writer(tmp_path):
        pass
    holder.kill()
    holder.wait()
    assert (tmp_path / ".lock").exists()
    Run.require_free(tmp_path, overwrite=False)  # what is left of it does not count
    with only_writer(tmp_path):
        pass


def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="file/run cannot be written"),
        only_writer(tmp_path / "file" / "run"),
    ):
        pass
