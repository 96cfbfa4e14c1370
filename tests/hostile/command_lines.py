"""Command lines with hostile words, and processes with little of everything."""

from __future__ import annotations

import random
import resource
from pathlib import Path

from tests.hostile.running import Case, fresh
from tests.hostile.values import WORDS
from tests.support.cli_process import TINY
from warpnerf.cli.arguments import flags_of
from warpnerf.cli.main import COMMANDS

BEGINNINGS: dict[str, tuple[str, ...]] = {
    "train": ("scene", "--output", "out/run", *TINY, "--eval-views", "1"),
    "inspect": ("scene",),
    "pose": ("none", "--output", "out/scene"),
    "compare": ("scene", "--output", "out/compared", "--steps", "2", "--threads", "0"),
    "eval": ("run",),
    "render": ("run", "--size", "8", "6", "--seconds", "0.1", "--output", "out/film"),
    "export": ("run", "out/mesh.ply", "--level", "0.01"),
    "view": ("none",),
    "runs": (".",),
    "demo": ("--output", "out/demo", "--steps", "2", "--downscale", "32", "--threads", "0"),
    "check": ("--threads", "0"),
    "warmup": ("--threads", "0", "--none"),
}
"""What each subcommand is given first, with which it ends soon; view, demo, compare, check and
warmup would not, so that theirs are wrong from the start."""

UNSENT = ("--view", "--help", "--help-all")
"""Serves a page; prints."""


def case(rng: random.Random, folder: Path, base: Path) -> Case:
    """A command with one to three options of hostile words."""
    fresh(folder, base / "run", base / "scene")
    name = rng.choices(list(BEGINNINGS), [8, 5, 2, 2, 3, 3, 3, 1, 1, 1, 1, 1])[0]
    flags = sorted(flags_of(COMMANDS[name]) - set(UNSENT))
    words = [name, *BEGINNINGS[name]]
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        flag = rng.choice(flags)
        change = rng.random()
        if change < 0.55:
            words += [flag, rng.choice(WORDS)]
        elif change < 0.75:
            words += [f"{flag}={rng.choice(WORDS)}"]
        elif change < 0.85:
            words += [flag, *rng.choices(WORDS, k=rng.choice((2, 3, 6)))]
        elif change < 0.92:
            words.insert(rng.randrange(len(words) + 1), rng.choice(WORDS))
        else:
            words += [flag + rng.choice(("x", ".", "-", "_")), rng.choice(WORDS)]
    words = [w for w in words if "\0" not in w]
    values = ["run/visibility.safetensors", *words, *(word.partition("=")[2] for word in words)]
    written = ("out", *(w for w in values if w and not w.startswith(("-", "/", "."))))
    keep = {"run", "scene", "."}
    case = Case(words=words, written=tuple(w for w in written if w not in keep and len(w) < 200))
    if rng.random() < 0.1:
        case.env = rng.choice(
            (
                *({"COLUMNS": w} for w in ("1", "0", "-1", "x", "99999")),
                *({"HOME": "/nonexistent"}, {"TERM": "x"}, {"LANG": "x", "LC_ALL": "x"}),
                *({"NO_COLOR": "1"}, {"PYTHONWARNINGS": "x"}, {"OMP_NUM_THREADS": "x"}),
            )
        )
    return case


def starved(rng: random.Random, folder: Path, base: Path) -> Case:
    """A good command in a process with few descriptors, little memory, or small files."""
    fresh(folder, base / "run", base / "scene")
    words = rng.choice(
        (
            ["train", "scene", "--output", "out/run", *TINY],
            ["train", "--resume", "run"],
            ["inspect", "scene", "--json", "out.json"],
            ["export", "run", "out.ply", "--level", "0.01", "--unseen"],
            ["render", "run", "--size", "8", "6", "--seconds", "0.1", "--output", "out"],
            ["eval", "run", "--json", "out.json"],
            ["runs", "."],
        )
    )
    what, most = rng.choice(
        (
            (resource.RLIMIT_NOFILE, rng.choice((3, 4, 5, 6, 8, 10, 14, 20))),
            (resource.RLIMIT_FSIZE, rng.choice((0, 1, 100, 3000, 20_000))),
        )
    )
    written = ("run", "out", "out.json", "out.ply")
    return Case(words=list(words), limits={what: most}, said="starved", written=written)
