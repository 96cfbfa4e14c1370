"""`warpnerf demo`: what it says on the way."""

from __future__ import annotations

import inspect
from pathlib import Path

import pytest

from warpnerf.cli.demo import demo_command
from warpnerf.reports import demonstration


def test_the_command_says_what_goes_on_and_why(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstration, "FRAMES_PER_CAMERA", 1)
    monkeypatch.setattr(demonstration, "FRAME_SIZE", (32, 24))
    monkeypatch.setattr(demonstration, "PICTURE_SIZE", (64, 48))
    assert demo_command(tmp_path, steps=3, downscale=8, threads=1) == 0
    said = capsys.readouterr().out
    for words in (
        "crossed by many rays of that one camera",
        "for 3 steps each",
        "training without scaling",
        "training with scaling",
        "filming a camera that backs away",
        "density near cameras",
        "floaters.png",
    ):
        assert words in said


def test_the_default_is_that_of_the_function() -> None:
    assert inspect.signature(demo_command).parameters["steps"].default == demonstration.STEPS
