"""What transparent pixels of photographs mean: nothing around an object, or nothing known.

An object that stands free has them around it. Undistortion, too, leaves them, at the edges of a
picture, and resampling a few that are almost opaque. What a scene is must not follow from these.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

FREE = 0.15
"""Share of transparent pixels from which on photographs are taken for those of an object."""
FEW = 0.02
"""Share below which they are not."""
ALIKE = 0.8
"""In between, an object does not have so much of its transparent pixels in common in all views: its
outline changes, that of a lens does not."""
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
    if not FEW <= share < FREE:
        return share >= FREE
    shapes = {image.shape for image in transparent}
    always = np.mean(
        [
            np.logical_and.reduce([image for image in transparent if image.shape == shape]).mean()
            for shape in shapes
        ]
    )
    return bool(always < ALIKE * np.mean(shares))


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
