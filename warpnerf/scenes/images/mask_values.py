"""Segmentation masks: whether images that are read as masks hold black and white, or classes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.images.images import read_image
from warpnerf.scenes.images.masks import LOSSY, Mask

LOOKED_AT = 8
"""Masks, at most, whose values are counted."""
MOST_PIXELS = 2**20
"""Of each of them, about."""
PLAIN = 0.005
"""Share of the pixels, equal to those above and to the left, from which on a value is one of the
mask's, and not of the soft edge between two."""
SHADES = 64
"""Colours of a photograph, at least, and more than a mask has but at its edges."""
BETWEEN = 0.5
"""Share of the pixels that must be neither black nor white for an image to be no mask."""
NEARLY = 8
"""Of 255, by which black and white may be off."""


def other_values(masks: Sequence[Mask]) -> list[str]:
    """A warning of masks that hold more than two plain values, or those of photographs.

    Args:
        masks: Of the scene. Those that cannot be read, or are lossy, are left out, and those of
            which black alone counts.
    """
    found: set[int] = set()
    first = None
    for mask in masks[:: max(1, -(-len(masks) // LOOKED_AT))]:
        if mask.path.suffix.lower() in LOSSY or not mask.white_counts:
            continue
        try:
            plain, shades, between = _values(read_image(mask.path))
        except InputError:
            continue
        if shades >= SHADES and between > BETWEEN:
            return [
                f"masks look like photographs: {mask.path.name} holds {shades} colours or more, of "
                "which what is brighter than half counts; name a folder of masks, white where "
                "pixels count and black where not"
            ]
        found |= plain
        first = first or (mask.path.name if len(found) > 2 else None)
    if first is None:
        return []
    shown = ", ".join(map(_name, sorted(found)[:6])) + ", ..." * (len(found) > 6)
    return [
        f"masks hold {len(found)} values ({shown}; {first}), as numbers of classes, of which those "
        "above 127 count; write 255 where pixels count and 0 where not"
    ]


def _values(image: np.ndarray) -> tuple[set[int], int, float]:
    """Of a mask [H, W, 3 or 4]: its plain values, how many it has, and the share of those that are
    neither black nor white. Values are numbers of 24 bits, red first; black and white are exact."""
    every = max(1, round((image.shape[0] * image.shape[1] / MOST_PIXELS) ** 0.5))
    at, above, before = (
        _numbers(image[rows][:, columns])
        for rows, columns in (
            (slice(1, None, every), slice(1, None, every)),
            (slice(0, -1, every), slice(1, None, every)),
            (slice(1, None, every), slice(0, -1, every)),
        )
    )
    values, counts = np.unique(at[(at == above) & (at == before)], return_counts=True)
    between = np.mean((at > 0) & (at < 0xFFFFFF)) if at.size else 0.0
    plain = values[counts >= PLAIN * at.size]
    return set(plain.tolist()), len(np.unique(at)), float(between)


def _numbers(image: np.ndarray) -> np.ndarray:
    """Colours as numbers of 24 bits, [H, W]."""
    rgb = image[..., :3].astype(np.int32)
    rgb[rgb.max(axis=2) <= NEARLY], rgb[rgb.min(axis=2) >= 255 - NEARLY] = 0, 255
    return np.asarray(rgb @ np.array([1 << 16, 1 << 8, 1], np.int32))


def _name(value: int) -> str:
    """Of a gray one its number, else #rrggbb."""
    red, green, blue = value >> 16, value >> 8 & 255, value & 255
    return str(red) if red == green == blue else f"#{value:06x}"
