"""Progress in a terminal: a bar there, plain lines in a file or a pipe."""

from __future__ import annotations

import importlib.util
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

LINE_EVERY = 5.0
"""Seconds from one plain line to the next."""


def has_bar() -> bool:
    """Whether progress is a bar here: in a terminal that can move its cursor, or in a notebook with
    ipywidgets, without which rich shows none; elsewhere it is lines."""
    from rich.console import Console

    console = Console()
    if console.is_jupyter:
        return importlib.util.find_spec("ipywidgets") is not None
    return console.is_terminal and not console.is_dumb_terminal


class ProgressBar:
    """How far something is, within a `with` statement."""

    def __init__(self, waiting: str = "") -> None:
        """Set up; ``waiting`` is shown until the first report."""
        self._waiting = waiting
        self._bar: Bar | None = None
        self._began = time.monotonic()
        self._line_at = 0.0
        self._first: tuple[float, float] | None = None  # seconds and fraction of the first report

    def __enter__(self) -> ProgressBar:
        """Show the bar, where there is a terminal."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
        from rich.table import Column

        console = Console()
        self._began = time.monotonic()
        if has_bar():
            self._bar = Progress(
                TextColumn("{task.percentage:3.0f}%"),
                BarColumn(bar_width=16),
                TimeRemainingColumn(compact=True, table_column=Column(min_width=5, no_wrap=True)),
                TextColumn(  # the end of which is left out where the terminal is narrow
                    "{task.description}", table_column=Column(no_wrap=True, overflow="ellipsis")
                ),
                console=console,
            )
            self._bar.start()
            self._task = self._bar.add_task(self._waiting, total=1.0)
        return self

    def __exit__(self, *error: object) -> None:
        """Leave the bar as it stands."""
        if self._bar is not None:
            self._bar.stop()

    def report(self, fraction: float, text: str) -> None:
        """Show that a fraction, [0, 1], is done, and a few words."""
        if self._bar is not None:
            self._bar.update(self._task, completed=fraction, description=text)
            return
        seconds = time.monotonic() - self._began
        # What came before, such as compiling or what a run was resumed from, is not repeated.
        self._first = self._first or (seconds, fraction)
        if seconds >= self._line_at or fraction >= 1.0:
            line = f"{fraction:4.0%}  {text}"
            if fraction > self._first[1]:
                pace = (seconds - self._first[0]) / (fraction - self._first[1])
                line += f"  {pace * (1.0 - fraction):.0f} s left"
            print(line, flush=True)
            self._line_at = seconds + LINE_EVERY
