"""Lists of photographs beside a capture that say which are for training and for testing."""

from __future__ import annotations

import itertools
import os
from collections.abc import Collection, Mapping
from pathlib import Path

from warpnerf.checks import InputError
from warpnerf.scenes.files import exists, plain_name, printable, read_names

LISTS = (
    {"train": "train_list.txt", "test": "test_list.txt", "val": "validation_list.txt"},
    {"train": "train.txt", "test": "test.txt", "val": "val.txt"},
)
"""Files that hold each split, as nerfstudio names them, and as 3DGS does; also in the folder of a
COLMAP model. Another program's train.txt may be no list of photographs."""

NERFSTUDIO = "_list.txt"
"""How the names end that nothing else has."""

BELIEVED = 0.9
"""Share of the lines of another file that must name photographs."""

WORDS = {"train": "training", "test": "test", "val": "validation"}


def read_split_lists(
    folder: Path,
    there: Collection[str],
    of_model: Collection[str],
    model: Path | None = None,
) -> tuple[dict[str, set[str]], list[str], list[str]]:
    """Read the lists of a scene's folder: those of one place and of one program.

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
    warnings: list[str] = []
    told: list[str] = []
    aside: list[str] = []
    known = _known(of_model)
    whole = "the scene" if model is None else "the model"
    places = [folder] if model is None or model.samefile(folder) else [folder, model]
    for place, names in itertools.product(places, LISTS):
        paths = {split: place / name for split, name in names.items() if exists(place / name)}
        files = {split: _shown(path, folder) for split, path in paths.items()}
        if splits:
            aside += files.values()
            continue
        for split, path in paths.items():
            listed, warning = _read_list(path, files[split], known, whole)
            warnings += warning
            if not listed:
                continue
            splits[split] = listed.intersection(there)
            if not splits[split]:
                raise InputError(
                    f"{path}: none of {whole}'s photographs that it names is there (first: "
                    f"{printable(min(listed)[:80])}); put them there, or remove the file."
                )
            told.append(f"{WORDS[split]} photographs are those of {files[split]}")
    if "train" in splits and "test" not in splits:
        rest = set(there).difference(*splits.values())
        if rest:
            splits["test"] = rest
            told.append("all others are for testing")
    notes = [", ".join(told)] if told else []
    if aside:
        notes.append(f"not used, beside these lists: {', '.join(aside)}")
    return splits, notes, warnings


def _shown(path: Path, folder: Path) -> str:
    return printable(Path(os.path.relpath(path, folder)).as_posix())


def _read_list(
    path: Path, file: str, known: Mapping[str, str], whole: str
) -> tuple[set[str], list[str]]:
    """The photographs that a list names, and warnings; none where it is not used.

    Args:
        path: Of the list.
        file: Its name for messages.
        known: Photographs by what a line may call them.
        whole: What has them, in words.

    Raises:
        InputError: As ``read_split_lists``.
    """
    certain = path.name.endswith(NERFSTUDIO)
    try:
        lines = set(read_names(path))
    except InputError:
        if certain:
            raise
        return set(), [f"{file}: cannot be read as text, and is not used"]
    if not lines:
        return set(), [f"{file}: is empty, and not used"]
    found = {line: _named(line, known) for line in lines}
    listed = {name for name in found.values() if name is not None}
    lost = sorted(line for line, name in found.items() if name is None)
    if not lost:
        return listed, []
    first = printable(lost[0][:80])
    share = f"{len(lost)} of {len(lines)}"
    if not certain and len(lines) - len(lost) < BELIEVED * len(lines):
        where = f" in {share} lines" if listed else ""
        said = f"names no photograph of {whole}{where} (first: {first}), and is not used"
        return set(), [f"{file}: {said}"]
    if not listed:
        raise InputError(
            f"{path}: names no photograph of {whole} (first: {first}); name them as {whole} does, "
            "one a line, or remove the file."
        )
    return listed, [f"{file}: {share} photographs are not in {whole} (first: {first})"]


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


def _named(line: str, known: Mapping[str, str]) -> str | None:
    """The photograph that a line names, by the scene's name; None: none."""
    name = plain_name(line)
    return known.get(name) or known.get(name.removeprefix("images/"))
