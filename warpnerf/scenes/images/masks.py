"""Masks: images that are white where a photograph's pixels count, black where they are ignored."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.images.images import image_size, read_image

SUFFIXES = (".png", ".jpg", ".jpeg")
"""Of masks, which are named after a photograph or its stem."""
IN_FOLDERS = (*SUFFIXES, ".tif", ".tiff", ".bmp", ".webp")
"""Of those in folders of masks."""
LOSSY = (".jpg", ".jpeg")
"""Of those in which black is not quite black."""

DYNAMIC = "dynamic_mask_"
"""What the names of instant-ngp's masks begin with."""


@dataclass(frozen=True)
class Mask:
    """A mask that was found, not read yet."""

    path: Path
    """Of the image."""
    white_counts: bool = True
    """False for those of instant-ngp, where white is ignored."""
    found: bool = False
    """Whether nobody named it or its folder: it has a mask's name, and may be something else."""


@dataclass(frozen=True, eq=False)
class PackedMask:
    """Which pixels count, a bit for each."""

    bits: np.ndarray
    """[n] uint8, row by row."""
    shape: tuple[int, int]
    """H, W."""
    count: int
    """Of pixels that count."""

    @staticmethod
    def of(mask: np.ndarray) -> PackedMask:
        """Pack a mask [H, W] bool."""
        rows, columns = mask.shape
        return PackedMask(np.packbits(mask), (rows, columns), int(np.count_nonzero(mask)))

    def read(self) -> np.ndarray:
        """[H, W] bool."""
        n_pixels = self.shape[0] * self.shape[1]
        return np.unpackbits(self.bits, count=n_pixels).view(np.bool_).reshape(self.shape)


def mask_beside(photograph: Path) -> Mask | None:
    """The mask of a photograph in the same folder, by its name: dynamic_mask_NAME.png, as of
    instant-ngp; NAME.jpg.mask.png or NAME.mask.png, as of RealityScan; or NAME_mask.png."""
    for index, name in enumerate(_names_beside(photograph)):
        path = photograph.with_name(name)
        if os.path.isfile(path):  # noqa: PTH113, never raises
            return Mask(path, white_counts=index > 0, found=True)
    return None


def _names_beside(photograph: Path) -> Iterator[str]:
    """What a mask in the folder of its photograph is called; first as of instant-ngp."""
    name, stem = photograph.name, photograph.stem
    yield f"{DYNAMIC}{stem}.png"
    for named in (f"{name}.mask", f"{stem}.mask", f"{stem}_mask"):
        yield from (named + suffix for suffix in SUFFIXES)


def without_masks(paths: Sequence[Path]) -> list[Path]:
    """Those of some images that are no mask of another one of them, in the same order."""
    there = set(map(str, paths))  # asking the disk for each name takes long
    masks = set()
    images = [path for path in paths if not path.name.startswith(DYNAMIC)]
    for path in images:
        folder = str(path).removesuffix(path.name)
        beside = (folder + name for name in _names_beside(path))
        masks.add(next(filter(there.__contains__, beside), None))
    return [path for path in images if str(path) not in masks]


def mask_in(folder: Path, name: str) -> Mask | None:
    """The mask of a photograph in a folder of masks: NAME.jpg.png or NAME.png, as COLMAP has it, or
    mask_NAME.png, or as ``mask_beside``.

    Args:
        folder: Of masks.
        name: The photograph's path relative to the folder of photographs, with /.
    """
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or not relative.name:
        return None
    stems = relative.with_suffix(""), relative.with_name(f"mask_{relative.stem}")
    own, prefixed = ([f"{stem}{suffix}" for suffix in IN_FOLDERS] for stem in stems)
    for path in (f"{name}.png", *own, name, *prefixed):
        if os.path.isfile(folder / path):  # noqa: PTH113, never raises
            return Mask(folder / path)
    mask = mask_beside(folder / relative)
    return None if mask is None else replace(mask, found=False)


def masks_of_folder(folder: Path, names: Sequence[str]) -> list[Mask | None]:
    """Find the masks of a scene's photographs in a folder that was given for all.

    Args:
        folder: Of masks; its structure is that of the photographs' folder.
        names: Of the photographs, relative to the scene's folder, with /.

    Returns:
        One for each photograph; None where there is none.

    Raises:
        InputError: The folder does not exist, or holds no mask of these photographs.
    """
    if not folder.is_dir():
        raise InputError(f"--masks {folder}: is no folder; name the folder of the masks.")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"--masks {folder}: cannot be read; give access to it.")
    found = list(_found_in(folder, names))
    if not any(found):
        stem = PurePosixPath(names[0]).stem
        raise InputError(
            f"--masks {folder}: holds no mask of {len(names)} photographs (first: {names[0]}); "
            f"name them after the photographs: {PurePosixPath(names[0]).name}.png or {stem}.png."
        )
    return found


def has_mask_of(folder: Path, names: Sequence[str]) -> bool:
    """Whether ``masks_of_folder`` would find one at least."""
    return any(_found_in(folder, names))


def _found_in(folder: Path, names: Sequence[str]) -> Iterator[Mask | None]:
    parents = {PurePosixPath(name).parent.as_posix() for name in names}
    common = os.path.commonpath(parents).replace(os.sep, "/")
    for name in names:
        inside = PurePosixPath(name).relative_to(common).as_posix()
        yield mask_in(folder, inside) or mask_in(folder, name)


def fits(mask: Mask, *, width: int, height: int, downscale: int = 1) -> bool:
    """Whether a mask is an image of a size that ``read_mask`` takes, by its header."""
    try:
        columns, rows = image_size(mask.path)
    except InputError:
        return False
    return _times(columns, rows, width, height, downscale) is not None


def unfit_masks(names: Sequence[str]) -> list[str]:
    """A sentence on masks, if any, that were found but do not fit."""
    if not names:
        return []
    return [
        f"not used as masks: {len(names)} images of another size than the photographs whose masks "
        f"they are by name (first: {names[0]})"
    ]


def _times(columns: int, rows: int, width: int, height: int, downscale: int) -> int | None:
    """How many times as large as its photograph a mask is; 0: as large as that is then reduced to;
    None: neither."""
    if (columns, rows) == (width // downscale, height // downscale):
        return 0
    times = max(1, round(columns / width))
    # What fills no whole pixel of a reduced photograph was dropped, or has one of its own.
    apart = max(abs(columns / times - width), abs(rows / times - height))
    return times if apart < 1.0 else None


def read_mask(mask: Mask, *, width: int, height: int, downscale: int) -> np.ndarray:
    """Read a mask for a photograph, of its size or a whole number of times as large, rounded.

    White is more than half of the largest value that a pixel can have, in any channel, where it is
    opaque; where no pixel has more than 1 of 255, it is 1. A pixel that stands for several counts
    if all of them do.

    Args:
        mask: To read.
        width: Pixels in a row of the photograph, as it is stored.
        height: Its rows.
        downscale: Edge of the blocks of the photograph's pixels that become one. Masks may have
            the size that it then has.

    Returns:
        [height // downscale, width // downscale] bool, true where a pixel counts.

    Raises:
        InputError: It cannot be read, or has another size.
    """
    image = read_image(mask.path)
    # Ten times as fast as the maximum along an axis.
    rgb = np.maximum(np.maximum(image[..., 0], image[..., 1]), image[..., 2])
    white = rgb > (127 if rgb.max() > 1 else 0)
    if image.shape[2] == 4:
        white &= image[..., 3] > 127
    counts = white if mask.white_counts else rgb == 0
    rows, columns = counts.shape
    small = (height // downscale, width // downscale)
    times = _times(columns, rows, width, height, downscale)
    if times == 0:
        return counts
    if times is None:
        raise InputError(
            f"{mask.path}: has {columns}x{rows} pixels, but its photograph {width}x{height}; make "
            "the mask as large as the photograph."
        )
    return all_of_blocks(counts, times * downscale, small)


def numbers_of_classes(masks: Iterable[Mask]) -> str:
    """Half a sentence on the first of some masks, if one is, that holds numbers of classes, or
    colours for them, in place of white: other values than 0, none of which is white."""
    for mask in masks:
        if mask.path.suffix.lower() in LOSSY:
            continue
        values = np.unique(read_image(mask.path)[..., :3].max(axis=2)).tolist()
        if 1 < values[-1] < 128:
            shown = ", ".join(map(str, values[:6])) + ", ..." * (len(values) > 6)
            return (
                f"{mask.path} holds {shown}, as numbers of classes; write 255 where pixels count "
                "and 0 where not"
            )
    return ""


def all_of_blocks(counts: np.ndarray, edge: int, size: tuple[int, int]) -> np.ndarray:
    """Which blocks of pixels count as wholes.

    Args:
        counts: Which pixels do, [H, W] bool.
        edge: Of a block, pixels.
        size: Rows and columns of blocks; pixels at the right and bottom that fill none are cut, and
            where blocks are not full, the last pixels are repeated.

    Returns:
        [rows, columns] bool.
    """
    rows, columns = size
    missing = [max(0, n * edge - there) for n, there in zip(size, counts.shape, strict=True)]
    if any(missing):
        counts = np.pad(counts, [(0, n) for n in missing], mode="edge")
    blocks = counts[: rows * edge, : columns * edge].reshape(rows, edge, columns, edge)
    return np.asarray(blocks.all(axis=(1, 3)))
