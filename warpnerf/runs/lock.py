"""One process at a time writes to a run's folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from warpnerf.checks import InputError, cannot_write

try:
    import fcntl
except ImportError:  # Windows, where nothing is locked
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
"""Of the file that is locked; it holds the process's number."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only process that writes to a folder. The lock ends with the process, however it ends.

    Args:
        folder: Made if it does not exist, and then removed if nothing was written to it.

    Raises:
        InputError: Another process has it, or it cannot be written to.
    """
    if fcntl is None:
        yield
        return
    path = folder / NAME
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            file = _locked(path)
        except OSError as error:
            raise cannot_write(str(folder), error) from error
        try:
            yield
        finally:
            path.unlink(missing_ok=True)
            os.close(file)
    finally:
        with suppress(OSError):  # not empty, as where something was written
            for place in made:
                place.rmdir()


def _locked(path: Path) -> int:
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.read(file, 32).decode("ascii", "replace").strip() or "?"
            os.close(file)
            raise InputError(
                f"{path.parent}: process {holder} is training into this folder; wait for it, stop "
                "it, or name another folder."
            ) from None
        if path.exists() and os.path.samestat(os.fstat(file), path.stat()):
            try:
                os.ftruncate(file, 0)
                os.write(file, f"{os.getpid()}\n".encode())
            except OSError:
                path.unlink()
                os.close(file)
                raise
            return file
        os.close(file)  # who had it has just removed it
