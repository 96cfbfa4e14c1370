"""Photographs beside those of a scene, which its file does not name."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from warpnerf.scenes.files import (
    DEPTHS,
    MASKS,
    OTHER_IMAGES,
    PHOTOGRAPHS,
    is_photograph,
    printable,
)
from warpnerf.scenes.formats.left_over import files_in, folders_in
from warpnerf.scenes.images.masks import without_masks

UNPOSED = 0.1
"""Share of the photographs that is left, above which that is a warning."""
SAID_ELSEWHERE = re.compile(
    rf"{MASKS.pattern}|{DEPTHS.pattern}|(.*[_-])?thumb(nail)?s?([_-]?images?)?", re.IGNORECASE
)
"""Folders of masks and depth maps, which are named where these are read, and of previews."""
SAME = 0.5
"""Share of the names of photographs, above which a folder beside is of another camera."""


def unnamed_photographs(
    root: Path, used: Collection[Path], named_by: str
) -> tuple[list[str], list[str]]:
    """Notes and warnings of photographs beside a scene's that it does not have.

    Args:
        root: The folder of all photographs.
        used: Those of the scene, and its masks and depth maps.
        named_by: What names the scene's photographs.
    """
    there: list[Path] = []
    for place in {path.parent for path in used}:  # others hold masks or thumbnails
        if place != root and root not in place.parents:  # only masks and depth maps
            continue
        there += without_masks([path for path in files_in(place) if is_photograph(path.name)])
    what = f"in {printable(root.absolute().name)} are not in {named_by}"
    return photographs_left(there, used, root, what)


def same_names_beside(folder: Path, used: Collection[Path], named_by: str) -> list[str]:
    """Notes of folders beside that of a scene's photographs which hold others of the same names, as
    the second camera of a pair writes them.

    Args:
        folder: The scene's.
        used: Its photographs.
        named_by: What names them.
    """
    stems: dict[Path, set[str]] = {}
    for path in used:
        stems.setdefault(path.parent, set()).add(path.stem)
    notes = []
    for place in sorted({p.parent for p in stems if p != folder}):
        own = set().union(*(names for path, names in stems.items() if path.parent == place))
        for other in folders_in(place):
            if other in stems or any(other in path.parents for path in used):
                continue
            if PHOTOGRAPHS.fullmatch(other.name) or SAID_ELSEWHERE.fullmatch(other.name):
                continue
            what = "images" if OTHER_IMAGES.fullmatch(other.name) else "photographs"
            same = [p for p in files_in(other) if is_photograph(p.name) and p.stem in own]
            if len(same) > SAME * len(own):
                notes.append(
                    f"also in the folder, and not used: "
                    f"{printable(other.relative_to(folder).as_posix()[:80])}, with {len(same)} "
                    f"{what} of the same names, which {named_by} does not name"
                )
    return notes


def photographs_left(
    there: Sequence[Path], used: Collection[Path], folder: Path, what: str
) -> tuple[list[str], list[str]]:
    """Notes and warnings of photographs that are not used, and called after none that is.

    Args:
        there: All photographs.
        used: Those that are used, and other images that are.
        folder: Which they are named from.
        what: To say of those left.
    """
    stems: dict[Path, set[str]] = {}
    for path in used:
        stems.setdefault(path.parent, set()).add(path.stem)
    own = [
        path
        for path in there
        if path in used or stems.get(path.parent, set()).isdisjoint(_called_after(path.stem))
    ]
    left = sorted(path for path in own if path not in used)
    if not left:
        return [], []
    said = [
        f"{len(left)} of {len(own)} photographs {what} (first: "
        f"{printable(left[0].relative_to(folder).as_posix()[:80])})"
    ]
    return ([], said) if len(left) > UNPOSED * len(own) else (said, [])


def _called_after(stem: str) -> Iterator[str]:
    """The photographs that a file may be of, by its name: 0001 for 0001, 0001_depth and
    depth_0001."""
    yield stem
    for found in re.finditer(r"[._-]", stem):
        yield stem[: found.start()]
        yield stem[found.end() :]
