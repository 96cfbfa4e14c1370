"""`warpnerf demo`, made tiny: what it says on the way, what it leaves, and that it continues."""

from __future__ import annotations

import inspect
import json
from pathlib import Path

import av
import pytest
from PIL import Image

from warpnerf.cli.demo import demo_command
from warpnerf.reports import comparison_film, demonstration
from warpnerf.reports.demonstration import CAMERAS, NAMES, SHOWN, demo
from warpnerf.training.trainer import Trainer


@pytest.mark.ci
def test_the_command_says_what_goes_on_and_shows_both(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """And Python's function, called on its folder, repeats no training."""
    monkeypatch.setattr(comparison_film, "N_FRAMES", 2)
    monkeypatch.setattr(comparison_film, "LONGER_SIDE", 32)
    monkeypatch.setattr(demonstration, "PICTURE_SIZE", (64, 48))
    assert demo_command(tmp_path, steps=20, downscale=8, threads=1) == 0
    said = capsys.readouterr().out
    for words in (
        "crossed by many rays of that one camera",
        "for 20 steps each",
        "2 of 2  with-scaling        0",
        "light in front, training rays",
        "PSNR of views pulled back [dB]",
        "floaters.png",
        "report.html",
    ):
        assert words in said
    monkeypatch.delattr(Trainer, "update")
    reports: list[tuple[str, float, str]] = []
    result = demo(
        tmp_path, steps=20, downscale=8, threads=1, report=lambda *report: reports.append(report)
    )
    assert str(result) in said
    assert reports[-1] == ("showing both", 1.0, "written")
    record = json.loads(result.record.read_text())["configurations"]
    for scaling, of_file in zip(NAMES, record, strict=True):
        row = result.figures[scaling]
        assert set(SHOWN) < set(row) and of_file["train"]["scaling"] == scaling
        assert row["psnr"] == of_file["figures"]["psnr"]["mean"]
        assert f"{row['psnr']:.2f}" in str(result)
    none, clamped = (result.fields[s].storage.values.numpy() for s in NAMES)
    assert (none != clamped).any()
    with Image.open(result.picture) as picture:
        assert picture.width > 2 * 64 and picture.height > 3 * 48
    with av.open(result.video) as film:
        frames = list(film.decode(video=0))
    assert len(frames) == 2 * len(CAMERAS) and frames[0].width == 2 * 32 + 6


def test_the_default_is_that_of_the_function() -> None:
    assert inspect.signature(demo_command).parameters["steps"].default == demonstration.STEPS
