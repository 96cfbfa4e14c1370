"""The photographs that poses are estimated of: checked, with the lens and the way up of each."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from PIL import ExifTags, Image

from warpnerf.checks import InputError
from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.files import printable
from warpnerf.scenes.formats.contents import NEEDED
from warpnerf.scenes.images.images import (
    exif_orientation,
    image_size,
    read_exif,
    require_whole_image,
    says_equirectangular,
)
from warpnerf.scenes.images.masks import Mask, fits, mask_beside, masks_of_folder
from warpnerf.sfm.config import Lenses

UPRIGHT = {
    1: (0, 1),
    2: (0, 1),
    3: (0, -1),
    4: (0, -1),
    5: (-1, 0),
    6: (-1, 0),
    7: (1, 0),
    8: (1, 0),
}
"""By EXIF orientation: which way is up in the stored pixels, as steps to the right and up. It is
the picture's first column that shows the top in 5 and 6, its last one in 7 and 8."""


@dataclass(frozen=True, kw_only=True)
class UnposedPhotograph:
    """One photograph, before its pose is known."""

    path: Path
    size: tuple[int, int]
    """Width and height of the stored pixels."""
    lens: int
    """Photographs with the same number share a lens."""
    up: tuple[int, int]
    """Which way is up in the stored pixels, by EXIF: steps to the right and up."""
    mask: Mask | None = None
    """Where it is black, nothing is looked for."""


def read_photographs(
    paths: Sequence[Path], *, lenses: Lenses, masks: Path | None, threads: int | None = None
) -> list[UnposedPhotograph]:
    """Look at photographs: whether each is whole, and what it says of its lens.

    Args:
        paths: Of photographs.
        lenses: Which of them share a lens: those of the same size, camera and focal length by
            EXIF (auto), all (one), or none (each).
        masks: Folder of masks, named after the photographs; None: those beside them, if any.
        threads: That look at them; None: one per usable core.

    Returns:
        One for each path.

    Raises:
        InputError: Too few, panoramas, one is no whole photograph or has a name that scenes cannot
            hold, sizes differ where one lens is requested, or no mask is there.
    """
    if len(paths) < NEEDED:
        raise InputError(
            f"{paths[0].parent if paths else 'the folder'}: {len(paths)} photographs are too few: "
            f"poses need at least {NEEDED}, and a good scene 30 or more; take more."
        )
    for path in paths:
        if not path.name.isprintable() or "\\" in path.name:
            raise InputError(
                f"{printable(str(path))}: a scene's file cannot name it; leave out control "
                "characters and backslashes."
            )
    _refuse_panoramas(paths)
    # Decoders release the interpreter lock. COLMAP would continue with half a picture.
    with ThreadPoolExecutor(threads or usable_cores()) as pool:
        list(pool.map(require_whole_image, paths))
    keys: dict[object, int] = {}
    photographs = []
    for number, (path, mask) in enumerate(zip(paths, masks_of(paths, masks), strict=True)):
        size = image_size(path)
        key = {"auto": (size, read_exif(path, _camera)), "one": "one", "each": number}[lenses]
        photographs.append(
            UnposedPhotograph(
                path=path,
                size=size,
                lens=keys.setdefault(key, len(keys)),
                up=UPRIGHT[exif_orientation(path)],
                mask=mask,
            )
        )
    if lenses == "one":
        first = photographs[0]
        other = next((p for p in photographs if p.size != first.size), None)
        if other is not None:
            raise InputError(
                f"--lenses one: {other.path.name} has {_shown(other.size)} pixels, but "
                f"{first.path.name} {_shown(first.size)}, and one lens takes photographs of one "
                "size; use --lenses auto."
            )
    return photographs


def masks_of(paths: Sequence[Path], masks: Path | None) -> list[Mask | None]:
    """The masks of photographs, one for each or None, as ``read_photographs`` finds them.

    Of those beside the photographs, some are left aside: in which white is ignored, as a scene's
    file cannot say that of a mask, and those of other sizes.

    Raises:
        InputError: A folder of masks was named, and holds none of these photographs.
    """
    if masks is not None:
        return masks_of_folder(masks, [path.name for path in paths])
    return [mask if is_used(mask, path) else None for path in paths for mask in [mask_beside(path)]]


def is_used(mask: Mask | None, path: Path) -> bool:
    """Whether a mask that lies beside a photograph is used for its pose."""
    if mask is None or not mask.white_counts:
        return False
    width, height = image_size(path)
    return fits(mask, width=width, height=height)


def put_into(folder: Path, file: Path, name: str) -> None:
    """Put a file into a folder as a hard link, which takes no room, or else as a copy.

    Args:
        folder: Made if it does not exist.
        file: Stays where it is.
        name: In the folder.

    Raises:
        OSError: The folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    try:
        os.link(os.path.realpath(file), folder / name)
    except OSError:  # another disk, or a file system without links
        shutil.copyfile(file, folder / name)


def _refuse_panoramas(paths: Sequence[Path]) -> None:
    """Raise InputError where photographs show all directions, by their metadata."""
    said = [path for path in paths if says_equirectangular(path)]
    if said:
        raise InputError(
            f"{said[0]}: is a panorama of 360 degrees, which has no lens that poses could be "
            f"estimated for ({len(said)} of {len(paths)} photographs say so); cut each into "
            "pictures of 90 degrees first, or leave them out: move them to another folder."
        )


def _camera(exif: Image.Exif) -> tuple[str, ...]:
    """Camera and focal length by EXIF."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    names = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
    return tuple(map(str, [exif.get(ExifTags.Base.Model), *map(details.get, names)]))


def _shown(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
