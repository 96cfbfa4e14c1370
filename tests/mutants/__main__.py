"""Break the kernels on purpose, one line at a time, and show that the tests notice each time.

    python tests/mutants [--jobs N] [NAME ...]

Each mutant is a copy of kernels/, warpnerf/ and tests/ in a temporary folder with one text
replaced; the working tree stays as it is. A mutant is killed when the tests named for it run and
one of them fails; code that no longer compiles or cannot be collected does not count. Exits with 1
if a mutant survives, breaks, or no longer finds its text.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import heads
import losses
import ndc
import packed
import plain
import scatter
import schedule
from mutant import KERNELS, Mutant

ROOT = Path(__file__).parent.parent.parent
COPIED = ("kernels", "warpnerf", "tests")
TIME_LIMIT = 300.0
"""Seconds for the tests of one mutant; one that runs longer never ends, and is noticed as well."""

MUTANTS = (
    *plain.MUTANTS,
    *packed.MUTANTS,
    *scatter.MUTANTS,
    *schedule.MUTANTS,
    *heads.MUTANTS,
    *losses.MUTANTS,
    *ndc.MUTANTS,
)


def copy_to(folder: Path) -> None:
    for name in COPIED:
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    shutil.copy(ROOT / "pyproject.toml", folder)


def run_tests(
    folder: Path, tests: list[str], cache: Path, limit: float | None = None
) -> tuple[int | None, str]:
    """pytest's exit status (None: out of time) and output, in a copy of the repository."""
    environment = os.environ | {
        "PYTHONPATH": f"{folder}{os.pathsep}{folder / 'kernels'}",
        "PYTHONDONTWRITEBYTECODE": "1",
        "WARP_CACHE_PATH": str(cache),
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-n0",
        "-m",
        "",
        "-p",
        "no:cacheprovider",
    ]
    command += ["--tb=short", *(f"tests/{name}" for name in tests)]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=limit,
        )
    except subprocess.TimeoutExpired:
        return None, ""
    return done.returncode, done.stdout + done.stderr


def check(mutant: Mutant, folder: Path, cache: Path) -> tuple[str, str]:
    """Whether it is "killed", "survived" or "broken", and what says so."""
    folder = folder / str(MUTANTS.index(mutant))
    folder.mkdir()
    copy_to(folder)
    mutant.apply(folder)
    status, output = run_tests(folder, [mutant.tests], cache, TIME_LIMIT)
    shutil.rmtree(folder)
    if status is None:
        return "killed", "never ends"
    if status in (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS):
        return "killed", "crashes"
    if status == 0:
        return "survived", mutant.tests
    failed = [line for line in output.splitlines() if line.startswith("FAILED ")]
    noticed = "AssertionError" in output or "\nE       assert" in output or "\nE   assert" in output
    if status == 1 and failed and noticed:
        return "killed", failed[0].removeprefix("FAILED tests/").split(" - ")[0]
    return "broken", output[-1500:]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="of mutants or their files, in part; none: all")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chosen = [
        m
        for m in MUTANTS
        if not options.names or any(name in f"{m.file} {m.name}" for name in options.names)
    ]
    counts = {"killed": 0, "survived": 0, "broken": 0}
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder, cache = Path(name), Path(name) / "cache"
        # Without a mutation the same tests pass, in the copy: else their failing would say nothing.
        whole = folder / "whole"
        whole.mkdir()
        copy_to(whole)
        for mutant in chosen:  # all texts are found before the long work begins
            text = (whole / KERNELS / mutant.file).read_text()
            mutant.apply(whole)
            (whole / KERNELS / mutant.file).write_text(text)
        status, output = run_tests(whole, sorted({m.tests for m in chosen}), cache)
        if status != 0:
            print(output[-3000:])
            print("the tests fail without any mutation")
            return 1
        with ThreadPoolExecutor(options.jobs) as pool:
            results = pool.map(lambda mutant: check(mutant, folder, cache), chosen)
            for mutant, (verdict, reason) in zip(chosen, results, strict=True):
                counts[verdict] += 1
                print(f"{verdict:9}{mutant.file:20}{mutant.name:52}{reason}", flush=True)
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    print(f"{len(chosen)} mutants: {summary}; {time.monotonic() - started:.0f} s")
    return 0 if counts["killed"] == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
