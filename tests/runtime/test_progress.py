"""Progress where there is no terminal: plain lines, not one for each report."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import rich.console

from tests.support.tiny_trainings import ball, tiny_config
from warpnerf.runtime import progress
from warpnerf.runtime.progress import ProgressBar
from warpnerf.training import train as training
from warpnerf.training.state import Progress

Lines = Callable[[list[tuple[float, float, str]]], list[str]]


@pytest.fixture
def lines_of(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Lines:
    """What is printed of reports: seconds since the one before, fraction, words."""

    def lines_of(reports: list[tuple[float, float, str]]) -> list[str]:
        now = 100.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: now)
        with ProgressBar("first") as bar:
            for seconds, fraction, text in reports:
                now += seconds
                bar.report(fraction, text)
        return capsys.readouterr().out.splitlines()

    return lines_of


def test_plain_lines_are_few_and_end_with_the_last(lines_of: Lines) -> None:
    assert lines_of([(0.125, step / 100, f"step {step}") for step in range(1, 101)]) == [
        "  1%  step 1",
        " 41%  step 41  7 s left",
        " 81%  step 81  2 s left",
        "100%  step 100  0 s left",
    ]


def test_what_came_before_the_first_report_is_not_expected_again(lines_of: Lines) -> None:
    """Half a minute of compiling, and a run that is resumed from its middle."""
    assert lines_of([(30.0, 0.5, "step 50"), (10.0, 0.6, "step 60")]) == [
        " 50%  step 50",
        " 60%  step 60  40 s left",
    ]


@pytest.mark.parametrize(
    ("console", "widgets", "bar"),
    [
        ({"force_terminal": True}, False, True),
        ({"force_terminal": True, "_environ": {"TERM": "dumb"}}, False, False),
        ({"force_terminal": False}, True, False),
        ({"force_jupyter": True}, True, True),
        ({"force_jupyter": True}, False, False),
    ],
)
def test_where_there_is_a_bar(
    console: dict[str, Any], widgets: bool, bar: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = rich.console.Console(**{"_environ": {"TERM": "xterm"}} | console)
    monkeypatch.setattr(rich.console, "Console", lambda: made)
    spec = object() if widgets else None
    monkeypatch.setattr(progress.importlib.util, "find_spec", lambda name: spec)
    assert progress.has_bar() == bar


@pytest.mark.parametrize(
    ("asked", "is_bar", "shown"),
    [
        (None, False, False),
        (None, True, True),
        (True, False, True),
        (False, True, False),
    ],
)
def test_train_shows_it_where_somebody_looks(
    asked: bool | None,
    is_bar: bool,
    shown: bool,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(training, "has_bar", lambda: is_bar)
    training.train(ball(), tiny_config(steps=2), progress=asked)
    assert ("step 2  loss" in capsys.readouterr().out) == shown


def test_who_has_a_report_of_their_own_sees_no_bar(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training, "has_bar", lambda: True)
    reports: list[Progress] = []
    training.train(ball(), tiny_config(steps=2), on_progress=reports.append)
    assert reports[-1].step == 2 and not capsys.readouterr().out
