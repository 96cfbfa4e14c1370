"""Train/test split: which photographs are withheld from training, where that is chosen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from warpnerf.checks import InputError, require_whole, said
from warpnerf.scenes.files import by_number, plain_name, printable, read_names

Split = Literal["all", "sector"] | int | tuple[str, ...]
"""all: none is withheld; sector: an eighth that stand side by side; a number N: every Nth, by
name from the first; names: these."""

SECTOR = 8
"""One photograph of so many is in a sector."""


def checked_split(split: object) -> Split:
    """A split, or InputError where it is none.

    Args:
        split: all, sector, a number of at least 2, or names of photographs.
    """
    if isinstance(split, list | tuple) and split and all(isinstance(name, str) for name in split):
        return tuple(split)
    if split in ("all", "sector"):
        return split
    if isinstance(split, int):
        require_whole("split", split, 2)
        return split
    raise InputError(
        "split must be all, sector, a number of at least 2 or names of photographs, not "
        f"{said(split)}."
    )


def read_split(text: str | Split | list[str]) -> Split:
    """A split as the command takes it: all, sector, a number, or a file that lists photographs.

    Args:
        text: One of these, or a split already.

    Raises:
        InputError: It is none, or the file cannot be read or is empty.
    """
    if not isinstance(text, str) or text in ("all", "sector"):
        return checked_split(text)
    if text.isdecimal():
        return checked_split(int(text[:20]))
    path = Path(text)
    if not path.is_file():
        raise InputError(
            f"--split must be all, sector, a number of at least 2, or a file with a photograph's "
            f"name on each line, not {said(text)}."
        )
    names = tuple(dict.fromkeys(read_names(path, "--split")))
    if not names:
        raise InputError(f"--split {path}: names no photograph; name one on each line.")
    return names


def withheld(
    split: Split, names: Sequence[str], poses: Sequence[np.ndarray]
) -> tuple[set[str], str]:
    """Which photographs are for testing.

    Args:
        split: How they are chosen.
        names: Of all photographs.
        poses: [3, 4] camera to world of each.

    Returns:
        Their names, and a note that says which they are.

    Raises:
        InputError: Names are of no photograph of the scene, or none is left to train on.
    """
    n = len(names)
    if split == "all":
        return set(), f"no photograph is withheld for testing: all {n} are trained on"
    if isinstance(split, tuple):
        chosen, how = _listed(split, names), "those of the list"
    elif split == "sector":
        chosen, how = _sector(names, poses), "a sector, side by side"
    else:
        chosen = set(sorted(names, key=by_number)[:: int(split)])
        how = f"one in {split} by name"
    if len(chosen) == n:
        raise InputError(
            f"--split withholds all {n} photographs, and none is left to train on; withhold fewer."
        )
    first = printable(min(chosen, key=by_number))
    return chosen, f"withheld for testing: {len(chosen)} of {n} photographs, {how} (first: {first})"


def _listed(split: tuple[str, ...], names: Sequence[str]) -> set[str]:
    """Photographs by their names, or by those of their files where these are unique."""
    files: dict[str, list[str]] = {}
    for name in names:
        files.setdefault(Path(name).name, []).append(name)
    chosen = set()
    for listed in split:
        given = plain_name(listed)
        found = [given] if given in names else files.get(Path(given).name, [])
        if len(found) != 1:
            what = "no photograph of the scene" if not found else f"{len(found)} photographs"
            raise InputError(
                f"--split names {printable(given[:80])}, which is {what}; name them as the scene "
                f"does, such as {printable(names[0])}."
            )
        chosen.add(found[0])
    return chosen


def _sector(names: Sequence[str], poses: Sequence[np.ndarray]) -> set[str]:
    """The photographs next to the first by name, by the angle around the middle of all cameras.

    The angle is in the plane in which the cameras' places differ most.
    """
    order = sorted(range(len(names)), key=lambda k: by_number(names[k]))
    places = np.array([poses[k][:, 3] for k in order])
    places = places - places.mean(axis=0)
    _, _, axes = np.linalg.svd(places, full_matrices=True)
    angle = np.arctan2(*(places @ axes[:2].T).T)
    around = (angle - angle[0]) % (2.0 * np.pi)
    count = max(1, round(len(names) / SECTOR))
    return {names[order[k]] for k in np.argsort(around, kind="stable")[:count]}
