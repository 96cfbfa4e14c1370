"""A tiny run that tests of the command look at."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.tiny_runs import TINY, start


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A tiny run, and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "room"
    process = start("train", *TINY, "--steps=3e1", "--keep=checkpoint", "--output", folder)
    out, err = process.communicate(timeout=240)
    assert process.returncode == 0, err
    assert "CUDA" not in err
    return folder, out
