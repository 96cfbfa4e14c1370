"""What scenes and runs are called, by the paths of scenes."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from warpnerf.checks import cannot_write
from warpnerf.scenes.formats.contents import VIDEOS

BUILTIN = "builtin:"


def scene_name(source: str) -> str:
    """What a scene is called: by its folder, or by its file where that is all of it.

    Args:
        source: Path of a scene, which need not exist any more, or a built-in name. A file or model
            in a scene's folder has the name of that folder.
    """
    if source.startswith(BUILTIN):
        return source
    path = Path(os.path.abspath(source))  # noqa: PTH100, links stay
    if path.is_dir() or path.suffix.lower() not in (".json", ".npy", ".npz", *VIDEOS):
        if path.name.isdecimal() and path.parent.name == "sparse":
            path = path.parent
        for folder in ("sparse", "colmap"):
            path = path.parent if path.name == folder else path
        return path.name
    return path.parent.name if path.suffix.lower() in (".json", ".npy") else path.stem


@contextmanager
def new_folder(source: str) -> Iterator[Path]:
    """A new folder for a run of a scene, named by it and by the time; it goes if it stays empty.

    Args:
        source: As of ``scene_name``.

    Raises:
        InputError: It cannot be made.
    """
    name = scene_name(source).removeprefix(BUILTIN) or "scene"
    first = Path("runs", f"{name}-{time.strftime('%Y-%m-%d-%H%M%S')}")
    folder, number = first, 2
    while True:
        try:
            folder.parent.mkdir(exist_ok=True)
        except OSError as error:  # such as a link that leads nowhere
            raise cannot_write(str(folder.parent), error) from error
        try:
            folder.mkdir()
            break
        except OSError as error:
            if os.path.lexists(folder):  # of one that was begun in the same second
                folder, number = first.with_name(f"{first.name}-{number}"), number + 1
            elif folder.parent.is_dir():  # else one that stayed empty took it away just now
                raise cannot_write(str(folder), error) from error
    try:
        yield folder
    finally:
        with suppress(OSError):  # not empty
            folder.rmdir()
            folder.parent.rmdir()
