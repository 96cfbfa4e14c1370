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
        clean: Remove the checkpoints of runs that have finished. They can then be looked at,
            rendered and exported as before, but no longer be resumed.
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
                print(f"{place}: checkpoints of {removed / 1e6:.0f} MB removed", flush=True)
    print(runs_table(runs_in(folder), folder))
    damaged = damaged_in(folder)
    if damaged:
        first = next(iter(damaged.values()))
        print(f"warning: not listed, as config.json cannot be read: {len(damaged)} runs ({first})")
    return 0
