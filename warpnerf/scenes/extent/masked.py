"""What masks leave of photographs, and whether that is what the cameras look at."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import find_focus
from warpnerf.scenes.images.masks import Mask, PackedMask

LITTLE = 0.1
"""Share of the pixels that masks leave, below which they are likely to be inverted."""
HALF = 0.5
"""The same, where they ignore what the cameras look at: masks of an object leave that, if little
else, and inverted ones of people who walk by do not."""
FEW = 0.1
"""Share of the masks, at most, that leave it where all of them leave more: of nearly all images."""
SEVERAL = 3
"""Masks, at least, of which one should ignore something."""

Masks = list[PackedMask | None]
"""Of all views; None: all pixels count."""


def mask_notes(masks: Masks, cameras: Sequence[Camera]) -> list[str]:
    """That there are masks, and what they leave.

    Args:
        masks: Of these cameras' photographs.
        cameras: Of all views.
    """
    masked = sum(mask is not None for mask in masks)
    if not masked:
        return []
    return [
        f"{masked} of {len(masks)} images have pixels that are ignored; "
        f"{_share_kept(masks, cameras):.1%} of all pixels count"
    ]


def idle_masks(given: Sequence[Mask], left: Masks) -> list[str]:
    """A warning of masks of which none ignores a pixel.

    Args:
        given: That were read.
        left: What they leave of the photographs; None: all pixels.
    """
    if len(given) < SEVERAL or any(mask is not None for mask in left):
        return []
    return [
        f"masks ignore no pixel: none of {len(given)} has one that is black (first: "
        f"{given[0].path.name}); write 0 where pixels are to be ignored, or remove them"
    ]


def inverted_masks(masks: Masks, cameras: Sequence[Camera], training: Sequence[int]) -> list[str]:
    """Detect inverted masks, by how much they leave and by whether the common focus is part of it.

    Args:
        masks: Of these cameras' photographs.
        cameras: Of all views.
        training: Indices of those that tell the focus.

    Returns:
        A warning, or none.
    """
    share = _share_kept(masks, cameras)
    if share >= LITTLE:
        focus = _share_of_focus(masks, cameras, training)
        if focus > HALF or (share >= HALF and (focus > FEW or not _are_around(masks))):
            return []
    return [
        f"masks leave {share:.1%} of the pixels"
        + ("" if share < LITTLE else ", and in few images a point that most cameras look at")
        + ": white ones count, black ones are ignored, so invert the masks if they are the other "
        "way round"
    ]


def _share_kept(masks: Masks, cameras: Sequence[Camera]) -> float:
    pixels = [camera.width * camera.height for camera in cameras]
    kept = (n if mask is None else mask.count for n, mask in zip(pixels, masks, strict=True))
    return sum(kept) / sum(pixels)


def _share_of_focus(masks: Masks, cameras: Sequence[Camera], training: Sequence[int]) -> float:
    """The share of masks that leave the point that most cameras look at; 1 where there is none."""
    try:
        focus = find_focus([cameras[i] for i in training])
    except InputError:
        return 1.0
    if focus.guessed:
        return 1.0
    kept = [
        _leaves(mask, camera, focus.point)
        for mask, camera in zip(masks, cameras, strict=True)
        if mask is not None
    ]
    return float(np.mean(kept)) if kept else 1.0


def _are_around(masks: Masks) -> bool:
    """Whether nearly all images have masks that leave their corners, as of what is around an
    object."""
    corners = [0, 0, -1, -1], [0, -1, 0, -1]
    kept = sum(mask is not None and bool(mask.read()[corners].all()) for mask in masks)
    return kept >= (1.0 - FEW) * len(masks)


def _leaves(mask: PackedMask, camera: Camera, point: np.ndarray) -> bool:
    """Whether the pixel that shows a point [3] counts; distortion is left out of account."""
    x, y, z = (point - camera.position) @ camera.c2w[:, :3]
    if not z < 0.0:
        return False
    row, column = camera.cy + camera.fy * y / z, camera.cx - camera.fx * x / z
    inside = 0.0 <= row < camera.height and 0.0 <= column < camera.width
    return inside and bool(mask.read()[int(row), int(column)])
