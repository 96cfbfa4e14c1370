"""JSON and paths that others wrote: nothing here trusts a path, a size or a number in them.

Their images are read in ``images``, as distrustfully.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path, PureWindowsPath
from typing import Any, TypeVar

import msgspec

from warpnerf.checks import InputError

T = TypeVar("T")

MAX_JSON_BYTES = 256 * 2**20
MAX_DIGITS = 300
"""Of an integer: no float holds more."""

ARCHIVES = (".zip", ".r3d", ".tar", ".gz", ".tgz", ".7z", ".rar")
"""As which captures are shared: Record3D's .r3d, and what the others export."""

POINTER = b"version https://git-lfs"
MAX_POINTER_BYTES = 1024
"""How files begin that stand for those of Git LFS, and how large they are at most."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
"""Tried in this order where a scene file leaves the extension out."""

ENDINGS = (*IMAGE_SUFFIXES, ".webp", ".tif", ".tiff", ".bmp", ".ppm")
"""Of photographs that are read, lower case."""
UNREAD_ENDINGS = (
    *(".heic", ".heif", ".avif", ".jxl", ".jp2", ".exr"),
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"),
)
"""Of those that phones, cameras and renderers write and that are not read."""

REDUCED = re.compile(r"images_\d{1,3}", re.IGNORECASE)
"""Names of folders of a scene's photographs, reduced."""
PHOTOGRAPHS = re.compile(rf"images|{REDUCED.pattern}|input", re.IGNORECASE)
"""Names of folders of a scene's photographs, as programs call them."""
ANY_PHOTOGRAPHS = re.compile(rf"{PHOTOGRAPHS.pattern}|image|rgb|train|test|val", re.IGNORECASE)
"""The same, and what data sets call them: by a split, or as colours beside depths."""
MASKS = re.compile(r"(.*[_-])?masks?", re.IGNORECASE)
DEPTHS = re.compile(r"(.*[_-])?depths?([_-]?maps?)?", re.IGNORECASE)
"""Names of folders of masks and of depth maps."""
OTHER_IMAGES = re.compile(
    rf"{MASKS.pattern}|{DEPTHS.pattern}|(.*[_-])?(normals?|semantics?|segmentations?|instances?|"
    r"labels?|dispari(ty|ties)|albedos?|confidences?|thumb(nail)?s?)([_-]?(maps?|images?))?",
    re.IGNORECASE,
)
"""Names of folders of images that are named after photographs and are none."""


class OutsideError(InputError):
    """A path out of a scene file that leaves the scene's folder, but not through a link."""


def read_json(
    path: Path,
    schema: type[T],
    prepare: Callable[[Any], Any] = lambda tree: tree,
    dec_hook: Callable[[type, Any], Any] | None = None,
) -> T:
    """Read a JSON file into a msgspec structure.

    ``prepare`` may change what was read before it is converted; ``dec_hook`` is msgspec's.

    A byte-order mark is accepted. Numbers that are not finite, a key given twice and brackets too
    deep to parse are not, wherever they stand.

    Raises:
        InputError: The file cannot be read, is not JSON, or does not fit the structure.
    """
    require_regular_file(path)
    try:
        if path.stat().st_size > MAX_JSON_BYTES:
            raise InputError(
                f"{path}: is larger than {MAX_JSON_BYTES >> 20} MiB, so no scene file; name "
                "another one."
            )
        text = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror or error}; change that, or name another file."
        ) from None
    if not text.strip():
        raise InputError(f"{path}: is empty; copy or export it again.")
    try:
        # The standard parser, because msgspec's takes the last of two equal keys.
        tree = json.loads(text, object_pairs_hook=_distinct_keys, parse_int=_parse_int)
        place = _first_not_finite(tree)
        if place is not None:
            raise InputError(
                f"{path}: {place}: is not a finite number, or too large for one; correct it."
            )
        return msgspec.convert(prepare(tree), schema, dec_hook=dec_hook)
    except InputError:
        raise
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
        raise ValueError(f"the key {_key(twice)} is given twice in one object")
    return table


def _parse_int(text: str) -> int | float:
    return int(text) if len(text) <= MAX_DIGITS else math.inf


def _first_not_finite(tree: Any) -> str | None:
    """Where in a parsed file the first number stands that is NaN or infinite, as $.a[0].b."""
    waiting = [("$", tree)]
    while waiting:
        place, node = waiting.pop()
        if isinstance(node, float) and not math.isfinite(node):
            return place
        if isinstance(node, dict):
            inside = [(f"{place}.{_key(key)}", value) for key, value in node.items()]
        elif isinstance(node, list):
            inside = [(f"{place}[{index}]", value) for index, value in enumerate(node)]
        else:
            continue
        waiting += reversed(inside)
    return None


def _key(key: str) -> str:
    return key if key.isidentifier() and len(key) < 40 else _quoted(key)


def _as_clause(message: str) -> str:
    """Make msgspec's message part of a sentence; it leaves out the place when that is the top."""
    if " - at `" not in message:
        message += " - at `$`"
    return message[0].lower() + message[1:].replace(" - at ", ", at ")


def read_names(path: Path, option: str = "") -> list[str]:
    """Read a list of photographs: a name on each line; empty lines do not count.

    Args:
        path: Of the file.
        option: What named it, for sentences.

    Raises:
        InputError: It is no text.
    """
    require_regular_file(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        named = f"{option} {path}" if option else f"{path}"
        raise InputError(f"{named}: cannot be read as text ({error}); mend or remove it.") from None
    return [line.strip() for line in lines if line.strip()]


def plain_name(name: str) -> str:
    """A photograph's name in a list, with / between folders, and no ./ before it."""
    return name.replace("\\", "/").removeprefix("./")


def require_regular_file(path: Path) -> None:
    """Refuse what is missing, folders, pipes and devices, which would block or never end, and what
    stands for a file that Git LFS has not fetched.

    Raises:
        InputError: The path leads to no regular file, or to such a pointer.
    """
    try:
        found = path.stat()
        mode = found.st_mode
    except (OSError, ValueError) as error:
        why = "does not exist" if isinstance(error, FileNotFoundError) else f"{error}"
        raise InputError(f"{path}: cannot be read: {why}; name a file.") from None
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a pipe or a device"
        raise InputError(f"{path}: is {kind}, not a file; name a file.")
    if found.st_size <= MAX_POINTER_BYTES and beginning(path, len(POINTER)) == POINTER:
        raise InputError(f"{path}: is a Git LFS pointer, not the file itself; run `git lfs pull`.")


def exists(path: Path) -> bool:
    """Whether something is there; false, not an error, where that cannot be found out."""
    return os.path.exists(path)  # noqa: PTH110, whose way out raises


def beginning(path: Path, n_bytes: int) -> bytes:
    """The first bytes of a regular file, by which its kind is told; none of what is no such file
    or cannot be read."""
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as stream:
            return stream.read(n_bytes)
    except OSError:
        return b""


def resolve_inside(folder: Path, relative: str, *, field: str) -> Path:
    r"""Join a path out of a scene file to the scene's folder.

    Separators may be / or \. An absolute path is accepted where it points into the folder. The
    result need not exist.

    Args:
        folder: The scene's folder.
        relative: The path as the scene file has it.
        field: File and field that the path comes from, for the message.

    Raises:
        InputError: The path leaves the folder through a link.
        OutsideError: It does by .., or by being absolute.
    """
    text = relative.replace("\\", "/")
    # Control characters in a name are no file's of ours, and would steer a terminal.
    if not text or any(ord(c) < 0x20 or 0x7F <= ord(c) < 0xA0 for c in text):
        raise InputError(
            f"{field}: {_quoted(relative)} is not a path; name a file in the scene's folder."
        )
    try:
        if Path(text).is_absolute():
            text = os.path.relpath(text, Path.cwd() / folder)
        inside = os.path.normpath(text).replace("\\", "/")
        outside = PureWindowsPath(inside).drive or inside == ".." or inside.startswith(("../", "/"))
        path = folder / inside
        root, target = os.path.realpath(folder), os.path.realpath(path)
        linked = not outside and os.path.commonpath([root, target]) != root
    except ValueError:  # half a surrogate pair, or another drive
        raise InputError(
            f"{field}: {_quoted(relative)} is not a path; name a file that exists."
        ) from None
    if outside or linked:
        how = "follows a link out of" if linked else "leaves"
        raise (InputError if linked else OutsideError)(
            f"{field}: {_quoted(relative)} {how} the scene's folder {folder}; copy the file into "
            "that folder."
        )
    return path


def find_image(folder: Path, file_path: str, *, field: str) -> Path | None:
    """Find the image that a frame names, adding an extension where the frame leaves it out.

    Returns:
        The image's path inside the folder, or None where there is no such file.

    Raises:
        InputError: The path leaves the folder, or cannot be followed to its end.
    """
    for suffix in ("", *IMAGE_SUFFIXES):
        path = resolve_inside(folder, file_path + suffix, field=field)
        if os.path.isfile(path):  # noqa: PTH113, never raises
            return path
    path = resolve_inside(folder, file_path, field=field)
    try:
        path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:  # links in a circle, a name too long, no permission
        raise InputError(
            f"{field}: {_quoted(file_path)} cannot be opened: {error.strerror}; name a file that "
            "can be read."
        ) from None
    return path


class MovedFiles:
    """Files that a key of a scene file names, also by absolute paths of another machine, some ends
    of which are those of files in the folder; no two texts then name one file."""

    def __init__(self, folder: Path, *, taken: Collection[Path] = (), alone: bool = False) -> None:
        """Begin with none.

        Args:
            folder: The scene's.
            taken: Files that an end must not lead to.
            alone: Whether a name alone is end enough; else a folder of the path must be there, too.
        """
        self._folder = folder
        self._taken = taken
        self._least = 1 if alone else 2
        self._texts: dict[Path, str] = {}

    def find(self, text: str, *, field: str) -> Path | None:
        """Find the file that a text names.

        Args:
            text: The path as the scene file has it.
            field: File and field that it comes from, for the message.

        Returns:
            As ``find_image``.

        Raises:
            InputError: As ``find_image``.
            OutsideError: The path leaves the folder, and no end of it is free to be taken.
        """
        try:
            path = find_image(self._folder, text, field=field)
        except OutsideError:
            path = next(self._ends(text, field), None)
            if path is None:
                raise
        if path is not None:
            self._texts.setdefault(path, text)
        return path

    def _ends(self, text: str, field: str) -> Iterator[Path]:
        """Files that ends of an absolute path lead to, the longest first."""
        names = plain_name(text).split("/")
        if ".." in names or not (not names[0] or PureWindowsPath(names[0]).drive):
            return
        for start in range(1, len(names) - self._least + 1):
            end = "/".join(names[start:])
            if names[start] and os.path.isfile(self._folder / end):  # noqa: PTH113, never raises
                path = resolve_inside(self._folder, end, field=field)
                if path not in self._taken and self._texts.get(path, text) == text:
                    yield path


def photograph_folder(folder: Path) -> Path | None:
    """Where the photographs of a COLMAP or LLFF scene are.

    Args:
        folder: The scene's.

    Returns:
        The first that holds some of images/, images_2/, images_4/, ..., and 3DGS's input/; else the
        first that is there; None where none is.
    """
    try:
        reduced = [path for path in folder.glob("images_*") if REDUCED.fullmatch(path.name)]
    except OSError:
        reduced = []
    reduced.sort(key=lambda path: by_number(path.name))
    places = [p for p in (folder / "images", *reduced, folder / "input") if p.is_dir()]
    return next(filter(_holds_photographs, places), places[0] if places else None)


def is_photograph(name: str, endings: tuple[str, ...] = ENDINGS) -> bool:
    """Whether a file has a photograph's name; macOS keeps other things in ._NAME.jpg."""
    return name.lower().endswith(endings) and not name.startswith(".")


def _holds_photographs(folder: Path) -> bool:
    return any(is_photograph(name) for _, _, names in os.walk(folder) for name in names)


def by_number(name: str) -> tuple[tuple[str | int, ...], str]:
    """A key to sort names by in which numbers count as numbers: frame_2 comes before frame_10."""
    parts = re.split(r"([0-9]+)", name)
    return tuple(int(part) if index % 2 else part for index, part in enumerate(parts)), name


def printable(text: str) -> str:
    """Text out of a file for a terminal: what would steer it is spelled out."""
    return text if text.isprintable() else _quoted(text)


def _quoted(text: str) -> str:
    """Text out of a file for a message: cut where long, control characters spelled out."""
    return json.dumps(text[:100])
