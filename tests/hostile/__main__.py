"""The command ``python -m tests.hostile``."""

from __future__ import annotations

import argparse
import os
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "kernels"))

from tests.hostile import blocks, command_lines, python_calls, runs, scene_files
from tests.hostile.running import Case, outcome
from tests.support.cli_process import TINY, make_scene
from tests.support.command_server import redirect
from warpnerf.runtime.signals import Stopped

Make = Callable[[random.Random, Path], Case]
PATH = """{"warpnerf_path": 1, "width": 8, "height": 6, "keys": [
  {"seconds": 0.0, "fov": 50.0, "c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3]]},
  {"seconds": 2.0, "fov": 50.0, "c2w": [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 3]]}]}"""


class Harness:
    """Makes cases of all families, and runs them."""

    def __init__(self, place: Path) -> None:
        """Train the run of which cases have copies; loads all that forks then have."""
        self.place, self.base = place, place / "base"
        self.base.mkdir()
        scene = make_scene(self.base)
        (self.base / "path.json").write_text(PATH)
        words = [
            "train",
            str(scene),
            "--output",
            str(self.base / "run"),
            *TINY,
            "--keep",
            "checkpoint",
        ]
        self._quietly(words)
        self._quietly(["blocks", str(scene), "--count", "2", "--output", str(self.base / "blocks")])
        calls = python_calls.targets(self.base)
        base = self.base
        self.families: dict[str, tuple[Make, int]] = {
            "options": (lambda rng, folder: command_lines.case(rng, folder, base), 8),
            "colmap": (scene_files.colmap, 4),
            "llff": (scene_files.llff, 3),
            "npz": (scene_files.npz, 3),
            "transforms": (scene_files.transforms, 5),
            "photographs": (scene_files.photographs, 3),
            "runs": (lambda rng, folder: runs.case(rng, folder, base), 5),
            "blocks": (lambda rng, folder: blocks.case(rng, folder, base), 2),
            "starved": (lambda rng, folder: command_lines.starved(rng, folder, base), 2),
            "python": (lambda rng, folder: python_calls.case(rng, folder, base, calls), 12),
        }

    def _quietly(self, words: list[str]) -> None:
        """Run the command in this process."""
        from warpnerf.cli.main import main

        streams = [os.dup(k) for k in (1, 2)]
        kept = sys.stdin, sys.stdout, sys.stderr
        redirect(os.devnull, os.devnull)
        try:
            code = main(words)
        finally:
            sys.stdin, sys.stdout, sys.stderr = kept
            for number, stream in zip((1, 2), streams, strict=True):
                os.dup2(stream, number)
                os.close(stream)
        assert code == 0, f"{words[0]} failed"

    def attempt(self, family: str, seed: int, number: int) -> tuple[Case, str | None]:
        """Make a case by its numbers and run it.

        Returns:
            The case, and what is wrong with how it ended.
        """
        rng = random.Random(f"{family} {seed} {number}")
        folder = self.place / "case"
        case = self.families[family][0](rng, folder)
        try:
            return case, outcome(case, folder)
        finally:
            for path in folder.rglob("*"):
                if path.is_dir() and not path.is_symlink():
                    path.chmod(0o700)
            shutil.rmtree(folder, ignore_errors=True)

    def order(self, cases: int) -> list[str]:
        """Families, each as often as it weighs, spread over the whole."""
        total = sum(weight for _, weight in self.families.values())
        due = dict.fromkeys(self.families, 0.0)
        chosen = []
        for _ in range(cases):
            for name, (_, weight) in self.families.items():
                due[name] += weight / total
            name = max(due, key=lambda one: due[one])
            due[name] -= 1.0
            chosen.append(name)
        return chosen


def main() -> int:
    """Try cases; 1 if one of them ended otherwise than it may."""
    parser = argparse.ArgumentParser(description="Try hostile inputs; see tests/hostile.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cases", type=int, default=3000)
    parser.add_argument("--only", help="a family")
    parser.add_argument("--number", type=int, help="of the case of that family, as it is reported")
    parser.add_argument("--log", type=Path, help="a file that names each case before it is run")
    options = parser.parse_args()
    failed: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="hostile-") as place:
        harness = Harness(Path(place))
        chosen = harness.order(options.cases)
        if options.only:
            chosen = [options.only] * (1 if options.number is not None else options.cases)
        try:
            for family in chosen:
                number = tried[family] if options.number is None else options.number
                tried[family] += 1
                if options.log is not None:
                    with options.log.open("a") as log:
                        log.write(f"{family} {number}\n")
                case, wrong = harness.attempt(family, options.seed, number)
                if wrong is not None:
                    failed[family] += 1
                    print(f"{family} {number}: {case}\n    {wrong}", flush=True)
        except (KeyboardInterrupt, Stopped):
            print("stopped", flush=True)
            failed["stopped"] += 1
    seconds = time.monotonic() - begin
    print(f"{sum(tried.values())} cases in {seconds:.0f} s, {failed.total()} failed {dict(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
