"""COLMAP's sparse models in a capture's folder: which there are, and which of them is the scene's.

The mapper writes a model 0, 1, ... for each part of a capture that it could not connect to others.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.files import (
    exists,
    is_photograph,
    photograph_folder,
    printable,
    require_regular_file,
)
from warpnerf.scenes.formats.colmap_files import (
    ModelImage,
    first_of_text,
    images_of_bytes,
    images_of_text,
    stated_images,
)

SPARSE = "sparse"
MODEL_FOLDERS = (SPARSE, f"colmap/{SPARSE}", ".")
"""Where models are looked for in a scene's folder, in this order: there, and first in 0, 1, ... of
a folder sparse, or of one with photographs of which these have none."""

ROUNDED = 1e-4
"""By which numbers of a pose differ in a model's two forms, at most: as a share of their norm."""

CLEARLY_SMALLER = 0.8
"""Share of the images of the largest model that can be read, below which a damaged one is a
fragment that nobody misses; above it, it may be what was meant. So it is of a model's two forms."""


def find_model(folder: Path) -> Path | None:
    """The folder of a COLMAP model that belongs to a scene's folder: of several the largest.

    Args:
        folder: The scene's.

    Returns:
        Where cameras and images are; None where there is no model.
    """
    return next(iter(find_models(folder)), None)


def find_models(folder: Path) -> list[Path]:
    """All models at the first place in a scene's folder that has some, the largest first."""
    for name in MODEL_FOLDERS:
        models = _models_in(folder / name)
        if models:
            return models if len(models) == 1 else _by_size(models)
    return []


def _models_in(place: Path) -> list[Path]:
    """The models 0, 1, ... of a folder, and itself if it is one."""
    numbered: list[Path] = []
    with suppress(OSError):
        numbered = [path for path in place.iterdir() if re.fullmatch(r"\d{1,4}", path.name)]
    numbered = [path for path in numbered if model_kind(path) is not None and is_numbered(path)]
    numbered.sort(key=lambda path: int(path.name))
    return [*numbered, place] if model_kind(place) is not None else numbered


def is_numbered(model: Path) -> bool:
    """Whether a folder is one of several models 0, 1, ... of a scene, not a capture of its own."""
    model = model.absolute()
    return model.name.isdecimal() and (_is_sparse(model.parent) or _has_none_of(model))


def _is_sparse(place: Path) -> bool:
    """Whether a folder is called sparse, be it a link, or what a link leads to."""
    return SPARSE in (place.name, place.resolve().name)


def _has_none_of(model: Path) -> bool:
    """Whether the photographs of a numbered model are in the folder above it, or beside that."""
    if photograph_folder(model) is not None:
        return False
    return any(photograph_folder(folder) is not None for folder in list(model.parents)[:2])


def size_of(model: Path) -> int | None:
    """How many images a model has; None where it cannot be read."""
    return _listed(model / f"images.{model_kind(model)}")


def _listed(file: Path) -> int | None:
    """How many images a file of them lists, whatever it states; None where it cannot be read."""
    try:
        return len(_images_in(file))
    except (InputError, OSError):
        return None


def _by_size(models: Sequence[Path]) -> list[Path]:
    """Larger models first. Damaged ones come before all, as they are refused, not skipped; but last
    if they are clearly smaller than the largest whole one."""
    sizes = {path: size_of(path) for path in models}
    whole = {path: size for path, size in sizes.items() if size is not None}
    largest = max(whole, key=lambda path: whole[path], default=None)

    def rank(path: Path) -> float:
        size = sizes[path]
        if size is not None:
            return -size
        fragment = largest is not None and (
            _may_have_had(path, largest, whole[largest]) < CLEARLY_SMALLER * whole[largest]
        )
        return math.inf if fragment else -math.inf

    return sorted(models, key=rank)


def _may_have_had(model: Path, other: Path, n: int) -> float:
    """About how many images a damaged model had, by the number that its file states and by its
    length, compared with that of another model of n images; infinity where these do not tell."""
    kind, kind_of_other = model_kind(model), model_kind(other)
    file = model / f"images.{kind}"
    told: list[float] = []
    try:
        require_regular_file(file)
        if kind == kind_of_other:
            there = (other / f"images.{kind}").stat().st_size
            told.append(file.stat().st_size / there * n)
        if kind == "bin":
            with file.open("rb") as opened:
                head = opened.read(8)
            if len(head) < 8:  # a copy that broke off at once
                return math.inf
            told.append(int.from_bytes(head, "little"))
        else:
            told.append(stated_images(file) or -math.inf)
    except (InputError, OSError, UnicodeDecodeError):
        return math.inf
    most = max(told)
    return math.inf if most < 0.0 else most


def images_of(model: Path) -> list[ModelImage]:
    """The images of a model; InputError where it is damaged."""
    return _images_in(model / f"images.{model_kind(model)}")


def _images_in(file: Path) -> list[ModelImage]:
    require_regular_file(file)
    return (images_of_bytes if file.suffix == ".bin" else images_of_text)(file)


def other_models(
    model: Path, images: Sequence[ModelImage], folder: Path
) -> tuple[list[str], list[str]]:
    """Notes and warnings of other models of a scene, and of this one in its other form.

    Args:
        model: Which is read.
        images: Of it.
        folder: The scene's, which the others are named from.
    """
    n = len(images)
    elsewhere = [path for place in MODEL_FOLDERS for path in _models_in(folder / place)]
    others = {path.resolve(): path for path in [*elsewhere, *beside(model)]}
    sizes = {path: size_of(path) for place, path in others.items() if place != model.resolve()}

    def name(path: Path) -> str:
        place = os.path.relpath(path.resolve(), folder.resolve())
        return printable(Path(place).as_posix())

    kind = model_kind(model)
    stale = [
        f"{name(model / f'images.{kind}')} of {n} images is read, and not images.{other}, which "
        f"{size}; remove the files of the one that is out of date"
        for other in _kinds(model)
        if other != kind and (size := _otherwise(model / f"images.{other}", images))
    ]
    if not sizes:
        return [], stale
    rest = ", ".join(
        f"{name(path)} {'is damaged' if size is None else f'has {size}'}"
        for path, size in sizes.items()
    )
    said = [f"the model {name(model)} of {n} images is read; {rest}"]
    worse = any(size is None or size > n for size in sizes.values())
    return ([], [*said, *stale]) if worse else (said, stale)


def beside(model: Path) -> list[Path]:
    """The other models of the same scene."""
    model = model.absolute()
    if not is_numbered(model):
        model = model.resolve()  # a link to one of several
    place = model.parent if is_numbered(model) else model
    return [path for path in _models_in(place) if path.resolve() != model.resolve()]


def model_kind(folder: Path) -> str | None:
    """Whether a folder holds a model: "bin", "txt" or None.

    Of both it is "bin", as in other programs, unless that is damaged or clearly smaller.
    """
    kinds = _kinds(folder)
    if len(kinds) < 2:
        return kinds[0] if kinds else None
    binary, text = (folder / f"images.{kind}" for kind in kinds)
    n = _listed(binary)
    if n is not None and n >= CLEARLY_SMALLER * _stated(text):  # saves reading a long text
        return "bin"
    return "txt" if (n or 0) < CLEARLY_SMALLER * (_listed(text) or 0) else "bin"


def _kinds(folder: Path) -> list[str]:
    """In which forms a folder holds a model, binary first."""
    return [
        kind
        for kind in ("bin", "txt")
        if exists(folder / f"cameras.{kind}") and exists(folder / f"images.{kind}")
    ]


def _stated(text: Path) -> int:
    """How many images a text of them says that it has; 0 where it does not."""
    try:
        require_regular_file(text)
        return stated_images(text)
    except (InputError, OSError, UnicodeDecodeError):
        return 0


def _otherwise(file: Path, images: Sequence[ModelImage]) -> str:
    """What a file of images has other than these, in words; empty: nothing, as it seems."""
    n = len(images)
    if file.suffix == ".txt":
        first = first_of_text(file)
        twins = [image for image in images if first is not None and image.name == first.name]
        size = float(np.ptp([image.translation for image in images], axis=0).max(initial=0.0))
        if first is not None and not all(_same_pose(first, image, size) for image in twins):
            return "has other poses"
        if _stated(file) == n:
            return ""
    listed = _listed(file)
    if listed == n:
        return ""
    return "is damaged" if listed is None else f"has {listed}"


def _same_pose(one: ModelImage, other: ModelImage, size: float) -> bool:
    """Whether two images are of one pose, but for how it is rounded; q and -q are one rotation.

    Args:
        one: Of a model.
        other: Of another.
        size: Of the model, along its longest axis.
    """
    q, r = (np.array(image.rotation) / np.linalg.norm(image.rotation) for image in (one, other))
    at, there = np.array(one.translation), np.array(other.translation)
    turned = np.linalg.norm(q - (r if q @ r > 0.0 else -r)) > ROUNDED
    size = max(size, float(np.linalg.norm(there)))
    return not turned and bool(np.linalg.norm(at - there) <= ROUNDED * size)


def scene_folder(model: Path) -> Path:
    """The scene's folder that a model's folder belongs to: the one that holds the photographs.

    Where there are none, the one that they should be in.
    """
    named, model = model.absolute(), model.resolve()
    folders: Sequence[Path] = (model, *list(model.parents)[:3])
    names = ("colmap", SPARSE)  # of folders in a scene's that lead to its model
    outer = folders[1:] if is_numbered(model) else folders
    own = next((folder for folder in outer if folder.name not in names), model)
    # Links may lead to a model elsewhere.
    for folder in (*folders, *list(named.parents)[:3]):
        if photograph_folder(folder) is not None or (folder == own and _has_photographs(folder)):
            return folder
    return own


def _has_photographs(folder: Path) -> bool:
    """Whether there are photographs in a folder, but for folders within it."""
    with suppress(OSError):
        return any(is_photograph(path.name) for path in folder.iterdir())
    return False
