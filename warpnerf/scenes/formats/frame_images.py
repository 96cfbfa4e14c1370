"""The images that a scene file's frames name."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import (
    OutsideError,
    find_image,
    photograph_folder,
    plain_name,
    printable,
    resolve_inside,
)
from warpnerf.scenes.formats.found_photographs import Photographs, normalised, without_ending

REDUCED = re.compile(r"images_\d{1,3}", re.IGNORECASE)
"""Folders of a scene's photographs, reduced."""


def find_images(
    folder: Path, file: Path, file_paths: Sequence[str], required: bool = True
) -> tuple[dict[int, Path], list[str], set[int]]:
    """Find the images of a scene file's frames; leave out the missing ones and the repeated ones.

    Args:
        folder: That paths are relative to, and must not leave.
        file: The scene file, for messages.
        file_paths: Of each frame, as the file has it.
        required: Whether one image at least must be there.

    Returns:
        The image of each frame that is kept, by the frame's index; warnings of the others; and the
        frames whose images are not where the file says.

    Raises:
        InputError: A path leaves the folder, or no image is there though one is required.
    """
    there, moved = find_photographs(
        folder, folder, file_paths, lambda index: f"{file}: $.frames[{index}].file_path"
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
            set(),
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
    folder: Path, root: Path, names: Sequence[str], field: Callable[[int], str]
) -> tuple[dict[int, Path], set[int]]:
    """Find photographs by their names in a file, also if they were renamed or moved since.

    Where no file is at a name's path, it is one in the same folder whose name differs in case or in
    how accents are composed; or in its ending, unless others there have the endings that the file
    says. If none at all is found, photographs anywhere in the scene's folder are, whose path and
    name agree from their ends as far as both go.

    Args:
        folder: The scene's, which nothing is looked for out of.
        root: That names are relative to.
        names: Of photographs, as the file has them.
        field: Of the file that holds the name of an index, for messages.

    Returns:
        The photographs that are there, by index; and which of them have another path than the file
        says.

    Raises:
        InputError: A name leaves the folder and is not in it either, or what it leads to does by a
            link; or it is that of several photographs, or of one which another name leads to.
    """
    found: dict[int, Path] = {}
    outside: OutsideError | None = None
    renamed: list[int] = []
    for index, name in enumerate(names):
        try:
            path = find_image(root, name, field=field(index))
        except OutsideError as error:
            outside = outside or error
            continue
        if path is None:
            renamed.append(index)
        else:
            found[index] = path
    owners = dict.fromkeys(found.values(), "")
    moved: set[int] = set()

    def take(index: int, path: Path | None) -> None:
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
        moved.add(index)

    unchanged = {path.parent for path in owners}
    beside: dict[Path, Photographs] = {}
    for index in renamed:
        path = resolve_inside(root, names[index], field=field(index))
        if path.parent not in beside:
            beside[path.parent] = Photographs(folder, among=path.parent, within=False)
        fits = partial(_is_named, path.name, path.parent not in unchanged)
        take(index, beside[path.parent].find(path.name, field(index), fits))
    if found and outside is not None:
        raise outside
    for among in () if found else dict.fromkeys((photograph_folder(folder) or folder, folder)):
        there = Photographs(folder, among=among)
        for index, name in enumerate(names):
            take(index, there.find(name, field(index), partial(_agree, folder, name)))
        if found:
            break
    if not found and outside is not None:
        raise outside
    return found, moved


def _is_named(name: str, converted: bool, path: Path) -> bool:
    """Whether a photograph of some name may be one of that name, perhaps in another format."""
    has_ending = without_ending(name) != name
    return converted or not has_ending or normalised(path.name) == normalised(name)


def others_there(folder: Path) -> str:
    """Half a sentence on photographs of other names in a scene's folder, if there are some."""
    paths = Photographs(folder, among=photograph_folder(folder)).paths
    if not paths:
        return ""
    first = printable(paths[0].relative_to(folder).as_posix()[:80])
    return f", but {len(paths)} others are (first: {first})"


def _agree(folder: Path, name: str, path: Path) -> bool:
    """Whether a name, and a photograph's path in the scene's folder, are one as far as both go."""
    named, there = _parts(name), _parts(path.relative_to(folder).as_posix())
    if there[0] == "images" or REDUCED.fullmatch(there[0]):
        there = there[1:]
    n = min(len(named), len(there))
    return n > 0 and named[-n:] == there[-n:]


def _parts(name: str) -> list[str]:
    *folders, last = plain_name(name).split("/")
    return [normalised(part) for part in folders if part] + [normalised(without_ending(last))]
