"""Positions of the vertices of a PLY file, ASCII or binary; nothing else of it is read.

The header's counts are believed only as far as the file is long. Format: Turk 1994, "The PLY
Polygon File Format".
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.files import printable, require_regular_file

MAX_HEADER_LINES = 1000
MAX_LINE = 10_000
"""Bytes of a line; of a header, or of a vertex as text."""

ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}


def read_ply(file: Path) -> np.ndarray:
    """Read where the vertices of a PLY file are.

    Args:
        file: Whose first element is ``vertex``, with properties x, y and z and no lists.

    Returns:
        [n, 3] float64.

    Raises:
        InputError: The file is damaged, or laid out otherwise.
    """
    require_regular_file(file)
    try:
        with file.open("rb") as stream:
            order, count, properties = _header(file, stream)
            if order:
                return _binary(file, stream, order, count, properties)
            return _text(file, stream, count, [name for name, _ in properties])
    except OSError as error:
        raise InputError(
            f"{file}: cannot be read: {error.strerror or error}; change that, or leave the points "
            "out."
        ) from None


def _header(file: Path, stream: BinaryIO) -> tuple[str, int, list[tuple[str, str]]]:
    """Order of bytes (empty: text), number of vertices, names and types of their properties."""
    if stream.readline(MAX_LINE).strip() != b"ply":
        raise InputError(f"{file}: is no PLY file: it does not begin with `ply`; export it again.")
    order: str | None = None
    count = -1
    properties: list[tuple[str, str]] = []
    elements = 0
    for _ in range(MAX_HEADER_LINES):
        line = stream.readline(MAX_LINE).decode("latin-1").strip()
        words = line.split()
        if line == "end_header":
            break
        if not words or words[0] in ("comment", "obj_info"):
            if not line and stream.tell() == file.stat().st_size:
                raise _damaged(file, "ends within its header")
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in ORDERS:
            order = ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3 and words[2].isdecimal():
            elements += 1
            if elements == 1:
                if words[1] != "vertex" or len(words[2]) > 18:
                    raise _damaged(file, f"has no vertices as its first element, but {line!r}")
                count = int(words[2])
        elif words[0] == "property" and len(words) == 3 and words[1] in TYPES and elements:
            if elements == 1:
                properties.append((words[2], TYPES[words[1]]))
        elif words[:2] == ["property", "list"] and len(words) == 5 and elements > 1:
            continue
        else:
            raise _damaged(file, f"has a line in its header that is not understood, {line[:80]!r}")
    else:
        raise _damaged(file, f"has more than {MAX_HEADER_LINES} lines in its header")
    names = [name for name, _ in properties]
    if order is None or not {"x", "y", "z"} <= set(names) or len(set(names)) < len(names):
        raise _damaged(file, "names no format, or no x, y and z of its vertices, in its header")
    return order, count, properties


def _binary(
    file: Path, stream: BinaryIO, order: str, count: int, properties: list[tuple[str, str]]
) -> np.ndarray:
    vertex = np.dtype([(name, order + kind) for name, kind in properties])
    begin, size = stream.tell(), file.stat().st_size
    if begin + count * vertex.itemsize > size:
        raise _damaged(file, f"counts {count} vertices, but ends before")
    if count == 0:
        return np.empty((0, 3))
    vertices = np.memmap(stream, vertex, "r", begin, (count,))  # only positions come to memory
    with np.errstate(invalid="ignore"):  # NaN of any kind is the caller's to drop
        return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _text(file: Path, stream: BinaryIO, count: int, names: list[str]) -> np.ndarray:
    left = file.stat().st_size - stream.tell()
    if count * 2 * len(names) > left + 1:  # a digit and a space each
        raise _damaged(file, f"counts {count} vertices, but ends before")
    positions = np.empty((count, 3))
    at = [names.index(axis) for axis in "xyz"]
    for vertex in range(count):
        words = stream.readline(MAX_LINE).split()
        try:
            positions[vertex] = [float(words[index]) for index in at]
        except (IndexError, ValueError):
            raise _damaged(file, f"has no x, y and z as numbers at its vertex {vertex}") from None
    return positions


def _damaged(file: Path, how: str) -> InputError:
    return InputError(f"{file}: {printable(how)}; export it again, or leave the points out.")
