"""Photographs beside those of a scene, which its file does not name."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from warpnerf.scenes.files import is_photograph, printable
from warpnerf.scenes.formats.left_over import files_in
from warpnerf.scenes.images.masks import without_masks

UNPOSED = 0.1
"""Share of the photographs without a pose, above which that is a warning."""


def unnamed_photographs(
    root: Path, used: Collection[Path], named_by: str
) -> tuple[list[str], list[str]]:
    """Notes and warnings of photographs beside a scene's that it does not have.

    Args:
        root: The folder of all photographs.
        used: Those of the scene, and its masks and depth maps.
        named_by: What names the scene's photographs.
    """
    there = []
    for place in sorted({path.parent for path in used}):  # others hold masks or thumbnails
        stems = {path.stem for path in used if path.parent == place}
        images = [path for path in files_in(place) if is_photograph(path.name)]
        there += [
            path
            for path in without_masks(images)
            if path in used or not stems.intersection(_beginnings(path.stem))
        ]
    left = sorted(path for path in there if path not in used)
    if not left:
        return [], []
    said = [
        f"{len(left)} of {len(there)} photographs in {printable(root.absolute().name)} are not in "
        f"{named_by} (first: {printable(left[0].relative_to(root).as_posix()[:80])})"
    ]
    return ([], said) if len(left) > UNPOSED * len(there) else (said, [])


def _beginnings(stem: str) -> Iterator[str]:
    """What a name may be called after: 0001 of 0001_depth, as 0001 and its depth are of one."""
    return (stem[: found.start()] for found in re.finditer(r"[._-]", stem))
