"""Pictures to look at: renderings beside the truth, depth in colour."""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from warpnerf.rendering.field import Rendering
from warpnerf.writing import write_atomically

_COLOURS = (
    "ffef6d fdd654 febe3e fea430 fc8b2e f67337 ec5b47 de4656 cd3365"
    " b92372 a2167c 8a0d84 700888 560585 3d047a 260667 14094e"
)
"""Near to far, sRGB: yellow, orange, red, purple, dark blue. Our own: points of a curve that gets
darker all along, at equal distances in OKLab, where equal distances look equal (Ottosson 2020,
https://bottosson.github.io/posts/oklab)."""

DISPARITY_FROM = 5.0
"""Times the near depth: a range whose far depth lies beyond gets its colours by 1 / depth, as most
of what is seen of unbounded space lies in the nearest part of it."""

_GAP = 4
_LONGEST_STEM = 200
PHOTOGRAPH = re.compile(r"\.(?:jpe?g|png|tiff?|bmp|webp|heic|exr|dng)$", re.IGNORECASE)
"""Endings of photographs' names."""

INK, FAINT = (30, 30, 34), (120, 120, 128)
"""Of text, and of what is less important; sRGB of 8 bits."""

_DRAWN = "«»°±“”"
"""What the typeface has besides ASCII."""
_WITHOUT_PARTS = str.maketrans(
    {"ß": "ss", "æ": "ae", "Æ": "AE", "œ": "oe", "Œ": "OE", "ø": "o", "Ø": "O", "ł": "l", "Ł": "L"}
)
"""Letters that are no others with an accent."""


def depth_colours(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth colour map: bright yellow is near, dark blue is far.

    Equal steps of depth look equal; where far > DISPARITY_FROM near > 0, equal steps of 1 / depth.

    Args:
        depth: [H, W], scene units.
        near: What gets the first colour, scene units.
        far: What gets the last.

    Returns:
        [H, W, 3] in [0, 1].
    """
    table = np.array([list(bytes.fromhex(colour)) for colour in _COLOURS.split()]) / 255.0
    x = np.clip(_shares(depth, near, far), 0.0, 1.0)
    stops = np.linspace(0.0, 1.0, len(table))
    return np.stack([np.interp(x, stops, table[:, c]) for c in range(3)], axis=-1)


def _by_disparity(near: float, far: float) -> bool:
    """Whether colours go by 1 / depth."""
    return far > DISPARITY_FROM * near > 0.0


def _shares(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Where depths lie among the colours: 0 for near, 1 for far, or outside of it."""
    if _by_disparity(near, far):
        return (1.0 / near - 1.0 / np.maximum(depth, 1e-3 * near)) / (1.0 / near - 1.0 / far)
    return (depth - near) / max(far - near, 1e-12)


def depth_picture(rendering: Rendering, near: float, far: float) -> np.ndarray:
    """Depth of what is seen, in colour; it fades to white where nothing is.

    Args:
        rendering: [H, W].
        near: Depth of the first colour, scene units.
        far: Depth of the last.

    Returns:
        [H, W, 3] in [0, 1].
    """
    opacity = rendering.opacity[..., None]
    surface = rendering.depth / np.maximum(rendering.opacity, 1e-6)
    return opacity * depth_colours(surface, near, far) + (1.0 - opacity)


def dimmed(rgb: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """An image [H, W, 3] in [0, 1], pale where a mask [H, W] is false; None: as it is."""
    return rgb if mask is None else np.where(mask[..., None], rgb, 0.25 * rgb + 0.7)


def comparison(
    target: np.ndarray,
    rendering: Rendering,
    near: float,
    far: float,
    mask: np.ndarray | None = None,
) -> np.ndarray:
    """Truth, rendering and depth side by side, above a legend of the depths' colours.

    Args:
        target: [H, W, 3] in [0, 1].
        rendering: Of the same size.
        near: Depth of the first colour, scene units.
        far: Depth of the last.
        mask: [H, W] bool; the truth is pale where it is false.

    Returns:
        [H + legend, 3 W + 8, 3] uint8.
    """
    return above_legend(
        [dimmed(target, mask), rendering.rgb, depth_picture(rendering, near, far)], near, far
    )


def colour_and_depth(rendering: Rendering, near: float, far: float) -> np.ndarray:
    """Colour and depth side by side, above a legend of the depths' colours.

    Args:
        rendering: [H, W].
        near: Depth of the first colour, scene units.
        far: Depth of the last.

    Returns:
        [H + legend, 2 W + 4, 3] uint8.
    """
    return above_legend([rendering.rgb, depth_picture(rendering, near, far)], near, far)


def above_legend(
    panels: Sequence[np.ndarray], near: float | None = None, far: float | None = None
) -> np.ndarray:
    """Concatenate panels side by side, above a legend of depths.

    Args:
        panels: [H, W, C] each, uint8 or in [0, 1]; a fourth channel is alpha.
        near: Depth of the first colour, scene units; None: without a legend.
        far: Depth of the last.

    Returns:
        [H + legend, n W + 4 (n - 1), C] uint8.
    """
    pixels = [to_bytes(panel) for panel in panels]
    height, channels = pixels[0].shape[0], pixels[0].shape[2]
    gap = np.full((height, _GAP, channels), 255, np.uint8)
    parts = [part for panel in pixels for part in (gap, panel)][1:]
    picture = np.concatenate(parts, axis=1)
    if near is None or far is None:
        return picture
    legend = depth_legend(picture.shape[1], near, far)
    opaque = np.full((*legend.shape[:2], channels - 3), 255, np.uint8)
    return np.concatenate([picture, np.concatenate([legend, opaque], axis=2)])


def depth_legend(width: int, near: float, far: float) -> np.ndarray:
    """A strip that says which colour is which depth, with depths between where they are uneven.

    Args:
        width: Of the strip, pixels.
        near: Depth of the first colour, scene units.
        far: Depth of the last.

    Returns:
        [height, width, 3] uint8; the height follows from the width and from whether colours go by
        1 / depth.
    """
    uneven = _by_disparity(near, far)
    size = int(np.clip(width / 36, 8, 20))
    height = (3 if uneven else 2) * size
    strip = Image.new("RGB", (width, height), "white")
    draw = ImageDraw.Draw(strip)
    type_face = font(size)
    words = [f"{near:.3g}", f"{far:.3g} scene units"]
    if width >= 16 * size:
        words[0] = f"depth {words[0]}"
    left, right = (draw.textlength(word, type_face) + size for word in words)
    n_columns = max(1, int(width - left - right))
    bar = np.linspace(near, far, n_columns)[None]
    if uneven:
        bar = 1.0 / np.linspace(1.0 / near, 1.0 / far, n_columns)[None]
    colours = np.round(255.0 * depth_colours(bar, near, far)).astype(np.uint8)
    strip.paste(Image.fromarray(np.repeat(colours, size, axis=0)), (int(left), size // 2))
    draw.text((left - size / 2, size), words[0], INK, type_face, anchor="rm")
    draw.text((width - right + size / 2, size), words[1], INK, type_face, anchor="lm")
    if uneven:
        free = 0.0  # where the next number may begin
        for depth in _round_depths(near, far):
            at = left + float(_shares(np.array(depth), near, far)) * n_columns
            half = 0.5 * draw.textlength(f"{depth:g}", type_face)
            if at - half >= max(free, left) and at + half <= left + n_columns:
                draw.line((at, 1.5 * size, at, 1.75 * size), INK)
                draw.text((at, 2.3 * size), f"{depth:g}", INK, type_face, anchor="mm")
                free = at + half + size
    return np.asarray(strip)


def _round_depths(near: float, far: float) -> list[float]:
    """1, 2 and 5 times powers of ten between two depths above 0, scene units."""
    powers = range(math.floor(math.log10(near)), math.ceil(math.log10(far)) + 1)
    depths = [float(f"{digit}e{power}") for power in powers for digit in (1, 2, 5)]
    return [depth for depth in depths if near < depth < far]


def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The typeface of our pictures, that Pillow brings along, in a size in pixels."""
    return ImageFont.load_default(size)


def drawable(text: str) -> str:
    """A text in letters that the typeface of our pictures has.

    It has no accents and one alphabet: letters are drawn without accents, and ? for all others.

    Args:
        text: Any, such as a scene's or a photograph's name.
    """
    plain = unicodedata.normalize("NFKD", text.translate(_WITHOUT_PARTS))
    letters = (letter for letter in plain if not unicodedata.combining(letter))
    return "".join(c if " " <= c <= "~" or c in _DRAWN else "?" for c in letters)


def picture_files(names: Sequence[str], *, stems: bool = False) -> dict[str, str]:
    """File names for pictures of views, all in one folder: no two alike, none too long.

    They are the views' own names, with _ for /; where that makes two alike, or alike but for
    capitals, which some file systems do not tell apart, a number is added.

    Args:
        names: Of views, different from one another.
        stems: Without the endings of photographs: a.png for a.jpg, and not a.jpg.png.
    """
    taken: set[str] = set()
    files = {}
    for name in names:
        flat = re.sub(r"[/\\]", "_", name).removesuffix(".png")
        if stems:
            flat = PHOTOGRAPH.sub("", flat) or flat
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
    """Write an image as an 8-bit PNG, whole or not at all.

    Args:
        path: Of the file; its folder exists.
        rgb: [H, W, 3] uint8, or in [0, 1].

    Raises:
        OSError: It cannot be written.
    """
    write_atomically(path, png(rgb))


def png(rgb: np.ndarray, software: str = "") -> bytes:
    """The PNG file of an image [H, W, 3] uint8, or in [0, 1], that names what made it."""
    buffer, told = BytesIO(), PngInfo()
    if software:
        told.add_text("Software", software)
    Image.fromarray(to_bytes(rgb)).save(buffer, "PNG", pnginfo=told)
    return buffer.getvalue()


def to_bytes(rgb: np.ndarray) -> np.ndarray:
    """An image [H, W, 3] in [0, 1], clipped and rounded, or uint8 already, as uint8."""
    if rgb.dtype == np.uint8:
        return rgb
    return np.round(255.0 * np.clip(rgb, 0.0, 1.0)).astype(np.uint8)
