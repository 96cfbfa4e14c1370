"""NumPy's arrays out of files that others wrote: never pickled, no more of them than is there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Literal

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.files import printable, require_regular_file

MAX_HEADER = 10_000
"""Bytes of a header, as NumPy's own limit."""


@dataclass(frozen=True)
class Header:
    """What an array's file says before its numbers."""

    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    """Whether the first index goes fastest."""

    @property
    def size(self) -> int:
        """Bytes of the numbers."""
        return math.prod(self.shape) * self.dtype.itemsize


def read_header(stream: IO[bytes], what: str) -> Header:
    """Read the header of an array in NumPy's format.

    Args:
        stream: At its beginning; afterwards at the first number.
        what: File and array, for messages.

    Raises:
        InputError: It is none, or of something else than integers and floats.
    """
    try:
        version = np.lib.format.read_magic(stream)
        first = version == (1, 0)
        read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
        length = stream.read(2 if first else 4)
        if int.from_bytes(length, "little") > MAX_HEADER:  # NumPy would make room for all of it
            raise ValueError("its header is too long")
        header = stream.read(int.from_bytes(length, "little"))
        shape, fortran, dtype = read(BytesIO(length + header))
    except Exception as error:  # parsers of Python run over it, with errors of all kinds
        text = printable(str(error).partition("\n")[0][:100])
        raise InputError(f"{what}: is not readable as an array ({text}); save it again.") from None
    if dtype.kind not in "fiu":
        raise InputError(
            f"{what}: is not readable as an array of numbers (it holds {dtype}); save floats."
        )
    if any(type(length) is not int or length < 0 for length in shape):  # True is an int, too
        raise InputError(f"{what}: has the shape {list(shape)}; save it again.")
    return Header(shape, dtype, fortran)


def read_numbers(stream: IO[bytes], header: Header, available: int, what: str) -> np.ndarray:
    """The numbers of an array after its header.

    Args:
        stream: At the first number.
        header: Of the array.
        available: Bytes that the file can have left; no memory is requested if it has too few.
        what: File and array, for messages.

    Raises:
        InputError: The file ends before.
    """
    data = stream.read(header.size) if header.size <= available else b""
    if len(data) < header.size:
        raise InputError(
            f"{what}: is cut short: {list(header.shape)} of {header.dtype} are {header.size} "
            "bytes, which are not there; copy it again."
        )
    order: Literal["C", "F"] = "F" if header.fortran else "C"
    return np.frombuffer(data, header.dtype).reshape(header.shape, order=order)


def read_npy(path: Path) -> np.ndarray:
    """Read a .npy file of numbers.

    Raises:
        InputError: It cannot be read, is damaged, or holds no numbers.
    """
    require_regular_file(path)
    try:
        with path.open("rb") as stream:
            header = read_header(stream, str(path))
            return read_numbers(stream, header, path.stat().st_size, str(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}; check it.") from None
