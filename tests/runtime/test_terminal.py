"""Tables of text, and an output that is closed."""

from __future__ import annotations

import os

import pytest

from warpnerf.runtime.terminal import UntilClosed, print_table, table_text

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


def test_what_nobody_reads_is_dropped() -> None:
    """As in ``warpnerf train ... | head -1``; the stream can be closed as usual."""
    reader, writer = os.pipe()
    stream = UntilClosed(open(writer, "w", buffering=1))  # noqa: PTH123, SIM115
    print("read", file=stream, flush=True)
    assert os.read(reader, 5) == b"read\n"
    os.close(reader)
    for _ in range(3):
        print("not read", file=stream, flush=True)
    assert not stream.isatty() and stream.fileno() == writer
    stream._stream.close()
