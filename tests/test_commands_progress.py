"""Progress where there is no terminal: plain lines, not one for each report."""

from __future__ import annotations

import pytest

from warpnerf.commands import progress
from warpnerf.commands.progress import ProgressBar


def test_plain_lines_are_few_and_end_with_the_last(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with ProgressBar("first") as bar:
        for step in range(1, 101):
            now += 0.125
            bar.report(step / 100, f"step {step}")
    lines = capsys.readouterr().out.splitlines()
    assert lines == [
        "  1%  step 1",
        " 41%  step 41  7 s left",
        " 81%  step 81  2 s left",
        "100%  step 100  0 s left",
    ]


def test_what_came_before_the_first_report_is_not_expected_again(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a minute of compiling, and a run that goes on from its middle."""
    now = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now)
    with ProgressBar("first") as bar:
        now += 30.0
        bar.report(0.5, "step 50")
        now += 10.0
        bar.report(0.6, "step 60")
    assert capsys.readouterr().out.splitlines() == [" 50%  step 50", " 60%  step 60  40 s left"]
