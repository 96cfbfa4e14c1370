"""Which files of a run's folder are the run's own, and how those of an older run make room.

Nothing else in the folder is touched. What each file is, run.py lists.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from warpnerf.checks import InputError
from warpnerf.runs import lock
from warpnerf.runs.config import RunConfig, read_run_config
from warpnerf.runs.logs import CSV, EVENTS, TENSORBOARD
from warpnerf.runtime.process import is_alive
from warpnerf.sfm.scene_files import (
    IN_RUN,
    NEXT_IN_RUN,
    copy_written,
    move_into,
    read_record,
    remove_posed,
)
from warpnerf.writing import write_atomically

SHEET = "test.png"
"""The picture of a few test views."""
CURVES = "curves.png"
"""The picture of the training's loss and PSNR."""
VISIBILITY = "visibility.safetensors"
"""What the training cameras see of the field, kept by the first export for later ones."""
PREVIOUS = "previous"
"""Folder for the files of an older run."""


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where the checkpoint of a step lies."""
    return folder / f"checkpoint-{step:08}.safetensors"


def checkpoints(folder: Path) -> list[Path]:
    """The checkpoints, the newest first."""
    found = folder.glob("checkpoint-*.safetensors")
    named = (path for path in found if len(_digits(path)) >= 8 and _digits(path).isdecimal())
    return sorted(named, key=step_of, reverse=True)


def step_of(checkpoint: Path) -> int:
    """The step of a checkpoint, by its name."""
    return int(_digits(checkpoint))


def _digits(checkpoint: Path) -> str:
    return checkpoint.stem.removeprefix("checkpoint-")


def results(folder: Path) -> list[Path]:
    """Checkpoints and field, the furthest last."""
    field = folder / "field.safetensors"
    return [*reversed(checkpoints(folder)), *([field] if field.exists() else [])]


def read_config(folder: Path) -> RunConfig:
    """What config.json says, with the scene's path as this process may open it.

    Raises:
        InputError: The folder holds no run.
    """
    path = folder / "config.json"
    if not path.exists():
        raise InputError(f"{path} does not exist; name the folder of a run.")
    config = read_run_config(path)
    if config.scene.startswith("builtin:"):
        return config
    return msgspec.structs.replace(config, scene=str(folder / config.scene))


def change_config(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change values in config.json, and leave all others as they are.

    Args:
        folder: Of the run.
        change: Is given what the file says, to change it in place.

    Raises:
        OSError: It cannot be written.
    """
    path = folder / "config.json"
    content = json.loads(path.read_bytes())
    change(content)
    write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def stored_place(folder: Path, source: str) -> str:
    """A scene's place as config.json has it, so that a run can be moved with its scene."""
    if source.startswith("builtin:"):
        return source
    if _lies_in(source, folder / NEXT_IN_RUN):
        return IN_RUN
    path, root = Path(source).resolve(), folder.resolve()
    return path.relative_to(root).as_posix() if path.is_relative_to(root) else str(path)


def is_taken(folder: Path) -> bool:
    """Whether a folder holds more than an attempt to begin leaves."""
    return any(map(_counts, folder.iterdir()))


def _counts(path: Path) -> bool:
    """Whether a file or folder of an output folder is more than an attempt to begin leaves."""
    if path.name == lock.NAME:
        return False
    if path.name == IN_RUN and read_record(path) is not None:
        return False
    if path.name == Path(NEXT_IN_RUN).parent.name and path.is_dir():
        return is_taken(path)
    if re.fullmatch(rf"\.{IN_RUN}\.\d+\.tmp", path.name):
        return False
    return not (path.name == "test" and path.is_dir() and not any(path.iterdir()))


def sweep(folder: Path) -> None:
    """Remove what processes left behind that were killed while saving, but nothing that a process
    of this machine still writes, such as an export."""
    for path in folder.glob(".*.tmp"):
        if is_leftover(path):
            writer = int(path.name.split(".")[-2])
            if writer == os.getpid() or not is_alive(writer):  # in containers, numbers come again
                path.unlink(missing_ok=True)


def is_leftover(path: Path) -> bool:
    """Whether a file is one that a process was killed while it wrote, by its name."""
    kinds = "csv|html|json|jsonl|npz|png|safetensors"
    return re.fullmatch(rf"\..+\.({kinds})\.\d+\.tmp", path.name) is not None


def set_aside(folder: Path, in_use: Path) -> None:
    """Move an older run to previous/, so that at any moment one of the two folders is whole.

    Args:
        folder: Of the older run, and soon of the new one.
        in_use: What the new run is made of; stays, even if it is the older one's scene, or in it.

    Raises:
        InputError: What the new run is made of lies in previous/ itself.
    """
    if _lies_in(in_use, folder / PREVIOUS):
        raise InputError(
            f"{in_use}: lies in {folder / PREVIOUS}, which makes room for the older run; move it "
            "somewhere else first, or name another --output."
        )
    sweep(folder)
    scene = _own_scene(folder)
    if results(folder):
        discard_previous(folder)
        older = folder / PREVIOUS
        (older / "test").mkdir(parents=True, exist_ok=True)
        write_atomically(older / "config.json", (folder / "config.json").read_bytes())
        record = None if scene is None else read_record(scene)
        if scene is not None and record is not None:
            copy_written(scene, record, older / IN_RUN)
        for path in [*results(folder), *_by_products(folder)]:
            place = older / path.relative_to(folder)
            place.parent.mkdir(exist_ok=True)
            path.replace(place)
    else:
        for path in _by_products(folder):
            path.unlink()
    if scene is not None and not _lies_in(in_use, scene):
        remove_posed(scene)


def discard_previous(folder: Path) -> None:
    """Remove what ``set_aside`` put aside, but nothing that others put there."""
    older = folder / PREVIOUS
    if older.exists():
        sweep(older)
        for path in [*_by_products(older), *results(older)]:
            path.unlink()
        scene = _own_scene(older)
        if scene is not None:
            remove_posed(scene)
        (older / "config.json").unlink(missing_ok=True)
        for emptied in (older / "test", older / TENSORBOARD, older):
            with suppress(OSError):  # not empty
                emptied.rmdir()


def take_scene(folder: Path, source: str) -> None:
    """Put the scene that waits in next/ in its place if it is the source, and else remove it."""
    waiting = folder / NEXT_IN_RUN
    if not source.startswith("builtin:") and _lies_in(source, waiting):
        move_into(waiting, folder / IN_RUN)
    remove_posed(waiting)
    with suppress(OSError):  # not empty, or not there
        waiting.parent.rmdir()


def discard_figures(folder: Path) -> None:
    """Remove metrics and pictures of test views, which are of another field than that to come."""
    for name in ("metrics.json", SHEET, *(f"test/{name}" for name in _pictures(folder))):
        (folder / name).unlink(missing_ok=True)


def _by_products(folder: Path) -> list[Path]:
    """What else a run writes, but its configuration."""
    names = ("log.jsonl", CSV, CURVES, "metrics.json", SHEET, VISIBILITY)
    files = [*(folder / name for name in names), *(folder / TENSORBOARD).glob(EVENTS)]
    files += [folder / "test" / name for name in _pictures(folder)]
    return [path for path in files if path.exists()]


def _pictures(folder: Path) -> list[str]:
    """File names of the pictures that the run may have written to test/."""
    try:
        listed = read_config(folder).pictures
    except InputError:
        return []
    if listed is not None:
        return [name for name in listed if Path(name).name == name]
    return [path.name for path in (folder / "test").glob("*.png")]


def _own_scene(folder: Path) -> Path | None:
    """The posed scene in the folder; None where there is none, or the run is not of it."""
    scene = folder / IN_RUN
    try:
        is_own = _lies_in(read_config(folder).scene, scene)
        return scene if is_own and read_record(scene) else None
    except InputError:
        return None


def _lies_in(path: str | Path, folder: Path) -> bool:
    """Whether a path is that of a folder or of something in it."""
    return Path(path).resolve().is_relative_to(folder.resolve())
