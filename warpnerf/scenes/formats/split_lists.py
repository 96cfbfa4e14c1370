"""Lists of photographs beside a COLMAP capture that say which are for training and for testing."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import exists, plain_name, printable, read_names

LISTS = {"train_list.txt": "train", "test_list.txt": "test", "validation_list.txt": "val"}
"""Files in a scene's folder, as nerfstudio names them, and the split that each holds."""


WORDS = {"train": "training", "test": "test", "val": "validation"}


def read_split_lists(
    folder: Path, there: Collection[str], of_model: Collection[str]
) -> tuple[dict[str, set[str]], list[str], list[str]]:
    """Read the lists of a scene's folder.

    With a list of training photographs and none of test photographs, the others are for testing.

    Args:
        folder: The scene's.
        there: Names of its photographs, as the model has them.
        of_model: Names of all that the model has, some of which may not be there.

    Returns:
        Names for each split that has a list, notes, and warnings.

    Raises:
        InputError: A list cannot be read, or none of its lines names a photograph.
    """
    splits: dict[str, set[str]] = {}
    warnings, told = [], []
    known = {plain_name(name): name for name in of_model}
    for file, split in LISTS.items():
        path = folder / file
        if not exists(path):
            continue
        listed = {_named(line, known) for line in read_names(path)}
        if not listed:
            warnings.append(f"{file}: is empty, and not used")
            continue
        lost = sorted(listed.difference(of_model))
        if len(lost) == len(listed):
            raise InputError(
                f"{path}: names no photograph of the model (first: {printable(lost[0][:80])}); "
                "name them as the model does, one a line, or remove the file."
            )
        if lost:
            warnings.append(
                f"{file}: {len(lost)} of {len(listed)} photographs are not in the model (first: "
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


def _named(line: str, known: Mapping[str, str]) -> str:
    """The photograph that a line names, by the model's name; the line itself where it is none."""
    name = plain_name(line)
    return known.get(name) or known.get(name.removeprefix("images/")) or line
