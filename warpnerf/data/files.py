"""Reading files that others wrote: nothing here trusts a path, a size or a number in them."""

from __future__ import annotations

import json
import os
import stat
from collections import Counter
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

import msgspec
import numpy as np
from PIL import Image, ImageFile, UnidentifiedImageError

from warpnerf.checks import InputError

T = TypeVar("T")

MAX_JSON_BYTES = 256 * 2**20
MAX_PIXELS = 2**27
"""134 megapixels: more than cameras make, less than a small file can be made to unpack to."""

# Named one by one, so that a file cannot choose a plugin that starts another program (EPS).
IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "GIF", "PPM")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Tried in this order where a scene file leaves the extension out."""

EIGHT_BIT_MODES = ("1", "L", "P", "RGB", "YCbCr", "LA", "PA", "RGBA")
SIXTEEN_BIT_MODES = ("I;16", "I;16L", "I;16B", "I;16N")
TIFF_ORIENTATION = 274


def read_json(path: Path, schema: type[T]) -> T:
    """Read a JSON file into a msgspec structure.

    A byte-order mark is accepted. NaN, Infinity, a key given twice and brackets too deep to parse
    are not.

    Raises:
        InputError: The file cannot be read, is not JSON, or does not fit the structure.
    """
    _require_regular_file(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise InputError(f"{path}: larger than {MAX_JSON_BYTES >> 20} MiB, so no scene file.")
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}.") from None
    if not text.strip():
        raise InputError(f"{path}: is empty; copy or export it again.")
    try:
        # The standard parser, because msgspec's takes the last of two equal keys.
        tree = json.loads(
            text,
            object_pairs_hook=_distinct_keys,
            parse_constant=_refuse_constant,
            parse_int=_parse_int,
        )
        return msgspec.convert(tree, schema)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {_as_clause(str(error))}; correct or add that field.") from None
    except RecursionError:
        raise InputError(f"{path}: brackets nested too deeply; export the file again.") from None
    except UnicodeDecodeError:
        raise InputError(f"{path}: is not text in UTF-8; export it as JSON in UTF-8.") from None
    except ValueError as error:
        raise InputError(f"{path}: is not valid JSON: {error}; correct it there.") from None


def _distinct_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {twice!r} is given twice in one object")
    return table


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number that JSON allows")


def _parse_int(text: str) -> int:
    if len(text) > 300:  # no float: older msgspec fails on it instead of refusing it
        raise ValueError(f"a number of {len(text)} digits is out of range")
    return int(text)


def _as_clause(message: str) -> str:
    """Make msgspec's message part of a sentence; it leaves out the place when that is the top."""
    if " - at `" not in message:
        message += " - at `$`"
    return message[0].lower() + message[1:].replace(" - at ", ", at ")


def exists(path: Path) -> bool:
    """Whether something is there; false, not an error, where that cannot be found out."""
    return os.path.exists(path)  # noqa: PTH110, whose way out raises


def resolve_inside(folder: Path, relative: str, *, field: str) -> Path:
    r"""Join a path out of a scene file to the scene's folder.

    Separators may be / or \. An absolute path is accepted where it points into the folder. The
    result need not exist.

    Args:
        folder: The scene's folder.
        relative: The path as the scene file has it.
        field: File and field that the path comes from, for the message.

    Raises:
        InputError: The path leaves the folder: by .., by being absolute, or through a link.
    """
    text = relative.replace("\\", "/")
    quoted = json.dumps(relative[:200])
    if not text or "\0" in text:
        raise InputError(f"{field}: {quoted} is not a path; name a file in the scene's folder.")
    try:
        if Path(text).is_absolute():
            text = os.path.relpath(text, Path.cwd() / folder)
        inside = os.path.normpath(text).replace("\\", "/")
        outside = PureWindowsPath(inside).drive or inside == ".." or inside.startswith(("../", "/"))
        path = folder / inside
        root, target = os.path.realpath(folder), os.path.realpath(path)
        linked = not outside and os.path.commonpath([root, target]) != root
    except ValueError:  # half a surrogate pair, or another drive
        raise InputError(f"{field}: {quoted} is not a path; name a file that exists.") from None
    if outside or linked:
        how = "follows a link out of" if linked else "leaves"
        raise InputError(
            f"{field}: {quoted} {how} the scene's folder {folder}; copy the file into that folder."
        )
    return path


def find_image(folder: Path, file_path: str, *, field: str) -> Path | None:
    """Find the image that a frame names, adding an extension where the frame leaves it out.

    Returns:
        The image's path inside the folder, or None where there is no such file.

    Raises:
        InputError: The path leaves the folder.
    """
    for suffix in ("", *IMAGE_SUFFIXES):
        path = resolve_inside(folder, file_path + suffix, field=field)
        if os.path.isfile(path):  # noqa: PTH113, never raises
            return path
    path = resolve_inside(folder, file_path, field=field)
    return path if exists(path) else None


def read_image(path: Path) -> np.ndarray:
    """Read an image as 8-bit colour, its pixels as they are stored, without an EXIF rotation.

    What the pixels mean is decided by Pillow's mode, never by the count of channels. Gray becomes
    rgb, a palette its colours, 16-bit gray is scaled to 8 bit.

    Returns:
        [H, W, 3] uint8 rgb, or [H, W, 4] uint8 rgb with straight alpha where the file has alpha.

    Raises:
        InputError: Not a regular file, not a whole image, or of a kind that 8-bit rgb cannot hold.
    """
    _require_regular_file(path)
    _refuse_pointer(path)
    Image.init()  # else a format whose plugin is not loaded yet is a KeyError
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            _check_kind(path, image)
            image.load()
            return _to_eight_bit(image)
    except InputError:
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise _too_large(path) from None
    except UnidentifiedImageError:
        known = ", ".join(IMAGE_FORMATS)
        raise InputError(
            f"{path}: is not an image in a known format ({known}); convert it to PNG or JPEG."
        ) from None
    except Exception as error:  # decoders raise nearly anything on a damaged file
        raise InputError(
            f"{path}: is cut short or damaged ({error or type(error).__name__}); copy it again."
        ) from None


def _require_regular_file(path: Path) -> None:
    """Refuse folders, and pipes and devices, which would block or never end."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError) as error:
        why = "does not exist" if isinstance(error, FileNotFoundError) else f"{error}"
        raise InputError(f"{path}: cannot be read: {why}.") from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise InputError(f"{path}: is {kind}, not a file; name a file.")


def _refuse_pointer(path: Path) -> None:
    """Name the two files that most often stand where an image should."""
    try:
        with path.open("rb") as file:
            start = file.read(24)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror or error}.") from None
    if not start:
        raise InputError(f"{path}: is empty (0 bytes); copy it again.")
    if start.startswith(b"version https://git-lfs"):
        raise InputError(f"{path}: is a Git LFS pointer, not an image; run `git lfs pull`.")


def _check_kind(path: Path, image: ImageFile.ImageFile) -> None:
    """Refuse what would be read as something else than it shows; the pixels are not decoded yet."""
    if image.width * image.height > MAX_PIXELS:
        raise _too_large(path)
    # MPO is how phones store one photograph with a preview or a depth map behind it.
    if getattr(image, "is_animated", False) and image.format != "MPO":
        raise InputError(f"{path}: holds several frames; save the one to use as PNG or JPEG.")
    if image.format == "TIFF" and image.getexif().get(TIFF_ORIENTATION, 1) != 1:
        raise InputError(f"{path}: carries a rotation tag, which Pillow obeys; save it as PNG.")
    if image.mode in SIXTEEN_BIT_MODES or (image.mode == "I" and _stored_in_16_bits(image)):
        return
    if image.mode in EIGHT_BIT_MODES and not _stored_in_16_bits(image):
        return
    name = f"16-bit {image.mode}" if image.mode in EIGHT_BIT_MODES else image.mode
    raise InputError(f"{path}: its pixels are {name}; convert it to 8-bit RGB or RGBA.")


def _stored_in_16_bits(image: ImageFile.ImageFile) -> bool:
    """Whether the file has 16 bits per channel; of colour, Pillow drops half without a word."""
    return any(";16" in str(tile[3]) for tile in image.tile)


def _to_eight_bit(image: Image.Image) -> np.ndarray:
    if image.mode in EIGHT_BIT_MODES:
        return np.array(image.convert("RGBA" if image.has_transparency_data else "RGB"))
    gray = np.asarray(image).astype(np.uint32)
    eight = ((gray * 255 + 32767) // 65535).astype(np.uint8)
    return np.repeat(eight[:, :, None], 3, axis=2)


def _too_large(path: Path) -> InputError:
    limit = MAX_PIXELS // 10**6
    return InputError(f"{path}: has more than {limit} million pixels; scale it down first.")
