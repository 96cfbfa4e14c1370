"""Lists of photographs beside a capture that say which are for training and for testing."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import exists, plain_name, printable, read_names

LISTS = {
    "train": ("train_list.txt", "train.txt"),
    "test": ("test_list.txt", "test.txt"),
    "val": ("validation_list.txt", "val.txt"),
}
"""Files that hold each split, as nerfstudio names them, and as 3DGS does, also in the folder of a
COLMAP model. Another program's train.txt may be no list of photographs."""

NERFSTUDIO = "_list.txt"
"""How the names end that nothing else has."""

WORDS = {"train": "training", "test": "test", "val": "validation"}


def read_split_lists(
    folder: Path,
    there: Collection[str],
    of_model: Collection[str],
    model: Path | None = None,
) -> tuple[dict[str, set[str]], list[str], list[str]]:
    """Read the lists of a scene's folder.

    With a list of training photographs and none of test photographs, the others are for testing.

    Args:
        folder: The scene's.
        there: Names of its photographs, as the model has them.
        of_model: Names of all that the model has, some of which may not be there.
        model: The folder of a COLMAP model, where there may be lists too; None: the scene has none.

    Returns:
        Names for each split that has a list, notes, and warnings.

    Raises:
        InputError: A list cannot be read, or none of its lines names a photograph.
    """
    splits: dict[str, set[str]] = {}
    warnings, told = [], []
    known = _known(of_model)
    whole = "the scene" if model is None else "the model"
    for split, names in LISTS.items():
        places = [folder, folder if model is None else model]
        path = next((p / name for p in places for name in names if exists(p / name)), None)
        if path is None:
            continue
        file = printable(Path(os.path.relpath(path, folder)).as_posix())
        try:
            listed = {_named(line, known) for line in read_names(path)}
        except InputError:
            if path.name.endswith(NERFSTUDIO):
                raise
            warnings.append(f"{file}: cannot be read as text, and is not used")
            continue
        if not listed:
            warnings.append(f"{file}: is empty, and not used")
            continue
        lost = sorted(listed.difference(of_model))
        if len(lost) == len(listed):
            first = printable(lost[0][:80])
            if not path.name.endswith(NERFSTUDIO):
                warnings.append(
                    f"{file}: names no photograph of {whole} (first: {first}), and is not used"
                )
                continue
            raise InputError(
                f"{path}: names no photograph of {whole} (first: {first}); name them as "
                f"{whole} does, one a line, or remove the file."
            )
        if lost:
            warnings.append(
                f"{file}: {len(lost)} of {len(listed)} photographs are not in {whole} (first: "
                f"{printable(lost[0][:80])})"
            )
        splits[split] = listed.intersection(there)
        if not splits[split]:
            first = printable(min(listed.intersection(of_model))[:80])
            raise InputError(
                f"{path}: none of the model's photographs that it names is there (first: {first}); "
                "put them there, or remove the file."
            )
        told.append(f"{WORDS[split]} photographs are those of {file}")
    if "train" in splits and "test" not in splits:
        rest = set(there).difference(*splits.values())
        if rest:
            splits["test"] = rest
            told.append("all others are for testing")
    return splits, [", ".join(told)] if told else [], warnings


def _known(names: Collection[str]) -> dict[str, str]:
    """Photographs by what a line may call them: their names, also without folders or extension
    where only one is called so."""
    called: dict[str, set[str]] = {}
    for name in names:
        plain = plain_name(name)
        last = plain.rpartition("/")[2]
        stem = last.rpartition(".")[0] or last
        for short in {last, stem, plain.removesuffix(last) + stem}:
            called.setdefault(short, set()).add(name)
    alone = {short: min(of) for short, of in called.items() if len(of) == 1}
    return alone | {plain_name(name): name for name in names}


def _named(line: str, known: Mapping[str, str]) -> str:
    """The photograph that a line names, by the scene's name; the line itself where it is none."""
    name = plain_name(line)
    return known.get(name) or known.get(name.removeprefix("images/")) or line
