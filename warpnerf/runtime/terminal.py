"""Tables: drawn on a terminal, plain columns elsewhere."""

from __future__ import annotations

from collections.abc import Sequence


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
