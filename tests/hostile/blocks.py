"""Folders of scenes in blocks, with other values, links, pipes and folders in them."""

from __future__ import annotations

import json
import random
from pathlib import Path

from tests.hostile.running import Case, fresh
from tests.hostile.scene_files import PLACES
from tests.hostile.values import mutated

NAMES = ("blocks.json", "train.json", "block-0.part.json", "block-0.log", "block-0")
TRAIN = ("train-blocks", "blocks", "--only", "0", "--threads", "1")
FEW = ("--", "--steps", "2", "--voxels", "512")
COMMANDS = (
    *([*TRAIN], [*TRAIN], ["eval", "blocks"]),
    ["blocks", "blocks/block-0.part.json", "--count", "2", "--output", "out"],
)


def damage(rng: random.Random, folder: Path) -> str:
    """Change a file of the folder, or put something else in its place; what was changed."""
    file = folder / rng.choice(NAMES)
    if file.suffix == ".json" and rng.random() < 0.6:
        file.write_text(json.dumps(mutated(rng, json.loads(file.read_text()))))
        return f"other values in {file.name}"
    if rng.random() < 0.5:
        file.unlink(missing_ok=True)
        file.symlink_to(folder.parent / "precious" / rng.choice(("file", "none", "")))
        return f"a link for {file.name}"
    file.touch()
    rng.choice(PLACES)(file)
    return f"something else for {file.name}"


def case(rng: random.Random, folder: Path, base: Path) -> Case:
    """A command over a damaged folder.

    Args:
        rng: Decides.
        folder: Of the case.
        base: Holds "blocks", which are not trained.
    """
    blocks = fresh(folder, base / "blocks") / "blocks"
    (folder / "precious" / "empty").mkdir(parents=True)
    (folder / "precious" / "file").write_text("precious")
    stored = rng.choice((["--output", "../precious/run"], ["--overwrite"], []))
    options = ["--steps", "2", "--voxels", "512", *stored]
    (blocks / "train.json").write_text(json.dumps({"options": options}))
    said, words = damage(rng, blocks), list(rng.choice(COMMANDS))
    if words[0] == "train-blocks" and "train.json" in said:  # else it may train for long
        words += FEW
    return Case(words=words, said=f"{said}, {stored}", written=("blocks", "out"))
