"""Folders of runs that are damaged, or in which links, pipes and folders stand for files."""

from __future__ import annotations

import json
import random
from pathlib import Path

from tests.hostile.running import Case, fresh
from tests.hostile.scene_files import PLACES, bytes_changed
from tests.hostile.values import mutated
from tests.support.cli_process import TINY

SEEN = "run/visibility.safetensors"
"""What an export keeps for the next."""

NAMES = (
    "visibility.safetensors",
    *("config.json", "log.jsonl", "metrics.json", "field.safetensors", "test.png", ".lock"),
    *("checkpoint", "test", "previous", "scene", "next", "scene/pose.json", "test/000.png"),
)


def damage(rng: random.Random, run: Path) -> str:
    """Change one file of a run; what was changed."""
    name = rng.choice(NAMES)
    if name == "checkpoint":
        name = rng.choice(sorted(path.name for path in run.glob("checkpoint-*")))
    file = run / name
    if name == "scene/pose.json":
        return _posed(rng, run)
    if file.suffix in (".json", ".jsonl") and file.is_file() and rng.random() < 0.6:
        lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
        at = rng.randrange(len(lines))
        lines[at] = json.dumps(mutated(rng, json.loads(lines[at])))
        file.write_text("\n".join(lines), errors="surrogatepass")
        return f"other values in {name}"
    if file.is_file() and rng.random() < 0.4:
        bytes_changed(rng, file)
        return f"other bytes in {name}"
    return _replaced(rng, run, file)


def _replaced(rng: random.Random, run: Path, file: Path) -> str:
    """A link to what is precious, a pipe, a folder, or nothing, in place of a file or folder."""
    precious = run.parent / "precious"
    if file.is_dir():
        for path in sorted(file.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        file.rmdir()
        file.symlink_to(precious / rng.choice(("", "no", "file")))
        return f"a link for the folder {file.name}"
    file.parent.mkdir(exist_ok=True, parents=True)
    if not file.exists():
        file.touch()
    if rng.random() < 0.5:
        file.unlink()
        file.symlink_to(precious / rng.choice(("file", "none", "")))
        return f"a link for {file.name}"
    rng.choice(PLACES)(file)
    return f"something else for {file.name}"


def _posed(rng: random.Random, run: Path) -> str:
    """A record of what posing wrote that names what it did not."""
    scene = run / "scene"
    scene.mkdir(exist_ok=True)
    outside = [str(run.parent / "precious"), "../../precious", "/", ".", "..", "", "a/../../x"]
    written = rng.sample(outside, 3)
    (scene / "pose.json").write_text(
        json.dumps({"written": written, "inputs": {}, "registered": 3})
    )
    return f"pose.json names {written}"


def case(rng: random.Random, folder: Path, base: Path) -> Case:
    """A command over a damaged run.

    Args:
        rng: Decides.
        folder: Of the case.
        base: Holds "run", which is whole, and "scene", which it was trained on.
    """
    fresh(folder, base / "run", base / "scene")
    (folder / "precious" / "empty").mkdir(parents=True)
    (folder / "precious" / "file").write_text("precious")
    run = folder / "run"
    config = json.loads((run / "config.json").read_text())
    config["scene"] = str(folder / "scene")
    (run / "config.json").write_text(json.dumps(config))
    said = damage(rng, run)
    words, written = rng.choice(
        (
            (["train", "--resume", "run"], ("run",)),
            (["train", "--resume", "run"], ("run",)),
            (["train", "scene", "--output", "run", "--overwrite", *TINY], ("run",)),
            (["train", "scene", "--output", "run", *TINY], ("run",)),
            (["train", "--config", "run/config.json", "--output", "out", *TINY], ("out",)),
            (["eval", "run", "--json", "out.json"], ("out.json",)),
            (
                ["render", "run", "--seconds", "0.1", "--size", "8", "6", "--output", "out"],
                ("out",),
            ),
            (["export", "run", "out.ply", "--level", "0.01", "--unseen"], ("out.ply", SEEN)),
            (["export", "run", "out.npz"], ("out.npz", SEEN)),
            (["runs", "."], ()),
            (["runs", ".", "--clean"], ("run",)),
        )
    )
    if rng.random() < 0.05:
        run.chmod(0o500)
    return Case(words=list(words), said=said, written=written)
