"""Photographs, and where their pixels are kept: in memory, on disk, or in their own files."""

from __future__ import annotations

import logging
import math
import os
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import Literal

import numpy as np

from warpnerf.checks import InputError
from warpnerf.runtime.memory import available_memory, lies_in_memory, usable_cores
from warpnerf.scenes.images.images import box_filter, read_image
from warpnerf.scenes.images.pixel_file import PixelFile
from warpnerf.scenes.images.resampling import Resampling

Place = Literal["auto", "memory", "disk", "files"]
"""memory; disk: read once, into a nameless file that is mapped; files: read again at each look;
auto: memory, or disk where they would take more than ``MEMORY_SHARE`` of what is free."""

MEMORY_SHARE = 0.5
"""Of the memory that is free; grid, optimiser and system need some, too."""


TELL_EVERY = 5.0
"""Seconds from one word on how far reading has come to the next."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Keeping:
    """Where the pixels of a scene's photographs are kept, and by how many threads they are read."""

    place: Place = "auto"
    """See there."""
    folder: Path | None = None
    """Where the nameless file is made; None: in TMPDIR if that is set, else /var/tmp if there is
    one, for /tmp may lie in memory."""
    threads: int | None = None
    """That read them at a time; None: one per usable core."""

    @property
    def disk(self) -> Path:
        """The folder, decided."""
        if self.folder is not None:
            return self.folder
        lasting = Path("/var/tmp")
        given = os.environ.get("TMPDIR")
        return lasting if not given and lasting.is_dir() else Path(tempfile.gettempdir())


@dataclass(frozen=True, kw_only=True, eq=False)
class Photograph:
    """A photograph in its file."""

    path: Path
    """The file."""
    shape: tuple[int, int, int]
    """H, W, and 3 or 4 channels, reduced."""
    downscale: int
    """Edge of the blocks of pixels that become one."""
    image: np.ndarray | None = None
    """Its pixels before that, [H, W, 3 or 4] uint8, where they are in memory anyway."""
    drops_alpha: bool = False
    """Whether alpha in its file is left out."""
    resampling: Resampling | None = None
    """By which it is undistorted, after it is reduced; None: it is used as it is."""
    made: np.ndarray | None = None
    """What ``read`` returns, where its file was decoded before anyway."""

    @property
    def n_bytes(self) -> int:
        """Of its pixels."""
        return math.prod(self.shape)

    def read(self) -> np.ndarray:
        """Read it.

        Returns:
            [H, W, 3 or 4] uint8, straight alpha.

        Raises:
            InputError: The file is damaged, or no longer what it was.
        """
        if self.made is not None:
            return self.made
        return self.made_of(read_image(self.path) if self.image is None else self.image)

    def made_of(self, image: np.ndarray) -> np.ndarray:
        """As ``read``, of the pixels of its file."""
        if self.downscale > 1:
            image = box_filter(image, self.downscale)
        if self.resampling is not None and image.shape[:2] == self.shape[:2]:
            image = self.resampling.image(image)
        if self.drops_alpha and image.shape[2] == 4:
            image = np.ascontiguousarray(image[..., :3])
        if image.shape != self.shape:
            raise InputError(f"{self.path}: has changed while it was read; begin again.")
        return image


@dataclass(frozen=True, kw_only=True)
class Kept:
    """Photographs, kept."""

    images: list[np.ndarray | Photograph]
    """The pixels of each, or where to read them."""
    see_through: list[bool]
    """Whether any pixel of it is transparent."""
    notes: tuple[str, ...] = ()
    """What should be told."""


def stay_in_memory(keeping: Keeping, n_bytes: int) -> bool:
    """Whether photographs of so many bytes will be kept in memory, and well fit there."""
    available = available_memory()
    fits = available is None or n_bytes <= MEMORY_SHARE * available
    return keeping.place in ("memory", "auto") and fits


def keep(
    photographs: Sequence[Photograph], keeping: Keeping, *, file: Path, downscale: int
) -> Kept:
    """Read photographs, unless they stay in their files, and keep their pixels.

    Args:
        photographs: At least one.
        keeping: Where.
        file: The scene file, for messages.
        downscale: That they are reduced by, for messages.

    Raises:
        InputError: A photograph is damaged, or they need more room than there is.
    """
    needed = sum(photograph.n_bytes for photograph in photographs)
    more = sum(photograph.n_bytes for photograph in photographs if photograph.made is None)
    available = available_memory()
    place = keeping.place
    if place == "files":
        with_alpha = [photograph.shape[2] == 4 for photograph in photographs]
        seen = map(_see_through, _read_all(list(compress(photographs, with_alpha)), keeping))
        see_through = [alpha and next(seen) for alpha in with_alpha]
        return Kept(images=list(photographs), see_through=see_through)
    if place == "auto":
        place = "memory" if stay_in_memory(keeping, more) else "disk"
    height, width, _ = photographs[0].shape
    need = (
        f"{file}: {len(photographs)} photographs (the first of {width}x{height} pixels) need "
        f"{_size(needed)}"
    )
    if place == "memory":
        if available is not None and more > available:
            raise InputError(
                f"{need}, but {_size(available)} of memory are free; keep them on disk (--images "
                f"disk), or use --downscale {_reduction(downscale, needed, available)}."
            )
        images = list(_read_all(photographs, keeping))
        return Kept(images=[*images], see_through=[_see_through(image) for image in images])
    folder = keeping.disk.resolve()
    try:
        free = shutil.disk_usage(folder).free
        if needed > free:
            raise InputError(
                f"{need}, but {_size(free)} are free in {folder}; make room there, or use "
                f"--downscale {_reduction(downscale, needed, free)}."
            )
        pixels = PixelFile(folder)
        see_through = []
        for image in _read_all(photographs, keeping):
            pixels.add(image)
            see_through.append(_see_through(image))
        kept = pixels.close()
    except OSError as error:
        raise InputError(
            f"{need} in {folder}, which cannot be written: {error.strerror or error}; make room or "
            "give access there, or use a larger --downscale."
        ) from None
    note = f"photographs on disk: {_size(needed)} in {folder}, removed at the end"
    if keeping.place == "auto" and available is not None:
        note += f"; {_size(available)} of memory are free"
    if lies_in_memory(folder):
        note += "; but that folder lies in memory itself (tmpfs): choose one on a disk"
    return Kept(images=[*kept], see_through=see_through, notes=(note,))


def _read_all(photographs: Sequence[Photograph], keeping: Keeping) -> Iterator[np.ndarray]:
    """Read in order and in parallel, only a few ahead of what is requested."""
    threads, told = keeping.threads or usable_cores(), time.monotonic()
    waiting: deque[Future[np.ndarray]] = deque()
    # Decoders release the interpreter lock.
    with ThreadPoolExecutor(threads) as pool:
        for number, photograph in enumerate(photographs):
            if time.monotonic() - told > TELL_EVERY:
                told = time.monotonic()
                _log.info("read %d of %d photographs", number, len(photographs))
            waiting.append(pool.submit(photograph.read))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _see_through(image: np.ndarray) -> bool:
    return image.shape[2] == 4 and bool((image[:, :, 3] < 255).any())


def _reduction(downscale: int, needed: int, room: int) -> int:
    """The least --downscale by which as many bytes would fit."""
    return math.ceil(downscale * math.sqrt(needed / max(room, 1)))


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 2**30:.1f} GiB" if n_bytes >= 2**29 else f"{n_bytes / 2**20:.3g} MiB"
