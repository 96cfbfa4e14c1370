"""How the benchmarks take options, keep time, summarise it, and write down where it was."""

from __future__ import annotations

import argparse
import datetime
import importlib.metadata
import json
import math
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from warpnerf.config import LossConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import MODELS, Deferred, model_of
from warpnerf.runtime.memory import usable_cores

wp.config.log_level = wp.LOG_ERROR  # a table is all that a benchmark prints

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"

Interval = dict[str, float]
"""low, median, high: a median and its 95 % interval."""


def options(doc: str) -> argparse.ArgumentParser:
    """A parser of what all benchmarks have in common, described by the first line of their doc."""
    parser = argparse.ArgumentParser(description=doc.split("\n", maxsplit=1)[0])
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0")
    parser.add_argument("--output", type=_file, help="where the record goes, a file")
    return parser


def _file(text: str) -> Path:
    """A path that is no folder's; said before anything is measured."""
    path = Path(text)
    if path.is_dir():
        raise argparse.ArgumentTypeError(f"{path} is a folder; name a file in it.")
    return path


def add_model(parser: argparse.ArgumentParser) -> None:
    """The option --model, of benchmarks that train one."""
    parser.add_argument("--model", default="deferred", choices=list(MODELS))


def named(model: str) -> Model:
    """The model of a name: of deferred the small one, which candidates and records have."""
    return Deferred(specular=4, width=32) if model == "deferred" else model_of(model)


def plain_training(model: str = "deferred", **changes: Any) -> TrainConfig:
    """A training of a model, by name, with the squared error alone."""
    return TrainConfig(model=named(model), loss=LossConfig(), **changes)


class Stopwatch:
    """Times calls on a device; on CUDA many in a row, so that launching hides behind working."""

    def __init__(self, device: str) -> None:
        """For a device as Warp names it."""
        self._cuda = device.startswith("cuda")
        self._calls = 20 if self._cuda else 1

    def seconds(self, call: Callable[[], object]) -> float:
        """Of one call."""
        self._synchronize()
        begin = time.perf_counter()
        for _ in range(self._calls):
            call()
        self._synchronize()
        return (time.perf_counter() - begin) / self._calls

    def better_of_two(self, call: Callable[[], object]) -> float:
        """In a row: the first finds the caches, and the cores, as another candidate left them."""
        return min(self.seconds(call), self.seconds(call))

    def _synchronize(self) -> None:
        if self._cuda:
            wp.synchronize()  # the whole device: torch's stream too


def median_interval(values: Iterable[float]) -> Interval:
    """Median and its 95 % interval, from order statistics: no assumption on the distribution.

    With fewer than 6 values the ends are the least and greatest, which cover less than 95 %.
    """
    ordered = sorted(values)
    n = len(ordered)
    low = max(0, math.floor((n - 1.96 * math.sqrt(n)) / 2.0) - 1)
    return {
        "low": ordered[low],
        "median": float(np.median(ordered)),
        "high": ordered[n - 1 - low],
    }


def show(interval: Interval, digits: int) -> str:
    """As text: median [low, high]."""
    median, low, high = (f"{interval[key]:.{digits}f}" for key in ("median", "low", "high"))
    return f"{median} [{low}, {high}]"


def machine(device: str, threads: int) -> dict[str, Any]:
    """What a record says about where it was made."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": threads,
        "device": device,
        "gpu": wp.get_device(device).name if device.startswith("cuda") else None,
        "load_average": os.getloadavg() if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "warp": wp.config.version,
        **{package: _version(package) for package in ("torch", "numba", "taichi", "drjit")},
        "system": platform.platform(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "commit": commit(ROOT),
        "command": shlex.join(["python", *map(_without_folders, sys.argv)]),
    }


def commit(tree: Path) -> str | None:
    """Which one is checked out, with a plus where code was changed; None: it is no checkout."""
    git = ["git", "-C", str(tree)]
    try:
        head, changed = (
            subprocess.run([*git, *words], capture_output=True)
            for words in (
                ["rev-parse", "--short=12", "HEAD"],
                ["diff", "--quiet", "HEAD", "--", "*.py"],
            )
        )
    except OSError:
        return None
    if head.returncode:
        return None
    return head.stdout.decode().strip() + ("+" if changed.returncode else "")


def default_threads() -> list[int]:
    """One, and two where there are two cores."""
    return sorted({1, min(2, usable_cores())})


def _without_folders(word: str) -> str:
    """A word of the command; of a path from the root its last part, which is no other machine's."""
    return Path(word).name if Path(word).is_absolute() else word


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def write_record(record: dict[str, Any], output: Path | None, name: str, device: str) -> Path:
    """Write a record to `output`, or else to results/<name>_<device>.json beside this file."""
    if output is None:
        output = RESULTS / f"{name}_{device.replace(':', '')}.json"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_text(json.dumps(record, indent=2) + "\n")
    return output
