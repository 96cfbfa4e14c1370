"""Pictures for people: PNG files, depth in colour, renderings beside the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpnerf.atomic import write_bytes
from warpnerf.checks import InputError

DEPTH_STOPS = np.array(
    [
        [0.48, 0.04, 0.06],  # near: dark red
        [0.86, 0.25, 0.12],
        [0.98, 0.55, 0.18],
        [0.95, 0.82, 0.27],
        [0.62, 0.93, 0.35],
        [0.22, 0.88, 0.62],
        [0.16, 0.66, 0.90],
        [0.25, 0.40, 0.86],
        [0.19, 0.10, 0.38],  # far: indigo
    ]
)
"""Colours of depth from near to far, evenly spaced, rgb in [0, 1]: a rainbow with dark ends."""

MIN_OPACITY = 0.5
"""Pixels below show the background, so they have no depth."""


def write_png(path: Path, rgb: np.ndarray, description: str = "") -> None:
    """Write an image; it is replaced as a whole or not at all.

    Args:
        path: Where to; its folder exists.
        rgb: [H, W, 3] in [0, 1]; what lies beyond is clipped.
        description: Kept in the file, as its text "Description".

    Raises:
        InputError: It is no such image, or holds NaN.
        OSError: The file cannot be written.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3 or not rgb.size:
        raise InputError(f"{path}: rgb must be [H, W, 3], not {list(rgb.shape)}.")
    if not np.isfinite(rgb).all():
        raise InputError(f"{path}: rgb must be finite, but holds NaN or infinity.")
    import imageio.v3 as iio
    from PIL.PngImagePlugin import PngInfo

    text = PngInfo()
    if description:
        text.add_text("Description", description)
    pixels = np.round(np.clip(rgb, 0.0, 1.0) * 255.0).astype(np.uint8)
    content = iio.imwrite("<bytes>", pixels, extension=".png", plugin="pillow", pnginfo=text)
    write_bytes(path, content)


def depth_colours(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth in colour: near is red, far is blue; what lies beyond either has its colour.

    Args:
        depth: [...], scene units.
        near: Distance of the first colour, scene units.
        far: Distance of the last, above ``near``.

    Returns:
        [..., 3] rgb in [0, 1].

    Raises:
        InputError: The range is empty or not finite.
    """
    if not (near < far and np.isfinite([near, far]).all()):
        raise InputError(f"the range of depth must have near below far, not {near} and {far}.")
    stops = np.linspace(near, far, len(DEPTH_STOPS))
    return np.stack([np.interp(depth, stops, channel) for channel in DEPTH_STOPS.T], axis=-1)


def comparison(
    truth: np.ndarray,
    rgb: np.ndarray,
    depth: np.ndarray,
    opacity: np.ndarray,
    *,
    near: float,
    far: float,
) -> np.ndarray:
    """One image: truth | rendering | depth in colour, white where the background shows.

    Args:
        truth: [H, W, 3] in [0, 1].
        rgb: [H, W, 3] in [0, 1].
        depth: [H, W], sum of weight times t, scene units.
        opacity: [H, W] in [0, 1].
        near: Distance of the first colour, scene units.
        far: Distance of the last.

    Returns:
        [H, 3 W, 3] in [0, 1].
    """
    opaque = opacity >= MIN_OPACITY
    mean_depth = depth / np.maximum(opacity, MIN_OPACITY)  # of what is not background
    coloured = np.where(opaque[..., None], depth_colours(mean_depth, near, far), 1.0)
    return np.concatenate([truth, rgb, coloured], axis=1)
