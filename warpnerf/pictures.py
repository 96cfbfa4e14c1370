"""Pictures to look at: renderings beside the truth, depth in colour."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np

from warpnerf.checkpoint import write_atomically
from warpnerf.field import Rendering

# Near to far: dark red, orange, yellow, green, blue, dark violet; brightness peaks in the middle.
_STOPS = np.array([0.0, 0.15, 0.32, 0.5, 0.68, 0.85, 1.0])
_COLOURS = np.array(
    [
        [0.45, 0.02, 0.05],
        [0.86, 0.24, 0.10],
        [0.98, 0.66, 0.20],
        [0.86, 0.95, 0.45],
        [0.20, 0.75, 0.70],
        [0.20, 0.40, 0.80],
        [0.18, 0.10, 0.40],
    ]
)
_GAP = 4
_LONGEST_STEM = 200


def depth_colours(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth as colour: red is near, violet is far.

    Args:
        depth: [H, W], scene units.
        near: What gets the first colour, scene units.
        far: What gets the last.

    Returns:
        [H, W, 3] in [0, 1].
    """
    x = np.clip((depth - near) / max(far - near, 1e-12), 0.0, 1.0)
    return np.stack([np.interp(x, _STOPS, _COLOURS[:, c]) for c in range(3)], axis=-1)


def comparison(target: np.ndarray, rendering: Rendering, near: float, far: float) -> np.ndarray:
    """Truth, rendering and depth side by side; depth fades to white where nothing is.

    Args:
        target: [H, W, 3] in [0, 1].
        rendering: Of the same size.
        near: Depth of the first colour, scene units.
        far: Depth of the last.

    Returns:
        [H, 3 W + 8, 3] in [0, 1].
    """
    opacity = rendering.opacity[..., None]
    surface = rendering.depth / np.maximum(rendering.opacity, 1e-6)
    depth = opacity * depth_colours(surface, near, far) + (1.0 - opacity)
    gap = np.ones((target.shape[0], _GAP, 3))
    return np.concatenate([target, gap, np.clip(rendering.rgb, 0, 1), gap, depth], axis=1)


def picture_files(names: Sequence[str]) -> dict[str, str]:
    """File names for pictures of views, all in one folder: no two alike, none too long.

    They are the views' own names, with _ for /; where that makes two alike, or alike but for
    capitals, which some file systems do not tell apart, a number is added.

    Args:
        names: Of views, different from one another.
    """
    taken: set[str] = set()
    files = {}
    for name in names:
        flat = re.sub(r"[/\\]", "_", name).removesuffix(".png")
        # From the end, where numbers are; in bytes, which is what file systems count.
        stem = flat.encode(errors="replace")[-_LONGEST_STEM:].decode(errors="replace")
        file, count = f"{stem}.png", 1
        while file.casefold() in taken:
            count += 1
            file = f"{stem}_{count}.png"
        taken.add(file.casefold())
        files[name] = file
    return files


def write_png(path: str | Path, rgb: np.ndarray) -> None:
    """Write an image [H, W, 3] in [0, 1] as an 8-bit PNG.

    Raises:
        OSError: It cannot be written.
    """
    import imageio.v3 as imageio

    buffer = BytesIO()
    pixels = np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
    imageio.imwrite(buffer, pixels, extension=".png")
    write_atomically(path, buffer.getvalue())
