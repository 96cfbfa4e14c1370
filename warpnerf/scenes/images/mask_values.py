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
FLAT = 0.5
"""Share of the pixels that are neither black nor white which must have such values: else these are
of a wide soft edge."""
SHADES = 64
"""Colours of a photograph, at least, and more than a mask has but at its edges."""
BETWEEN = 0.5
"""Share of the pixels that must be neither black nor white for an image to be no mask."""
COLOURED = 0.05
"""Share of the pixels whose channels must differ by more than NEARLY for that: a gray image may be
a matte with a wide soft edge."""
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
            image = read_image(mask.path)
        except InputError:
            continue
        plain, shades, between = _values(image)
        if shades >= SHADES and between > BETWEEN and _coloured(image) > COLOURED:
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
    between = (at > 0) & (at < 0xFFFFFF)
    plain = values[counts >= PLAIN * at.size]
    if np.isin(at[between], plain).sum() < FLAT * between.sum():
        plain = plain[(plain == 0) | (plain == 0xFFFFFF)]
    return set(plain.tolist()), len(np.unique(at)), float(between.mean()) if at.size else 0.0


def _coloured(image: np.ndarray) -> float:
    """Share of the pixels of an image [H, W, 3 or 4] that are not gray."""
    rgb = image[..., :3].astype(np.int16)
    return float(np.mean(np.ptp(rgb, axis=2) > NEARLY))


def _numbers(image: np.ndarray) -> np.ndarray:
    """Colours as numbers of 24 bits, [H, W]."""
    rgb = image[..., :3].astype(np.int32)
    rgb[rgb.max(axis=2) <= NEARLY], rgb[rgb.min(axis=2) >= 255 - NEARLY] = 0, 255
    return np.asarray(rgb @ np.array([1 << 16, 1 << 8, 1], np.int32))


def _name(value: int) -> str:
    """Of a gray one its number, else #rrggbb."""
    red, green, blue = value >> 16, value >> 8 & 255, value & 255
    return str(red) if red == green == blue else f"#{value:06x}"
