"""Images that others wrote, by what Pillow says their pixels are; none is believed to be whole."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import ExifTags, Image, ImageFile, TiffImagePlugin, UnidentifiedImageError

from warpnerf.checks import InputError
from warpnerf.scenes.files import require_regular_file

MAX_PIXELS = 2**27
"""134 megapixels: more than cameras make, less than a small file can be made to unpack to."""

# Named one by one, so that a file cannot choose a plugin that starts another program (EPS).
IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM")

EIGHT_BIT_MODES = ("1", "L", "P", "RGB", "YCbCr", "LA", "PA", "RGBA")
SIXTEEN_BIT_GRAY = ("I;16", "I;16L", "I;16B", "I;16N")
OTHER_BYTE = {
    mode + order: mode + other
    for mode in ("RGB;16", "RGBA;16")
    for order, other in (("L", "B"), ("B", "L"), ("N", "B" if sys.byteorder == "little" else "L"))
}
"""Raw modes of 16-bit colour, of which Pillow keeps one byte without a word, and those by which it
keeps the other byte: L, B and N stand for little-endian, big-endian and this machine's."""

OTHER_KINDS = {
    "a HEIC": rb".{4}ftyp(hei|hev|mif1|msf1)",
    "an AVIF": rb".{4}ftypavi",
    "a raw": rb".{4}ftypcrx",
    "a video": rb".{4}ftyp|\x1aE\xdf\xa3",
    "a JPEG XL": rb"\xff\x0a|\0\0\0\x0cJXL ",
    "a JPEG 2000": rb"\0\0\0\x0cjP  |\xff\x4f\xff\x51",
    "an OpenEXR": rb"v/1\x01",
    "an HTML": rb"\s*<(!doctype html|html)",
}
"""Files that may be called as photographs, by what they begin with."""

T = TypeVar("T")

TIFF_BITS = 258
ORIENTATION = 274


def read_image(path: Path) -> np.ndarray:
    """Read an image as 8-bit colour, its pixels as they are stored, without an EXIF rotation.

    What the pixels mean is decided by Pillow's mode, never by the count of channels. Gray becomes
    rgb, a palette its colours; 16 bits are rounded to 8.

    Returns:
        [H, W, 3] uint8 rgb, or [H, W, 4] uint8 rgb with straight alpha where the file has alpha.

    Raises:
        InputError: Not a regular file, not a whole image, or of a kind that 8-bit rgb cannot hold.
        MemoryError: It does not fit.
    """

    def pixels(image: ImageFile.ImageFile) -> np.ndarray:
        _check_kind(path, image)
        if _raw_mode(image) not in OTHER_BYTE:
            return _to_eight_bit(image)
        with Image.open(path, formats=IMAGE_FORMATS) as again:
            return _sixteen_bit_colour(image, again)

    return _read(path, pixels)


def read_values(path: Path) -> np.ndarray:
    """Read an image of one channel as the numbers that it stores.

    Returns:
        [H, W] integers of 8, 16 or 32 bits, or floats.

    Raises:
        InputError: Not a regular file, not a whole image, or not of one channel.
        MemoryError: It does not fit.
    """

    def values(image: ImageFile.ImageFile) -> np.ndarray:
        if image.width * image.height > MAX_PIXELS:
            raise _too_large(path)
        if image.mode not in ("L", "I", "F", *SIXTEEN_BIT_GRAY):
            raise InputError(f"{path}: its pixels are {image.mode}; save one channel of 16 bits.")
        return np.array(image)

    return _read(path, values)


def exif_orientation(path: Path) -> int:
    """How a photograph's EXIF says that it is to be turned for showing, 1 to 8; see ``read_image``.

    Returns:
        1, as it is stored, also where there is no EXIF, or none that can be read.
    """
    orientation = read_exif(path, lambda exif: exif.get(ORIENTATION, 1))
    return orientation if orientation is not None and orientation in range(1, 9) else 1


def read_exif(path: Path, look: Callable[[Image.Exif], T]) -> T | None:
    """What something finds in a photograph's EXIF; None where there is none that can be read."""
    try:
        # MPO, several JPEGs in a file, opens as JPEG. Where a PNG's EXIF does not stand before its
        # pixels, all of these would be decoded.
        with Image.open(path, formats=("JPEG", "WEBP", "PNG")) as image:
            if image.format == "PNG" and "exif" not in image.info:
                return None
            return look(image.getexif())
    except Exception:  # tags are damaged in more ways than Pillow has names for
        return None


def exif_focal_length(path: Path) -> tuple[float, bool] | None:
    """The focal length that a photograph's EXIF states, in millimetres, and whether it is that for
    film 36 mm wide, which a digital zoom changes as well; else it is the lens's own.

    None where it says none.
    """

    def look(exif: Image.Exif) -> tuple[float, bool] | None:
        details = exif.get_ifd(ExifTags.IFD.Exif)
        names = (ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.FocalLength)
        stated = ((float(details.get(name) or 0.0), name is names[0]) for name in names)
        return next((of for of in stated if 0.0 < of[0] < math.inf), None)

    return read_exif(path, look)


def says_equirectangular(path: Path) -> bool:
    """Whether a photograph's XMP says that it shows all directions: GPano's ProjectionType."""
    try:
        with Image.open(path, formats=("JPEG", "WEBP", "PNG")) as image:
            xmp = image.info.get("xmp") or image.info.get("XML:com.adobe.xmp") or b""
    except Exception:  # damaged, which is told where it is read
        return False
    text = xmp if isinstance(xmp, bytes) else str(xmp).encode()
    return b"ProjectionType" in text and b"equirectangular" in text


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, pixels as they are stored, without reading these.

    Args:
        path: Of the image.

    Returns:
        Pixels in a row, rows.

    Raises:
        InputError: Not a regular file, or no image.
    """
    return _read(path, lambda image: image.size)


def image_shape(path: Path) -> tuple[int, int, int]:
    """The shape of what ``read_image`` returns, without reading the pixels.

    Raises:
        InputError: As ``read_image``, but for damage that only the pixels have.
    """

    def shape(image: ImageFile.ImageFile) -> tuple[int, int, int]:
        _check_kind(path, image)
        return image.height, image.width, 4 if _has_alpha(image) else 3

    return _read(path, shape)


def box_filter(image: np.ndarray, factor: int) -> np.ndarray:
    """Average an image over blocks of ``factor`` by ``factor`` pixels, rounded to nearest.

    Colour is weighted by alpha, so that what is behind transparent pixels does not bleed in.

    Args:
        image: [H, W, 3] or [H, W, 4] uint8, straight alpha.
        factor: Edge of a block; pixels at the right and bottom that fill none are cropped.

    Returns:
        [H // factor, W // factor, 3 or 4] uint8, straight alpha.
    """
    height, width, channels = image.shape[0] // factor, image.shape[1] // factor, image.shape[2]
    blocks = image[: height * factor, : width * factor].reshape(
        height, factor, width, factor, channels
    )
    if channels == 3:
        return _divide(blocks.sum(axis=(1, 3), dtype=np.uint64), factor**2)
    alpha = blocks[..., 3:].astype(np.uint64)
    total = alpha.sum(axis=(1, 3))
    rgb = _divide((blocks[..., :3] * alpha).sum(axis=(1, 3)), np.maximum(total, 1))
    return np.concatenate([rgb, _divide(total, factor**2)], axis=2)


def _divide(total: np.ndarray, count: np.ndarray | int) -> np.ndarray:
    divisor = np.asarray(count, dtype=np.uint64)
    return ((total + divisor // np.uint64(2)) // divisor).astype(np.uint8)


def require_whole_image(path: Path) -> None:
    """Decode an image, as roughly as that can be done, and forget it.

    Args:
        path: Of the image.

    Raises:
        InputError: Not a regular file, not a whole image, or of a kind that ``read_image`` refuses.
    """

    def decode(image: ImageFile.ImageFile) -> None:
        _check_kind(path, image)
        image.draft("L", (max(image.width // 8, 1), max(image.height // 8, 1)))
        image.load()

    _read(path, decode)


def _read(path: Path, look: Callable[[ImageFile.ImageFile], T]) -> T:
    """What something finds in an image, whose defects are all told in one way."""
    require_regular_file(path)
    _refuse_pointer(path)
    Image.init()  # else a format whose plugin is not loaded yet is a KeyError
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            return look(image)
    except (InputError, MemoryError):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise _too_large(path) from None
    except UnidentifiedImageError:
        known = ", ".join(IMAGE_FORMATS)
        kind = _other_kind(path)
        said = f"is {kind} file, and no" if kind else "is not an"
        damaged = "" if kind else ", or is damaged at its start"
        raise InputError(
            f"{path}: {said} image in a known format ({known}){damaged}; convert it to PNG or "
            "JPEG, or copy it again."
        ) from None
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise InputError(
            f"{path}: is cut short or damaged ({error or type(error).__name__}); copy it again."
        ) from None


def _refuse_pointer(path: Path) -> None:
    """Name the file that most often stands where an image should."""
    try:
        with path.open("rb") as file:
            start = file.read(1)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; change that, or name another file."
        ) from None
    if not start:
        raise InputError(f"{path}: is empty (0 bytes); copy it again.")


def _other_kind(path: Path) -> str:
    """What a file is that is no image in a known format, where that is known; else empty."""
    with path.open("rb") as file:
        start = file.read(64)
    return next((k for k, p in OTHER_KINDS.items() if re.match(p, start, re.I | re.S)), "")


def _check_kind(path: Path, image: ImageFile.ImageFile) -> None:
    """Refuse what would be read as something else than it shows; the pixels are not decoded yet."""
    if image.width * image.height > MAX_PIXELS:
        raise _too_large(path)
    # MPO is how phones store one photograph with a preview or a depth map behind it.
    if getattr(image, "is_animated", False) and image.format != "MPO":
        raise InputError(f"{path}: holds several frames; save the one to use as PNG or JPEG.")
    if image.format == "TIFF" and image.getexif().get(ORIENTATION, 1) != 1:
        raise InputError(f"{path}: carries a rotation tag, which Pillow obeys; save it as PNG.")
    raw = _raw_mode(image)
    if raw in SIXTEEN_BIT_GRAY or (raw in OTHER_BYTE and "transparency" not in image.info):
        return
    if image.mode in EIGHT_BIT_MODES and ";16" not in raw and not _is_deep_tiff(image):
        return
    name = f"16-bit {image.mode}" if image.mode in EIGHT_BIT_MODES else image.mode
    raise InputError(f"{path}: its pixels are {name}; convert it to 8-bit RGB or RGBA.")


def _raw_mode(image: ImageFile.ImageFile) -> str:
    """How the pixels lie in the file, in Pillow's words; empty where it does not say."""
    arguments: Any = image.tile[0][3] if image.tile else ""
    if isinstance(arguments, tuple):
        arguments = arguments[0] if arguments else ""
    return str(arguments)


def _is_deep_tiff(image: ImageFile.ImageFile) -> bool:
    """Whether a TIFF has more than 8 bits per channel: one by planes is read as if it had not."""
    return (
        isinstance(image, TiffImagePlugin.TiffImageFile)
        and max(image.tag_v2.get(TIFF_BITS, (8,))) > 8
    )


def _sixteen_bit_colour(image: ImageFile.ImageFile, again: ImageFile.ImageFile) -> np.ndarray:
    """16-bit colour, from reading the file twice: one byte of each value, then the other."""
    again.tile = [tile._replace(args=_other_byte(tile.args)) for tile in again.tile]
    first, second = np.asarray(image, np.uint32), np.asarray(again, np.uint32)
    return _rounded(256 * first + second)


def _other_byte(arguments: Any) -> Any:
    if isinstance(arguments, tuple):
        return (OTHER_BYTE[arguments[0]], *arguments[1:])
    return OTHER_BYTE[arguments]


def _has_alpha(image: Image.Image) -> bool:
    return image.mode in EIGHT_BIT_MODES and image.has_transparency_data


def _to_eight_bit(image: Image.Image) -> np.ndarray:
    image.load()
    if image.mode in EIGHT_BIT_MODES:
        return np.array(image.convert("RGBA" if _has_alpha(image) else "RGB"))
    return np.repeat(_rounded(np.asarray(image, np.uint32))[:, :, None], 3, axis=2)


def _rounded(values: np.ndarray) -> np.ndarray:
    """16 bits to 8: the ends stay the ends."""
    return ((values + 128) // 257).astype(np.uint8)


def _too_large(path: Path) -> InputError:
    limit = MAX_PIXELS // 10**6
    return InputError(f"{path}: has more than {limit} million pixels; scale it down first.")
