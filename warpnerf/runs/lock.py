"""One process at a time writes to a run's folder, and not through links from it."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from warpnerf.checks import InputError, cannot_write

try:
    import fcntl
except ImportError:  # Windows, where nothing is locked
    fcntl = None  # type: ignore[assignment]

NAME = ".lock"
"""Of the file that is locked; it holds the process's number."""
WRITTEN = (
    *("config.json", "log.jsonl", "metrics.json", "test.png", "field.safetensors", "test", "scene"),
    *("checkpoint-*.safetensors", "test/*.png", "log.csv", "curves.png", "tensorboard"),
    "tensorboard/*",
)
"""What a run writes or removes in its folder and in previous/, as patterns of names; folders before
what lies in them."""


@contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only process that writes to a folder. The lock ends with the process, however it ends.

    Args:
        folder: Made if it does not exist, and then removed if nothing was written to it.

    Raises:
        InputError: Another process has it, it cannot be written to, or one of its files is a link,
            a pipe or a device.
    """
    try:
        require_own_files(folder)
        made = [place for place in (folder, *folder.parents) if not place.exists()]
    except OSError as error:
        raise cannot_write(str(folder), error) from error
    if fcntl is None:
        yield
        return
    path = folder / NAME
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


def is_held(folder: Path) -> bool:
    """Whether a process writes to a folder."""
    if fcntl is None:
        return False
    try:
        file = os.open(folder / NAME, os.O_RDWR)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def require_own_files(folder: Path) -> None:
    """Raise InputError where a file of a run is a symbolic link, a pipe or a device."""
    older = folder / "previous"
    paths = [folder / name for name in (NAME, "next", "next/scene", older.name)]
    paths += [*matching(folder, WRITTEN), *matching(older, WRITTEN)]
    for place in (folder, folder / "next", older):
        for inside, folders, files in os.walk(place / "scene"):
            paths += [Path(inside, name) for name in sorted((*folders, *files))]
    require_own(paths, "a run")


def matching(folder: Path, patterns: Iterable[str]) -> Iterator[Path]:
    """Files and folders by patterns of names, and links that lead to nothing as well.

    Args:
        folder: In which they are looked for.
        patterns: Such as ``test/*.png``. Names without * need not exist.
    """
    for name in patterns:
        yield from sorted(folder.glob(name)) if "*" in name else [folder / name]


def require_own(paths: Iterable[Path], writer: str) -> None:
    """Raise InputError where a path is that of a symbolic link, a pipe or a device.

    What a link leads to would be overwritten or removed, and a pipe be waited for without end.

    Args:
        paths: Of what may be written; folders before what lies in them.
        writer: Of them, such as "a run".
    """
    for path in paths:
        if path.is_symlink():
            raise InputError(
                f"{path} is a link, and {writer} writes only to files of its own folder; remove "
                "the link, or name another folder."
            )
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise InputError(
                f"{path} is neither a file nor a folder; remove it, or name another folder."
            )


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
