"""Files that are written whole or not at all, alone or several together; and appending to some."""

from __future__ import annotations

import errno
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

CHUNK = 1 << 24
"""Bytes per write: signals such as Ctrl-C wait for one to end."""

LONGEST_NAME = 220
"""Bytes of a name that can be added to: systems of files take 255."""


def temporary_name(name: str) -> str:
    """What a file or folder is called beside its place while it is written.

    That is ``.NAME.PROCESS.tmp``, with the end of a name that is too long for more.
    """
    whole = os.fsencode(name)
    if len(whole) > LONGEST_NAME:
        name = f"{zlib.crc32(whole):08x}-{name[-50:]}"
    return f".{name}.{os.getpid()}.tmp"


def write_atomically(path: str | Path, *pieces: bytes | memoryview) -> None:
    """Write a file so that its name always leads to all of the old content or all of the new.

    A link stays, and what it leads to is replaced. Pipes and devices are written to as they are.

    Raises:
        OSError: It cannot be written.
    """
    with StagedWrites() as staged:
        staged.add(path, *pieces)


def open_to_append(path: Path) -> BinaryIO:
    """Open a file to append to it, but no link, and no pipe that nobody reads.

    Args:
        path: Of the file, which is made where it is missing.

    Raises:
        OSError: It cannot be written, or is such a link or pipe.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0)
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        return os.fdopen(os.open(path, flags, 0o666), "ab")
    except OSError as error:
        why = f"{path.name} is a link" if error.errno == errno.ELOOP else error.strerror
        raise OSError(error.errno, why, str(path)) from error


class StagedWrites:
    """Atomic writes of several files and folders: all of them are replaced, or none is.

    Within a `with` statement everything is written under temporary names beside its place. At the
    end all are renamed; after an exception all are removed. What was there before is left until
    everything is written.
    """

    def __init__(self) -> None:
        """Nothing is written yet."""
        self._ready: list[tuple[Path, Path]] = []
        self._streams: list[tuple[Path, tuple[bytes | memoryview, ...]]] = []

    def add(self, path: str | Path, *pieces: bytes | memoryview) -> None:
        """Write a file beside its place.

        A link stays, and what it leads to is replaced. Pipes and devices are written to in the end.

        Raises:
            OSError: It cannot be written.
        """
        path = Path(path)
        if _takes_a_stream(path):
            self._streams.append((path, pieces))
            return
        with _naming(path):
            temporary = self._beside(Path(os.path.realpath(path)))
            temporary.unlink(missing_ok=True)  # a link, or of a process that had this number
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
            file = os.open(temporary, flags, 0o666)
            try:
                for piece in pieces:
                    view = memoryview(piece)
                    while view:
                        view = view[os.write(file, view[:CHUNK]) :]
                os.fsync(file)
            finally:
                os.close(file)

    def add_folder(self, path: Path, fill: Callable[[Path], None]) -> None:
        """Fill a folder beside its place, which is new or an empty folder, or a link to one.

        Args:
            path: Of the folder.
            fill: Writes what is in it, given the temporary folder.

        Raises:
            OSError: It cannot be written.
        """
        with _naming(path):
            temporary = self._beside(Path(os.path.realpath(path)))
            temporary.mkdir()
        fill(temporary)

    def _beside(self, path: Path) -> Path:
        temporary = path.with_name(temporary_name(path.name))
        self._ready.append((temporary, path))
        return temporary

    def __enter__(self) -> StagedWrites:
        """Begin."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Rename all, or remove all."""
        n_renamed = 0
        try:
            if kind is None:
                for path, pieces in self._streams:
                    with path.open("wb") as stream:
                        stream.writelines(pieces)
                for temporary, path in self._ready:
                    with _naming(path):
                        temporary.replace(path)
                    n_renamed += 1
        finally:
            for temporary, _ in self._ready[n_renamed:]:
                with suppress(OSError):  # one may not be there, and another error is on its way
                    if temporary.is_dir():
                        shutil.rmtree(temporary, ignore_errors=True)
                    else:
                        temporary.unlink()
        if kind is None and os.name == "posix":
            for parent in {path.parent for _, path in self._ready}:
                folder = os.open(parent, os.O_RDONLY)
                try:
                    os.fsync(folder)
                finally:
                    os.close(folder)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Errors name the file that is written, not its temporary name."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


def _takes_a_stream(path: Path) -> bool:
    """Whether a path is that of a pipe, a device, or something that is open already.

    What is open may be a file, as standard output often is, but to put another in its place would
    lose what is written to it later.
    """
    is_open = path.match("/dev/std*") or path.match("/dev/fd/*") or path.match("/proc/*/fd/*")
    return is_open or (path.exists() and not (path.is_file() or path.is_dir()))
