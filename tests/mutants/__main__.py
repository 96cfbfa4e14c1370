"""Break the code on purpose, one line at a time, and show that the tests notice each time.

    python tests/mutants [--jobs N] [--cache FOLDER] [NAME ...]

NAME is part of a mutant's name or file: warpnerf/ chooses all of the host's code, kernels/ all of
the kernels. Each mutant is a copy of kernels/, warpnerf/ and tests/ in a temporary folder with one text
replaced; the working tree stays as it is. Its tests run in a fork of this process, which has imported
all but what is under test. A mutant is killed when the tests named for it run and
one of them fails; code that no longer compiles or cannot be collected does not count. Exits with 1
if a mutant survives, breaks, or no longer finds its text.
"""

import argparse
import contextlib
import importlib
import math
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import blocks
import factors
import hashed
import heads
import host_coarse_to_fine
import host_command
import host_exports
import host_folders
import host_formats
import host_measures
import host_operations
import host_output
import host_runs
import host_scenes
import host_training
import losses
import ndc
import optimisers
import packed
import plain
import resampled
import scatter
import schedule
from mutant import Mutant

ROOT = Path(__file__).parent.parent.parent
COPIED = ("kernels", "warpnerf", "tests")
TIME_LIMIT = 300.0
"""Seconds for the tests of one mutant; one that runs longer never ends, and is noticed as well."""

MUTANTS = (
    *plain.MUTANTS,
    *optimisers.MUTANTS,
    *packed.MUTANTS,
    *scatter.MUTANTS,
    *schedule.MUTANTS,
    *hashed.MUTANTS,
    *heads.MUTANTS,
    *blocks.MUTANTS,
    *factors.MUTANTS,
    *losses.MUTANTS,
    *ndc.MUTANTS,
    *resampled.MUTANTS,
    *host_training.MUTANTS,
    *host_scenes.MUTANTS,
    *host_folders.MUTANTS,
    *host_formats.MUTANTS,
    *host_output.MUTANTS,
    *host_measures.MUTANTS,
    *host_operations.MUTANTS,
    *host_runs.MUTANTS,
    *host_coarse_to_fine.MUTANTS,
    *host_command.MUTANTS,
    *host_exports.MUTANTS,
)

NOTICED = (
    "AssertionError",
    "\nE       assert",
    "\nE   assert",
    "\nE   Failed: DID NOT RAISE",
    "\nE   warpnerf.checks.InputError: ",
)
"""What a test says that has failed: of a value, or of a refusal too few or too many."""


PRELOADED = (
    *("pytest", "xdist", "pytest_timeout", "hypothesis", "numpy", "torch", "warp", "msgspec"),
    *("safetensors.numpy", "safetensors.torch", "PIL.Image", "imageio.v3", "tyro", "rich.table"),
    *("skimage.metrics", "cv2"),
)
"""What is imported once for all mutants, as far as it is there; none of it is under test."""


def output_of(folder: Path) -> Path:
    return folder / "output.txt"


def copy_to(folder: Path) -> None:
    for name in COPIED:
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    shutil.copy(ROOT / "pyproject.toml", folder)


def prepare(cache: Path) -> None:
    """Import, and start, what each run of pytest would: it is most of what a mutant takes."""
    os.environ |= {
        "PYTHONDONTWRITEBYTECODE": "1",
        "WARP_CACHE_PATH": str(cache),
        "OMP_NUM_THREADS": "1",
        "OMP_WAIT_POLICY": "passive",
        "CUDA_VISIBLE_DEVICES": "-1",  # which no fork could use
    }
    sys.dont_write_bytecode = True
    for name in PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)
    warp = sys.modules["warp"]
    warp.config.log_level = warp.LOG_ERROR
    warp.config.kernel_cache_dir = str(cache)
    warp.init()


def run_pytest(folder: Path, tests: list[str], marks: str) -> int:
    """pytest's exit status, in this process, which becomes one of a copy of the repository."""
    here = [str(folder), str(folder / "kernels")]
    sys.path[:1] = here  # instead of the folder of this script
    os.environ["PYTHONPATH"] = os.pathsep.join(here)
    os.chdir(folder)
    with output_of(folder).open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    options = ["-x", "-q", "-n0", "-m", marks, "-p", "no:cacheprovider", "--tb=short"]
    status = sys.modules["pytest"].main([*options, *(f"tests/{name}" for name in tests)])
    sys.stdout.flush()
    sys.stderr.flush()
    return int(status)


def start(folder: Path, tests: list[str], marks: str) -> int:
    """The number of a process that runs these tests in a copy of the repository."""
    child = os.fork()
    if child:
        return child
    status = 70  # of an error in here
    try:
        os.setsid()  # so that it ends with all that it has started
        status = run_pytest(folder, tests, marks)
    finally:
        os._exit(status)


def ended(running: dict[int, float]) -> tuple[int, int | None]:
    """The first process to end of those with a time at which they must; its exit status, None: it
    did not end in time."""
    while True:
        for child, limit in running.items():
            found, status = os.waitpid(child, os.WNOHANG)
            if found:
                return child, os.waitstatus_to_exitcode(status)
            if time.monotonic() > limit:
                os.killpg(child, signal.SIGKILL)
                os.waitpid(child, 0)
                return child, None
        time.sleep(0.02)


def verdict_of(mutant: Mutant, status: int | None, output: str) -> tuple[str, str]:
    """Whether it is "killed", "survived" or "broken", and what says so."""
    if status is None:
        return "killed", "never ends"
    if status in (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS):
        return "killed", "crashes"
    if status == 0:
        return "survived", mutant.tests
    failed = [line for line in output.splitlines() if line.startswith("FAILED ")]
    noticed = any(sign in output for sign in NOTICED)
    if status == 1 and failed and noticed:
        return "killed", failed[0].removeprefix("FAILED tests/").split(" - ")[0]
    return "broken", output[-1500:]


def check(mutants: list[Mutant], folder: Path, jobs: int) -> Iterator[tuple[Mutant, str, str]]:
    """Each mutant with its verdict and the reason, as they end."""
    running: dict[int, float] = {}
    of_child: dict[int, tuple[Mutant, Path]] = {}
    waiting = list(enumerate(mutants))
    while waiting or running:
        while waiting and len(running) < jobs:
            number, mutant = waiting.pop(0)
            copy = folder / str(number)
            copy.mkdir()
            copy_to(copy)
            mutant.apply(copy)
            child = start(copy, [mutant.tests], mutant.marks)
            running[child] = time.monotonic() + TIME_LIMIT
            of_child[child] = mutant, copy
        child, status = ended(running)
        del running[child]
        mutant, copy = of_child.pop(child)
        output = output_of(copy).read_text(errors="replace")
        shutil.rmtree(copy)
        yield mutant, *verdict_of(mutant, status, output)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="of mutants or their files, in part; none: all")
    parser.add_argument("--every", type=int, default=1, help="only every Nth of them")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cache", type=Path, help="compiled kernels, kept; none: a temporary one")
    options = parser.parse_args()
    chosen = [
        m
        for m in MUTANTS
        if not options.names or any(name in f"{m.path} {m.name}" for name in options.names)
    ][:: options.every]
    counts = {"killed": 0, "survived": 0, "broken": 0}
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name)
        cache = options.cache or folder / "cache"
        cache.mkdir(exist_ok=True)
        prepare(cache)
        # Without a mutation the same tests pass, in the copy: else their failing would say nothing.
        whole = folder / "whole"
        whole.mkdir()
        copy_to(whole)
        for mutant in chosen:  # all texts are found before the long work begins
            text = (whole / mutant.path).read_text()
            mutant.apply(whole)
            (whole / mutant.path).write_text(text)
        for marks in sorted({m.marks for m in chosen}):
            tests = sorted({m.tests for m in chosen if m.marks == marks})
            if ended({start(whole, tests, marks): math.inf})[1] != 0:
                print(output_of(whole).read_text(errors="replace")[-3000:])
                print("the tests fail without any mutation")
                return 1
        for mutant, verdict, reason in check(chosen, folder, options.jobs):
            counts[verdict] += 1
            print(f"{verdict:9}{mutant.path!s:44}{mutant.name:52}{reason}", flush=True)
    summary = ", ".join(f"{count} {verdict}" for verdict, count in counts.items())
    print(f"{len(chosen)} mutants: {summary}; {time.monotonic() - started:.0f} s")
    return 0 if counts["killed"] == len(chosen) else 1


if __name__ == "__main__":
    sys.exit(main())
