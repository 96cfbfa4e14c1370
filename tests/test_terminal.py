"""Tables of text."""

from __future__ import annotations

import pytest

from warpnerf.runtime.terminal import print_table, table_text

ROWS = [["short", "1.0", ""], ["[red]long name", "23.5", "ok"]]
TEXT = """\
name            PSNR
short            1.0
[red]long name  23.5  ok"""


def test_columns_line_up() -> None:
    assert table_text(["name", "PSNR", ""], ROWS) == TEXT


def test_elsewhere_than_on_a_terminal_tables_are_plain(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(["name", "PSNR", ""], ROWS, bad=[True, False])
    assert capsys.readouterr().out == TEXT + "\n"


def test_on_a_terminal_they_are_drawn(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    print_table(["name", "PSNR", ""], ROWS, bad=[True, False])
    drawn = capsys.readouterr().out
    assert "\x1b[" in drawn and "[red]long name" in drawn and "23.5" in drawn
