"""The images that a scene file's frames name."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import (
    ENDINGS,
    PHOTOGRAPHS,
    REDUCED,
    UNREAD_ENDINGS,
    OutsideError,
    find_image,
    photograph_folder,
    plain_name,
    printable,
    resolve_inside,
)
from warpnerf.scenes.formats.found_photographs import Photographs, normalised, without_ending
from warpnerf.scenes.formats.frame import Frame

RENDERINGS = re.compile(r"(.*[_-])?render(ing)?s?", re.IGNORECASE)
"""Folders of images that are photographs, as of a synthetic scene, only where a file says so."""


def find_images(
    folder: Path,
    file: Path,
    file_paths: Sequence[str],
    required: bool = True,
    taken: Collection[Path] = (),
) -> tuple[dict[int, Path], list[str], dict[int, bool]]:
    """Find the images of a scene file's frames; leave out the missing ones and the repeated ones.

    Args:
        folder: That paths are relative to, and must not leave.
        file: The scene file, for messages.
        file_paths: Of each frame, as the file has it.
        required: Whether one image at least must be there.
        taken: Images of other files, which are this one's only where it gives their very paths.

    Returns:
        The image of each frame that is kept, by the frame's index; warnings of the others; and, of
        frames whose images are not where the file says, as of ``find_photographs``.

    Raises:
        InputError: A path leaves the folder, or no image is there though one is required.
    """
    there, moved = find_photographs(
        folder, folder, file_paths, lambda index: f"{file}: $.frames[{index}].file_path", taken
    )
    found: dict[int, Path] = {}
    seen: set[Path] = set()
    missing: list[str] = []
    repeated: list[str] = []
    for index, file_path in enumerate(file_paths):
        path = there.get(index)
        if path is None:
            missing.append(file_path)
        elif path in seen:
            repeated.append(file_path)
        else:
            found[index] = path
            seen.add(path)
    if not found and not required:
        first = f" (first: {missing[0]})" if missing else ""
        return (
            {},
            [
                f"{file.name} is not used: none of the {len(file_paths)} images that it names is "
                f"in the folder{first}"
            ],
            {},
        )
    if not file_paths:
        raise InputError(f"{file}: $.frames: is empty; a scene needs posed images.")
    if not found:
        raise InputError(
            f"{file}: $.frames[0].file_path: no image of {len(missing)} frames is in the folder "
            f"(first: {missing[0]}){others_there(folder)}; put the images where the file says, or "
            "correct it."
        )
    warnings = []
    if missing:
        warnings.append(
            f"{file.name}: left out {len(missing)} of {len(file_paths)} frames for want of an "
            f"image (first: {missing[0]})"
        )
    if repeated:
        warnings.append(
            f"{file.name}: left out {len(repeated)} of {len(file_paths)} frames for naming an "
            f"image again (first: {repeated[0]})"
        )
    return found, warnings, moved


def find_photographs(
    folder: Path,
    root: Path,
    names: Sequence[str],
    field: Callable[[int], str],
    taken: Collection[Path] = (),
) -> tuple[dict[int, Path], dict[int, bool]]:
    """Find photographs by their names in a file, also if they were renamed or moved since.

    Where no file is at a name's path, it is one in the same folder whose name differs in case or in
    how accents are composed; or in its ending, unless others there have the endings that the file
    says. If none at all is found, photographs anywhere in the scene's folder are, whose path and
    name agree from their ends as far as both go; but for those in folders of masks and the like
    that the name does not have, and with the ending that it has, unless they are in the folder of
    photographs or in one that it has.

    Args:
        folder: The scene's, which nothing is looked for out of.
        root: That names are relative to.
        names: Of photographs, as the file has them.
        field: Of the file that holds the name of an index, for messages.
        taken: Photographs that are nobody's here but of a name that is their very path.

    Returns:
        The photographs that are there, by index; and of those that have another path than the file
        says, whether they are in a folder that it does not name, nor is one of photographs.

    Raises:
        InputError: A name leaves the folder and is not in it either, or what it leads to does by a
            link; or it is that of several photographs, or of one which another name leads to.
    """
    found: dict[int, Path] = {}
    outside: OutsideError | None = None
    renamed: list[int] = []
    named: dict[int, Path] = {}  # with endings that are not read; what is in them may be
    for index, name in enumerate(names):
        try:
            path = find_image(root, name, field=field(index))
        except OutsideError as error:
            outside = outside or error
            continue
        if path is not None and path.suffix.lower() not in UNREAD_ENDINGS:
            found[index] = path
            continue
        renamed.append(index)
        if path is not None:
            named[index] = path
    unchanged = {path.parent for path in found.values()}
    owners = dict.fromkeys([*found.values(), *taken], "")
    moved: dict[int, bool] = {}

    def take(index: int, path: Path | None, elsewhere: bool = False) -> None:
        owner = "" if path is None else owners.setdefault(path, names[index])
        if path is None or not owner:
            return
        if owner != names[index]:
            raise InputError(
                f"{field(index)}: {printable(names[index][:80])!r} and {printable(owner[:80])!r} "
                f"both lead to {path.relative_to(folder).as_posix()}; correct one of them."
            )
        base = root if path.is_relative_to(root) else folder
        resolve_inside(base, path.relative_to(base).as_posix(), field=field(index))
        found[index] = path
        moved[index] = elsewhere

    beside: dict[Path, Photographs] = {}
    for index in renamed:
        path = resolve_inside(root, names[index], field=field(index))
        if path.parent not in beside:
            beside[path.parent] = Photographs(folder, among=path.parent, within=False)
        fits = partial(_is_named, path.name, path.parent not in unchanged)
        take(index, beside[path.parent].find(path.name, field(index), fits))
    if found and outside is not None:
        raise outside
    own = photograph_folder(folder)
    for among in () if found else dict.fromkeys((own or folder, folder)):
        there = _ByEnds(Photographs(folder, among=among))
        for index, name in enumerate(names):
            path = there.find(name, field(index), converted=among == own)
            take(index, path, path is not None and there.is_elsewhere(name, path))
        if found:
            break
    found = named | found
    if not found and outside is not None:
        raise outside
    return found, moved


def _is_named(name: str, converted: bool, path: Path) -> bool:
    """Whether a photograph of some name may be one of that name, perhaps in another format."""
    as_it_is = name.lower().endswith(ENDINGS) and not converted
    return not as_it_is or normalised(path.name) == normalised(name)


def others_there(folder: Path) -> str:
    """Half a sentence on photographs of other names in a scene's folder, if there are some."""
    return Photographs(folder, among=photograph_folder(folder)).others()


def elsewhere_warnings(file: Path, frames: Sequence[Frame]) -> list[str]:
    """A warning of photographs, if any, in folders that a scene's file does not name."""
    found = [frame for frame in frames if frame.elsewhere]
    if not found:
        return []
    return [
        f"{file.name}: {len(found)} of {len(frames)} photographs are found by their names only, in "
        f"a folder that the file does not name (first: {printable(found[0].name[:80])} for "
        f"{printable(found[0].called[:80])}): if they are others, put the right ones into images"
    ]


class _ByEnds:
    """Photographs whose paths in a scene's folder, and names, are one as far as both go."""

    def __init__(self, photographs: Photographs) -> None:
        self._photographs = photographs
        self._whole: dict[tuple[str, ...], list[Path]] = {}
        self._ends: dict[tuple[str, ...], list[Path]] = {}
        for path in photographs.paths:
            parts = self._parts_of(path)
            self._whole.setdefault(parts, []).append(path)
            for start in range(1, len(parts)):
                if RENDERINGS.fullmatch(parts[start - 1]):
                    break
                self._ends.setdefault(parts[start:], []).append(path)
        self._deepest = max(map(len, self._whole), default=0)

    def find(self, name: str, field: str, converted: bool) -> Path | None:
        """The photograph of a name; None: it is not there.

        Args:
            name: To look for.
            field: That holds it, for messages.
            converted: Whether it may have another ending, though it is in no folder of the name's.

        Raises:
            InputError: Several photographs have that name.
        """
        named = _parts(name)
        agreeing = [(len(named), path) for path in self._ends.get(named, ())]
        for n in range(1, min(len(named), self._deepest) + 1):
            agreeing += [(n, path) for path in self._whole.get(named[-n:], ())]
        last = normalised(plain_name(name).rpartition("/")[2])
        same = [path for _, path in agreeing if normalised(path.name) == last]
        converted = converted or not last.endswith(ENDINGS)
        others = [path for n, path in agreeing if converted or n > 1]
        return self._photographs.only(name, field, same or others)

    def is_elsewhere(self, name: str, path: Path) -> bool:
        """Whether a photograph is in a folder that its name does not have, nor is one of
        photographs."""
        top = self._photographs.name(path).partition("/")[0]
        return len(self._parts_of(path)) > len(_parts(name)) and not PHOTOGRAPHS.fullmatch(top)

    def _parts_of(self, path: Path) -> tuple[str, ...]:
        parts = _parts(self._photographs.name(path))
        return parts[1:] if parts[0] == "images" or REDUCED.fullmatch(parts[0]) else parts


def _parts(name: str) -> tuple[str, ...]:
    *folders, last = plain_name(name).split("/")
    return *(normalised(part) for part in folders if part), normalised(without_ending(last))
