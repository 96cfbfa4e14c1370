"""Pixels of photographs in a file that has no name, for photographs that memory does not hold.

The file is mapped to memory, and the system keeps as much of it there as is to spare. It is gone
when the last array that lies in it is, or the process, however that ends.
"""

from __future__ import annotations

import mmap
import tempfile
from pathlib import Path

import numpy as np


class PixelFile:
    """Arrays that are added one after another, then mapped together."""

    def __init__(self, folder: Path) -> None:
        """Begin a file.

        Args:
            folder: Where there is room for it.

        Raises:
            OSError: It cannot be written there.
        """
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115, stays open
        self._shapes: list[tuple[int, ...]] = []

    def add(self, image: np.ndarray) -> None:
        """Write an array of uint8 behind the others.

        Raises:
            OSError: There is no room left.
        """
        self._file.write(np.ascontiguousarray(image).data)
        self._shapes.append(image.shape)

    def close(self) -> list[np.ndarray]:
        """The arrays in their order, read-only; nothing can be added any more.

        Raises:
            OSError: There is no room left, or the file cannot be mapped.
        """
        self._file.flush()
        mapping = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        self._file.close()  # the mapping keeps it
        arrays = []
        at = 0
        for shape in self._shapes:
            size = int(np.prod(shape))
            arrays.append(np.frombuffer(mapping, np.uint8, size, at).reshape(shape))
            at += size
        return arrays


def expect_random_reads(array: np.ndarray) -> None:
    """Tell the system to read single pages of the file that an array lies in, if it does."""
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, memoryview):
        base = base.obj
    if isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
        base.madvise(mmap.MADV_RANDOM)
