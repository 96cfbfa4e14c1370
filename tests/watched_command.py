"""The command in a subprocess: ended after ten seconds, and watched for what it writes where."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tiny_scenes import save, write_transforms

LIMIT = 240.0
"""Seconds after which a command counts as hung, on a busy machine that compiles kernels too."""

Change = Callable[[dict[str, Any]], object]


def make_scene(folder: Path, change: Change | None = None) -> Path:
    """Four images of 16 x 12 pixels around the origin; the first is the test view.

    ``change`` is given the content of transforms.json, to change it in place.
    """
    content = write_transforms(folder / "scene", 4, scale=2)
    if change is not None:
        change(content)
        save(folder / "scene" / "transforms.json", content)
    return folder / "scene"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a command did."""

    code: int
    out: str
    err: str
    run: Path
    """The folder that it was told to write to."""


def command(
    *arguments: str | Path,
    folder: Path,
    env: Mapping[str, str] | None = None,
    limit: float | None = LIMIT,
    prelude: str = "",
) -> Outcome:
    """Run the command in a folder, in which nothing may change but its subfolder "run".

    Temporary files go there too, so that what is left of them shows.

    Args:
        arguments: Of the command.
        folder: Where to run it.
        env: Variables besides those of this process.
        limit: Seconds; None: as long as it takes.
        prelude: Python that is run first, in the command's process.
    """
    (folder / "tmp").mkdir(exist_ok=True)
    found = _listing(folder)
    program = ["-m", "warpnerf"]
    if prelude:
        program = [
            "-c",
            f"{prelude}\nimport sys, warpnerf.cli.main\nsys.exit(warpnerf.cli.main.main())",
        ]
    done = subprocess.run(
        [sys.executable, *program, *map(str, arguments)],
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder / "tmp"), **(env or {})},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=limit,
    )
    assert _listing(folder) == found, "wrote outside its output folder"
    return Outcome(code=done.returncode, out=done.stdout, err=done.stderr, run=folder / "run")


def train(scene: str | Path, *options: str | Path, folder: Path, **how: Any) -> Outcome:
    """Train two steps of a tiny grid into the folder "run"."""
    tiny = ("--steps", "2", "--threads", "1", "--voxels", "512")
    return command(
        "train", scene, "--output", folder / "run", *tiny, *options, folder=folder, **how
    )


def assert_refused(outcome: Outcome, *says: str) -> None:
    """One sentence with all these words, exit code 2, and nothing left behind."""
    said = outcome.out + outcome.err
    assert outcome.code == 2, said
    sentence = _own_lines(outcome.err)
    assert len(sentence) == 1, said
    assert sentence[0].startswith("warpnerf: error: ") and sentence[0].endswith("."), said
    for words in says:
        assert words in sentence[0]
    assert len(sentence[0]) < 600
    assert "Traceback" not in said
    assert not os.path.lexists(outcome.run)


def assert_trained(outcome: Outcome, *warnings: str) -> None:
    """A whole run, with a line of warning for each of these words and no other."""
    said = outcome.out + outcome.err
    assert outcome.code == 0, said
    assert not _own_lines(outcome.err)
    assert (outcome.run / "metrics.json").is_file()
    assert len(list((outcome.run / "test").glob("*.png"))) == 1
    lines = [line for line in outcome.out.splitlines() if "warning" in line]
    assert len(lines) == len(warnings), said
    for words in warnings:
        assert any(words in line for line in lines), said


def _own_lines(err: str) -> list[str]:
    """Without the line that Warp's library writes where there is no CUDA driver."""
    return [line for line in err.splitlines() if not line.startswith("Warp CUDA warning")]


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """All that is in a folder but the run: type and permissions, and time of the last change."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_relative_to(folder / "run"):
            continue
        status = path.lstat()
        found[str(path)] = (status.st_mode, 0 if path.is_dir() else status.st_mtime_ns)
    return found
