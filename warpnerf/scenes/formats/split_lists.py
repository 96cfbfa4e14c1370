"""Lists of photographs beside a COLMAP capture that say which are for training and for testing."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import exists, printable

LISTS = {"train_list.txt": "train", "test_list.txt": "test", "validation_list.txt": "val"}
"""Files in a scene's folder, as nerfstudio names them, and the split that each holds."""


def read_split_lists(
    folder: Path, names: Collection[str]
) -> tuple[dict[str, set[str]], list[str], list[str]]:
    """Read the lists of a scene's folder.

    Args:
        folder: The scene's.
        names: Of its photographs, as the model has them.

    Returns:
        Names for each split that has a list, notes, and warnings.

    Raises:
        InputError: A list cannot be read, or none of its lines names a photograph.
    """
    splits: dict[str, set[str]] = {}
    warnings = []
    for file, split in LISTS.items():
        path = folder / file
        if not exists(path):
            continue
        try:
            lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{path}: cannot be read as text ({error}); mend or remove it."
            ) from None
        listed = {line if line in names else line.removeprefix("images/") for line in lines if line}
        lost = sorted(listed.difference(names))
        if lost and len(lost) == len(listed):
            raise InputError(
                f"{path}: names no photograph of the model (first: {printable(lost[0][:80])}); "
                "name them as the model does, one a line, or remove the file."
            )
        if lost:
            warnings.append(
                f"{file}: {len(lost)} of {len(listed)} photographs are not in the model (first: "
                f"{printable(lost[0][:80])})"
            )
        splits[split] = listed.intersection(names)
    if not splits:
        return {}, [], []
    used = ", ".join(file for file, split in LISTS.items() if split in splits)
    return splits, [f"training and test photographs are those of {used}"], warnings
