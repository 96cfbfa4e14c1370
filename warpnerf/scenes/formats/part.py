"""A part of a capture: some of its photographs, with the box that they are trained for.

NAME.part.json names the capture, which is read as ever; so a part has its coordinates.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.files import printable, read_json
from warpnerf.scenes.images.photographs import Keeping, Photograph, keep
from warpnerf.scenes.scene import Scene, View

ENDING = ".part.json"

Triple = tuple[float, float, float]


class Part(msgspec.Struct, frozen=True, kw_only=True):
    """What the file says."""

    part_of: str
    """The capture: an absolute path, or a built-in name."""
    photographs: list[str]
    """Names of those that belong to the part."""
    box_min: Triple
    """Lower corner of its box, scene units, in the coordinates of the capture as it is read."""
    box_max: Triple
    """Upper corner."""
    split: Literal["all", "sector"] | int | list[str] | None = None
    """Which of the capture's photographs are withheld, see ``load_scene``; None: as it says."""

    def to_json(self) -> bytes:
        """The file."""
        return json.dumps(msgspec.to_builtins(self), indent=1).encode() + b"\n"


def read_part(path: Path) -> Part:
    """Read the file.

    Raises:
        InputError: It is no part of a capture.
    """
    part = read_json(path, Part)
    if part.part_of.endswith(ENDING):
        raise InputError(f"{path}: $.part_of: is a part itself; name the whole capture.")
    return part


def part_of(whole: Scene, part: Part, path: Path, keeping: Keeping, downscale: int) -> Scene:
    """The photographs of a part.

    Args:
        whole: The capture; photographs of files are not read yet.
        part: Which of them.
        path: Of the part's file, whose name is the scene's.
        keeping: Where their pixels are kept.
        downscale: That they are reduced by, for messages.

    Returns:
        A scene whose box is the part's. It is unbounded: its cameras see more than the box.

    Raises:
        InputError: The capture has no such photograph, or none of them is for training.
    """
    known = {view.name: index for index, view in enumerate(whole.views)}
    missing = [name for name in part.photographs if name not in known]
    if missing:
        raise InputError(
            f"{path}: {part.part_of} has no photograph {printable(missing[0][:80])}; it is not the "
            "capture that the part was made of."
        )
    chosen = sorted({known[name] for name in part.photographs})
    place = {index: number for number, index in enumerate(chosen)}
    splits = {
        split: tuple(place[index] for index in indices if index in place)
        for split, indices in whole.splits.items()
    }
    if not splits["train"]:
        raise InputError(f"{path}: none of its photographs is for training; name some that are.")
    views, notes = _kept([whole.views[index] for index in chosen], path, keeping, downscale)
    box = np.array([part.box_min, part.box_max])
    distance, distances = whole.content_distance, whole.content_distances
    if distances is not None:
        distances = distances[chosen]
        distance = float(np.median(distances[list(splits["train"])]))
    seen, points = whole.observations, whole.points
    if seen is not None:
        inside = ((box[0] <= seen.positions) & (seen.positions <= box[1])).all(axis=1)
        seen = seen.of(inside) if inside.any() else None
    if points is not None:
        points = points[((box[0] <= points) & (points <= box[1])).all(axis=1)]
    return replace(
        whole,
        name=path.name.removesuffix(ENDING),
        views=views,
        splits=splits,
        box_min=box[0],
        box_max=box[1],
        unbounded=True,
        content_distance=distance,
        content_distances=distances,
        guessed=False,
        points=points,
        observations=seen,
        bounds=None,
        notes=(f"{len(views)} of {len(whole.views)} photographs of {whole.name}", *notes),
    )


def _kept(
    views: Sequence[View], path: Path, keeping: Keeping, downscale: int
) -> tuple[list[View], tuple[str, ...]]:
    """The views, with pixels of files kept; and what should be told."""
    images = [view.__dict__["image"] for view in views]
    files = [image for image in images if isinstance(image, Photograph)]
    if len(files) < len(images):  # built in
        return list(views), ()
    kept = keep(files, keeping, file=path, downscale=downscale)
    pairs = zip(views, kept.images, strict=True)
    return [view.with_image(image) for view, image in pairs], kept.notes
