"""`warpnerf runs`: a table of runs, and what they take on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from warpnerf.checks import InputError
from warpnerf.scenes.files import printable

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="[FOLDER]")]


def runs_command(folder: Folder = Path("runs"), /, clean: bool = False) -> int:
    """List the runs in a folder: steps, metrics, disk usage, configuration.

    Args:
        folder: That holds folders of runs; by default runs.
        clean: Remove the checkpoints of runs that have finished, and what exports keep. They can
            then be looked at, rendered and exported as before, but no longer be trained further.
    """
    from warpnerf.runs.listing import damaged_in, remove_checkpoints, runs_in, runs_table

    if clean:
        for run in runs_in(folder):
            try:
                removed = remove_checkpoints(run)
            except InputError as error:  # another process trains into it
                print(f"left alone: {error}", flush=True)
                continue
            if removed:
                place = printable(str(run.folder))
                size = f"{removed / 1e6:.0f} MB"
                print(f"{place}: checkpoints and what exports keep removed, {size}", flush=True)
    print(runs_table(runs_in(folder), folder))
    damaged = damaged_in(folder)
    if damaged:
        first = next(iter(damaged.values()))
        runs = "1 run" if len(damaged) == 1 else f"{len(damaged)} runs"
        print(f"warning: not listed, as config.json cannot be read: {runs} ({first})")
    return 0
