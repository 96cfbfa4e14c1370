"""Photographs that a capture brings reduced, in images_2, images_4 or images_8 beside its images.

They are used for a downscale of 2, 4 or 8 in place of reducing the others, where they are the same
photographs and exactly so much smaller: reading them takes a fraction of the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.files import IMAGE_SUFFIXES, exists
from warpnerf.scenes.formats.frame import Frame
from warpnerf.scenes.images.images import box_filter, image_shape, read_image

FOLDER = "images"
COMPARED = 3
"""Photographs, at most, that are read in both sizes and compared."""
ALIKE = 20.0
"""Of 255, by which a photograph and a reduced one may differ on average: resampled otherwise, and
compressed again."""


def with_reduced(frames: Sequence[Frame], downscale: int) -> tuple[list[Frame], list[str]]:
    """Frames with the reduced photographs that there are, and a note of that.

    Args:
        frames: To read.
        downscale: Edge of the blocks of pixels that become one.

    Returns:
        Frames as they are where no photograph, or not every one, is there reduced.
    """
    if downscale == 1 or any(frame.image is not None for frame in frames):
        return list(frames), []
    name = f"{FOLDER}_{downscale}"
    places = [_beside(frame.path, name) for frame in frames]
    if not frames or not all(place is not None and place.is_dir() for place in places):
        return list(frames), []
    found = [_reduced(frame.path, name) for frame in frames]
    why_not = _why_not(frames, found, downscale)
    if why_not:
        return list(frames), [f"{name} is not used, as {why_not}: {FOLDER} is reduced instead"]
    reduced = [replace(frame, reduced=path) for frame, path in zip(frames, found, strict=True)]
    return reduced, [f"the photographs of {name} are used, as they are those of {FOLDER} reduced"]


def _beside(path: Path, name: str) -> Path | None:
    """The folder of that name beside the folder of images that a photograph is in."""
    return next((p.with_name(name) for p in path.parents if p.name == FOLDER), None)


def _reduced(path: Path, name: str) -> Path | None:
    """The photograph of the same name, whatever its extension, in that folder."""
    images = next(parent for parent in path.parents if parent.name == FOLDER)
    there = images.with_name(name) / path.relative_to(images)
    paths = (there, *(there.with_suffix(suffix) for suffix in IMAGE_SUFFIXES))
    return next((path for path in paths if exists(path)), None)


def _why_not(frames: Sequence[Frame], found: Sequence[Path | None], downscale: int) -> str:
    """What is wrong with reduced photographs; empty if nothing is."""
    missing = [frame.name for frame, path in zip(frames, found, strict=True) if path is None]
    if missing:
        return f"it lacks {len(missing)} of {len(frames)} photographs (first: {missing[0]})"
    pairs = [(f, path) for f, path in zip(frames, found, strict=True) if path is not None]
    try:
        for frame, path in pairs:
            height, width, channels = image_shape(frame.path)
            there = image_shape(path)
            if there[2] != channels:
                return f"{path.name} has alpha there or in {FOLDER}, but not in both"
            if there[:2] != (height / downscale, width / downscale):
                return (
                    f"{path.name} has {there[1]}x{there[0]} pixels there and {width}x{height} in "
                    f"{FOLDER}, which is not {downscale} times as many"
                )
        for frame, path in pairs[:: -(-len(pairs) // COMPARED)]:
            small = read_image(path).astype(np.float64)
            apart = np.abs(small - box_filter(read_image(frame.path), downscale)).mean()
            if apart > ALIKE:
                return f"{path.name} shows something else there"
    except InputError:
        return "one of its photographs, or of the others, is damaged"
    return ""
