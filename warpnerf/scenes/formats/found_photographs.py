"""Photographs of a capture that another program wrote cameras of, found by their names.

Such programs write names only, with or without the extension; where the photographs are, and of
what size they now are, is for the reader to find.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.files import (
    ARCHIVES,
    ENDINGS,
    OTHER_IMAGES,
    REDUCED,
    UNREAD_ENDINGS,
    exists,
    is_photograph,
    printable,
    resolve_inside,
)
from warpnerf.scenes.formats.assemble import POSED, Reading, assemble
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.formats.left_over import files_in, only_ply, tried_points
from warpnerf.scenes.formats.unnamed_photographs import photographs_left
from warpnerf.scenes.images.depths import DepthFile
from warpnerf.scenes.images.masks import without_masks
from warpnerf.scenes.scene import Scene

NO_PHOTOGRAPHS = re.compile(rf"{REDUCED.pattern}|{OTHER_IMAGES.pattern}", re.IGNORECASE)
"""Folders within one of photographs whose images are none, or are the same ones reduced."""


class Photographs:
    """The photographs in a scene's images/, or else anywhere in its folder, by name."""

    def __init__(self, folder: Path, among: Path | None = None, within: bool = True) -> None:
        """Look for photographs.

        Args:
            folder: The scene's.
            among: Where they are; None: in its images/ if there is one, else anywhere in it.
            within: Whether also in folders within that.
        """
        images = folder / "images"
        self.folder = folder
        self.root = among or (images if images.is_dir() else folder)
        self.paths = _photographs_below(self.root, within)
        self._by_name: dict[str, list[Path]] = {}
        self._by_stem: dict[str, list[Path]] = {}
        for path in self.paths:
            self._by_name.setdefault(normalised(path.name), []).append(path)
            self._by_stem.setdefault(normalised(path.stem), []).append(path)

    def find(
        self, name: str, field: str, fits: Callable[[Path], bool] = lambda path: True
    ) -> Path | None:
        """The photograph of a name, with or without folders and extension; None: it is not there.

        Args:
            name: To look for.
            field: That holds it, for messages.
            fits: Which photographs of that name come into question.

        Raises:
            InputError: Several photographs have that name.
        """
        last = name.replace("\\", "/").rpartition("/")[2]
        for key in dict.fromkeys([normalised(last), normalised(without_ending(last))]):
            found = self._by_name.get(key) or self._by_stem.get(key, [])
            path = self.only(name, field, [path for path in found if fits(path)])
            if path is not None:
                return path
        return None

    def only(self, name: str, field: str, found: Sequence[Path]) -> Path | None:
        """The one of some photographs that has a name's folders, too, or else the only one.

        Args:
            name: To look for, which is that of each of them but for folders.
            field: That holds it, for messages.
            found: The photographs.

        Raises:
            InputError: There are several.
        """
        folders = name.replace("\\", "/").split("/")[:-1]
        while len(found) > 1 and folders:
            below = normalised(folders.pop())
            found = [path for path in found if normalised(path.parent.name) == below] or found
        if len(found) > 1:
            first, second = (self.name(path) for path in found[:2])
            raise InputError(
                f"{field}: {printable(name[:80])!r} is the name of {len(found)} photographs "
                f"({first}, {second}); give each a name of its own, or leave one of them."
            )
        return found[0] if found else None

    def name(self, path: Path) -> str:
        """A photograph's path relative to the scene's folder, with /."""
        return path.relative_to(self.folder).as_posix()

    def missing(self, file: Path, n: int, names: Sequence[str]) -> list[str]:
        """A warning of cameras, of n, whose photographs are not there.

        Raises:
            InputError: None is.
        """
        if not names:
            return []
        first = printable(names[0][:80])
        if len(names) == n:
            raise InputError(
                f"{file}: none of its {n} photographs is in {self.root} (first: {first})"
                f"{self.others()}; put them there."
            )
        return [
            f"{file.name}: left out {len(names)} of {n} cameras for want of a photograph (first: "
            f"{first})"
        ]

    def others(self) -> str:
        """Half a sentence on photographs that are there under other names, or are not read."""
        unread = [] if self.paths else _photographs_below(self.root, True, UNREAD_ENDINGS)
        paths = self.paths or unread
        archive = next((p for p in files_in(self.folder) if p.suffix.lower() in ARCHIVES), None)
        if not paths and archive is not None:
            return f", but the archive {printable(archive.name)} is: unpack it"
        if not paths:
            return ""
        kind = paths[0].suffix.lstrip(".").upper()
        what = f"as {kind}, to be converted to JPEG," if unread else f"other{'s'[: len(paths) - 1]}"
        is_there = "are" if len(paths) > 1 else "is"
        return (
            f", but {len(paths)} {what} {is_there} (first: {printable(self.name(paths[0])[:80])})"
        )

    def unposed(self, file: Path, used: Collection[Path]) -> tuple[list[str], list[str]]:
        """Notes and warnings of photographs that have no camera."""
        return photographs_left(self.paths, used, self.folder, f"have no camera in {file.name}")


def normalised(name: str) -> str:
    """A name for comparing: upper and lower case, and composed and decomposed accents, are one."""
    return unicodedata.normalize("NFC", name).casefold()


def without_ending(name: str) -> str:
    """A photograph's name without the ending of its format, read or not, if it has one."""
    stem, dot, ending = name.rpartition(".")
    return stem if dot and f".{ending.lower()}" in (*ENDINGS, *UNREAD_ENDINGS) else name


def is_written(folder: Path) -> bool:
    """Whether a folder is a run's or a posed scene: its images are renderings, or photographs of
    another folder again."""
    is_run = exists(folder / "config.json") and (
        exists(folder / "log.jsonl") or exists(folder / "test")
    )
    return is_run or exists(folder / POSED)


def _photographs_below(root: Path, within: bool, endings: tuple[str, ...] = ENDINGS) -> list[Path]:
    """All photographs in a folder and in folders within it, by name, but those in runs."""
    found: list[Path] = []
    for place, folders, names in os.walk(root):
        folders[:] = sorted(
            name
            for name in folders
            if within
            and not name.startswith(".")
            and not NO_PHOTOGRAPHS.fullmatch(name)
            and not is_written(Path(place) / name)
        )
        found += [Path(place) / name for name in names if is_photograph(name, endings)]
    return sorted(without_masks(found))


@dataclass(frozen=True, kw_only=True, eq=False)
class PosedCamera:
    """What another program knows of a photograph."""

    c2w: np.ndarray
    """[3, 4], OpenGL axes, scene units."""
    lens: Lens
    """With the size of the images that it is for, if that is known."""
    depth: DepthFile | None = None
    """True depth; None: not known."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A camera in the file of another program."""

    name: str
    """Of its photograph, as the file has it."""
    place: str
    """Where in the file it is."""
    read: Callable[[Path], PosedCamera]
    """The camera, given the photograph; called where that is there."""


def scene_of(
    file: Path,
    entries: Sequence[Entry],
    photographs: Photographs,
    reading: Reading,
    say: Callable[[], tuple[Sequence[str], Sequence[str]]] = lambda: ((), ()),
) -> Scene:
    """The scene of another program's cameras, every 8th of them for testing.

    Args:
        file: Where they are.
        entries: All of them.
        photographs: Of the scene.
        reading: How these are read.
        say: Called once all cameras are read: more notes, and more warnings.

    Raises:
        InputError: No photograph is there, or several cameras are of one.
    """
    frames: list[Frame] = []
    missing: list[str] = []
    for entry in entries:
        path = photographs.find(entry.name, entry.place)
        if path is None:
            missing.append(entry.name)
            continue
        resolve_inside(photographs.folder, photographs.name(path), field=entry.place)
        camera = entry.read(path)
        name, c2w = photographs.name(path), camera.c2w
        frames.append(Frame(name=name, path=path, c2w=c2w, lens=camera.lens, depth=camera.depth))
    twice = len(frames) - len({frame.name for frame in frames})
    if twice:
        raise InputError(
            f"{file}: {twice} cameras are of a photograph that another one is of; remove them, and "
            "export again."
        )
    warnings = photographs.missing(file, len(entries), missing)
    few, many = photographs.unposed(file, {frame.path for frame in frames})
    notes, more = say()
    points = only_ply(photographs.folder)
    scene = assemble(
        folder=photographs.folder,
        file=file,
        frames=frames,
        splits={},
        warnings=[*warnings, *many, *more],
        reading=reading,
        points=points,
    )
    tried = tried_points(points, scene)
    return replace(scene, notes=(*notes, *tried, *few, *scene.notes))
