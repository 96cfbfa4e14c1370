"""Files that are written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

CHUNK = 1 << 24
"""Bytes per write: signals such as Ctrl-C wait for one to end."""


def write_atomically(path: str | Path, *pieces: bytes | memoryview) -> None:
    """Write a file so that its name always leads to all of the old content or all of the new.

    A link stays, and what it leads to is replaced. Pipes and devices are written to as they are.

    Raises:
        OSError: It cannot be written.
    """
    path = Path(path)
    if _takes_a_stream(path):
        with path.open("wb") as stream:
            stream.writelines(pieces)
        return
    path = Path(os.path.realpath(path))
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
        file = os.open(temporary, flags, 0o666)
        try:
            for piece in pieces:
                view = memoryview(piece)
                while view:
                    view = view[os.write(file, view[:CHUNK]) :]
            os.fsync(file)
        finally:
            os.close(file)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _takes_a_stream(path: Path) -> bool:
    """Whether a path is that of a pipe, a device, or something that is open already.

    What is open may be a file, as standard output often is, but to put another in its place would
    lose what is written to it later.
    """
    is_open = path.match("/dev/std*") or path.match("/dev/fd/*") or path.match("/proc/*/fd/*")
    return is_open or (path.exists() and not (path.is_file() or path.is_dir()))
