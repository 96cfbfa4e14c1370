"""What a training takes besides the time of its steps: until the first one, and memory.

    python benchmarks/footprint.py path/to/scene --time-limit 36

The scene is as for training.py. `warpnerf train` is started with an empty cache of compiled kernels
and then again with that one, each time until its first step is done. Another process trains and
notes every 10 ms how much memory of its own it has (Linux: RssAnon; without what it shares with
others, such as libraries' code). For comparison, what four arrays of the grid would take in
float32: values, gradient and two moments. Writes benchmarks/results/footprint_cpu.json.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest import mock

from measuring import (
    add_model,
    machine,
    median_interval,
    options,
    plain_training,
    show,
    write_record,
)
from training import path_of

import warpnerf as wn
from warpnerf.cli import main as cli
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer

STATUS = Path("/proc/self/status")


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, a folder"
    parser.add_argument("scene", nargs="?", default="builtin:room", help=known)
    parser.add_argument("--time-limit", type=float, default=36.0, help="seconds of training")
    parser.add_argument("--steps", type=int, default=100_000, help="at most so many steps")
    parser.add_argument("--downscale", type=int, default=1)
    add_model(parser)
    parser.add_argument("--starts", type=int, default=5, help="with kernels in the cache")
    arguments = parser.parse_args()
    if arguments.device != "cpu":
        parser.error("it looks at the CPU's memory only")
    scene = path_of(arguments.scene)
    train = ["train", scene, "--downscale", str(arguments.downscale), "--model", arguments.model]
    with tempfile.TemporaryDirectory() as folder:
        cold = seconds_to_first_step([*train, "--output", f"{folder}/cold"], f"{folder}/cache")
        print(f"to the first step, kernels compiled:  {cold:.1f} s", flush=True)
        cached = median_interval(
            seconds_to_first_step([*train, "--output", f"{folder}/{n}"], f"{folder}/cache")
            for n in range(arguments.starts)
        )
        print(f"to the first step, kernels in cache:  {show(cached, 2)} s", flush=True)
    memory = json.loads(
        run_here(
            f"train({scene!r}, {arguments.model!r}, {arguments.downscale}, {arguments.steps}, "
            f"{arguments.time_limit})"
        )
    )
    if memory["peak_bytes"] is None:
        print(f"memory: {STATUS} is not there to tell")
    else:
        memory["over_arrays"] = memory["peak_bytes"] / memory["arrays_bytes"]
        print(
            f"memory: {memory['peak_bytes'] / 1e6:.0f} MB at most, "
            f"{memory['before_bytes'] / 1e6:.0f} of it before training; four arrays of "
            f"{' x '.join(map(str, memory['grid']))} nodes: {memory['arrays_bytes'] / 1e6:.0f} MB; "
            f"ratio {memory['over_arrays']:.2f}"
        )
    record = {
        "machine": machine("cpu", Workers("cpu").count),
        "scene": arguments.scene,
        "model": arguments.model,
        "downscale": arguments.downscale,
        "time_limit": arguments.time_limit,
        "cold_seconds": cold,
        "cached_seconds": cached,
        "memory": memory,
    }
    print(f"wrote {write_record(record, arguments.output, 'footprint', 'cpu')}")


def seconds_to_first_step(command: list[str], cache: str) -> float:
    """From the start of a process that runs the command until its first step is done."""
    begin = time.time()
    return float(run_here(f"first_step({command!r})", WARP_CACHE_PATH=cache)) - begin


def run_here(call: str, **environment: str) -> str:
    """What a call of one of this file's functions prints last, in a process of its own."""
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", f"import footprint; footprint.{call}"],
        env=os.environ | environment | {"PYTHONPATH": path},
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:  # it has said why
        sys.exit(done.returncode)
    return done.stdout.splitlines()[-1]


def first_step(command: list[str]) -> None:
    """Run the command, until its first step is done; print when that was."""
    update = Trainer.update

    def update_and_leave(trainer: Trainer) -> None:
        update(trainer)
        print(f"\n{time.time()}", flush=True)
        os._exit(0)

    with mock.patch.object(Trainer, "update", update_and_leave):
        sys.exit(cli.main(command))


def train(path: str, model: str, downscale: int, steps: int, time_limit: float) -> None:
    """Train; print how much memory that took."""
    scene = wn.load_scene(path, downscale=downscale)
    peak = before = own_bytes()
    done = threading.Event()

    def watch() -> None:
        nonlocal peak
        while peak is not None and not done.wait(0.01):
            peak = max(peak, own_bytes() or 0)

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        config = plain_training(model=model, steps=steps, time_limit=time_limit)
        result = wn.train(scene, config, progress=False)
    finally:
        done.set()
        watching.join()
    found: dict[str, Any] = {
        "peak_bytes": peak,
        "before_bytes": before,
        "arrays_bytes": 4
        * 4
        * math.prod(result.field.lattice.size)
        * result.field.storage.n_floats,
        "grid": result.field.lattice.size,
        "steps": result.progress.step,
    }
    print(f"\n{json.dumps(found)}")


def own_bytes() -> int | None:
    """Memory of this process's own; None where the system does not tell."""
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon")), None)


if __name__ == "__main__":
    main()
