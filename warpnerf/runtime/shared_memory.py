"""Shared memory of processes on one machine, without a name that could be left behind."""

from __future__ import annotations

import mmap
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple


class Place(NamedTuple):
    """Where shared memory is, to be sent to other processes."""

    path: Path
    """Below /proc, of the process that shares it."""
    target: Path
    """What the path leads to there, and nowhere else."""


@contextmanager
def share(n_bytes: int) -> Iterator[tuple[mmap.mmap, Place] | tuple[None, None]]:
    """New memory, which others can open by its place for as long as the context lasts.

    It is an anonymous file (memfd of Linux), which no limit on /dev/shm counts, and which goes with
    the last process that has it mapped, however that ends. None where a system has no such files,
    or refuses one of this size.

    Args:
        n_bytes: Its size.
    """
    try:
        file = os.memfd_create(f"warpnerf-{uuid.uuid4().hex}")
    except (AttributeError, OSError):
        yield None, None
        return
    try:
        yield _mapped(file, n_bytes)
    finally:
        os.close(file)


def _mapped(file: int, n_bytes: int) -> tuple[mmap.mmap, Place] | tuple[None, None]:
    path = Path(f"/proc/{os.getpid()}/fd/{file}")
    try:
        os.ftruncate(file, n_bytes)
        return mmap.mmap(file, n_bytes), Place(path, path.readlink())
    except (OSError, ValueError):
        return None, None


def opened(place: Place | None, n_bytes: int) -> mmap.mmap | None:
    """The memory at a place; None where this process cannot reach it.

    Args:
        place: As another process sent it, maybe on another machine; None where that has none.
        n_bytes: Its size.
    """
    if place is None:
        return None
    try:
        if place.path.readlink() != place.target:  # another process has that number here
            return None
        with place.path.open("r+b", buffering=0) as file:
            return mmap.mmap(file.fileno(), n_bytes)
    except (OSError, ValueError):
        return None
