"""What transparent pixels of photographs mean: nothing around an object, or nothing known.

An object that stands free has them around it. Undistortion and fisheye lenses, too, leave them, at
the edges of a picture, resampling a few that are almost opaque, and some people cut the sky out.
What a scene is must not follow from these.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from warpnerf.scenes.images.images import image_shape, read_image

FREE = 0.15
"""Share of transparent pixels from which on what is alike in all views may be an object, too, and
one that changes may reach two corners, as a bust does."""
FEW = 0.02
"""Share below which photographs show none."""
SAME_OUTLINE = 0.95
"""Share of its transparent pixels that a lens has in common in all views, and an object has not, as
its outline changes."""
EDGE = 0.05
"""Share of a picture's sides that counts as their edge, and in both directions as a corner."""
WHOLE = 0.99
"""Share of the pixels along an edge that show something if it is seen over its whole width."""
RECTANGLE = 0.98
"""Share of the pixels of the smallest box around a shape that the shape fills if it is one."""
ROWS_LOOKED_AT = 128
"""Rows and columns of a photograph, about, that are looked at."""
NO_ALPHA = (1, 1)
"""Shape that stands for that of a photograph without alpha."""
MOST_OF_A_LENS = 0.65
"""Share of transparent pixels above which no lens is: a circle in a picture of 2:1 leaves 61 %."""
OPAQUE = 128
"""Least alpha, of 255, of a pixel that shows something."""


def show_an_object(transparent: Sequence[np.ndarray]) -> bool:
    """Whether photographs show an object before nothing.

    Args:
        transparent: Of each of some photographs, [H, W] bool, where it shows nothing; all false
            where it has no alpha.

    Returns:
        False: what is transparent is to be ignored.
    """
    if not transparent:
        return False
    shares = [float(image.mean()) for image in transparent]
    share = float(np.median(shares))
    if share < FEW:
        return False
    shapes = {image.shape for image in transparent}
    common = [
        np.logical_and.reduce([image for image in transparent if image.shape == shape])
        for shape in shapes
    ]
    if np.mean([image.mean() for image in common]) >= SAME_OUTLINE * np.mean(shares):
        of_a_lens = share <= MOST_OF_A_LENS and all(_is_of_a_lens(~image) for image in common)
        return share >= FREE and not of_a_lens
    has_a_ground = _has_a_whole_edge if share >= FREE else _has_two_corners
    cut = [has_a_ground(~image) for image in transparent if image.any()]
    return bool(np.mean(cut) < 0.5)


def _is_of_a_lens(seen: np.ndarray) -> bool:
    """Whether a shape reaches two opposite edges of the picture, or is a rectangle in it."""
    rows, columns = _edge(seen)
    if (seen[:rows].any() and seen[-rows:].any()) or (
        seen[:, :columns].any() and seen[:, -columns:].any()
    ):
        return True
    box = seen[np.ix_(seen.any(axis=1), seen.any(axis=0))]
    return bool(box.size and box.mean() >= RECTANGLE)


def _has_a_whole_edge(seen: np.ndarray) -> bool:
    """Whether the lower or the upper edge shows something over its whole width, as a ground does
    from which the sky was cut out, or a room without its floor."""
    rows, _ = _edge(seen)
    return bool(max(seen[-rows:].mean(), seen[:rows].mean()) >= WHOLE)


def _has_two_corners(seen: np.ndarray) -> bool:
    """Whether both lower or both upper corners show something: an object that stands free leaves
    them empty, a view from which little sky was cut out, or a floor, does not."""
    rows, columns = _edge(seen)
    return any(
        seen[v, :columns].mean() > 0.5 and seen[v, -columns:].mean() > 0.5
        for v in (slice(-rows, None), slice(rows))
    )


def _edge(seen: np.ndarray) -> tuple[int, int]:
    rows, columns = seen.shape
    return max(1, round(EDGE * rows)), max(1, round(EDGE * columns))


def outline(path: Path, image: np.ndarray | None = None) -> np.ndarray:
    """Where a photograph shows nothing, [H, W] bool, reduced by leaving pixels out.

    Args:
        path: Its file.
        image: Its pixels, [H, W, 3 or 4] uint8, where they are in memory anyway.
    """
    shape = image_shape(path) if image is None else image.shape
    if shape[2] == 3:
        return np.zeros(NO_ALPHA, dtype=bool)
    every = max(1, min(shape[:2]) // ROWS_LOOKED_AT)
    return shows_nothing((read_image(path) if image is None else image)[::every, ::every])


def shows_nothing(image: np.ndarray) -> np.ndarray:
    """Where an image is transparent.

    Args:
        image: [H, W, 3 or 4] uint8.

    Returns:
        [H, W] bool.
    """
    if image.shape[2] == 3:
        return np.zeros(image.shape[:2], dtype=bool)
    return np.asarray(image[..., 3] < OPAQUE)
