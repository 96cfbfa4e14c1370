"""What is printed: tables, and an output that may be closed while a program continues."""

from __future__ import annotations

import io
import os
from collections.abc import Sequence
from typing import Any


class UntilClosed(io.TextIOBase):
    """Standard output that is silent once nobody reads it, as in ``warpnerf train ... | head``.

    A training that nobody listens to continues, and is saved.
    """

    def __init__(self, stream: io.TextIOWrapper) -> None:
        """Wrap a stream of a file descriptor."""
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        """Everything else is the stream's."""
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write, where somebody reads."""
        try:
            return self._stream.write(text)
        except BrokenPipeError:
            self._close()
            return len(text)

    def flush(self) -> None:
        """Pass on what was written, where somebody reads."""
        try:
            self._stream.flush()
        except BrokenPipeError:
            self._close()

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """The stream's."""
        return self._stream.fileno()

    def _close(self) -> None:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())  # so that flushing at exit fails no more
        os.close(nowhere)


def table_text(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Columns side by side, the first to the left and the others to the right, two spaces apart."""
    lines = [columns, *rows]
    widths = [max(len(line[k]) for line in lines) for k in range(len(columns))]
    return "\n".join(
        "  ".join(
            cell.ljust(width) if k == 0 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def print_table(
    columns: Sequence[str], rows: Sequence[Sequence[str]], bad: Sequence[bool] = ()
) -> None:
    """Print a table.

    Args:
        columns: Their headings.
        rows: Cells, as many in each row as there are columns.
        bad: Which rows to show in red on a terminal.
    """
    from rich.console import Console
    from rich.markup import escape

    console = Console()
    if not console.is_terminal:
        print(table_text(columns, rows), flush=True)
        return
    from rich.table import Table

    table = Table()
    for k, column in enumerate(columns):
        table.add_column(column, justify="left" if k == 0 else "right", overflow="fold")
    for k, row in enumerate(rows):
        style = "red" if k < len(bad) and bad[k] else None
        table.add_row(*map(escape, row), style=style)
    console.print(table)
