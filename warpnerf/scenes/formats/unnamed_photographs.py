"""Photographs beside those of a scene, which its file does not name."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from warpnerf.scenes.files import is_photograph, printable
from warpnerf.scenes.formats.left_over import files_in
from warpnerf.scenes.images.masks import without_masks

UNPOSED = 0.1
"""Share of the photographs that is left, above which that is a warning."""


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
        there += without_masks([path for path in files_in(place) if is_photograph(path.name)])
    what = f"in {printable(root.absolute().name)} are not in {named_by}"
    return photographs_left(there, used, root, what)


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
