"""A whole step of DVGO's model: warpnerf against the best eager torch that does the same.

    python benchmarks/dvgo_step.py

A density and 12 features in each node of a 160^3 grid, and for each sample of a weight above 1e-4
an MLP of two hidden layers of 128 units that sees the features and the encoded direction. A step is
8192 rays in steps of half a voxel: march, composite, squared error, adjoint scaled by distance,
gradients of nodes and network, and Adam over both, which leaves nodes alone that no ray has
touched. Cases are those of throughput.py: dense, random values everywhere, and sphere, a solid one
in empty space.

Gradients are compared first; then the two take turns. Each counts with its better number of
threads. Ratios are formed round by round; figures are medians with 95 % intervals. Prints a table
and writes benchmarks/results/dvgo_step_cpu.json.
"""

from __future__ import annotations

import gc
import itertools
import math
from typing import Any

import numpy as np
import torch
from candidates import warpnerf_step
from candidates.torch_adam import MaskedAdam, Way
from candidates.torch_models import Choices, Scattering, TorchModels
from measuring import (
    Stopwatch,
    default_threads,
    machine,
    median_interval,
    options,
    show,
    write_record,
)
from throughput import AT_KINKS, check, race
from workload import CAMERA_DISTANCE, Scene, Workload, make_workload

from warpnerf.config import OptimConfig
from warpnerf.model.parameters import parameters_of
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import adam_step, first_states

RATE = 0.1
"""Of the grid."""


class WarpStep:
    """The training pass, and Adam, which zeroes the gradient."""

    def __init__(self, work: Workload, threads: int) -> None:
        """Load a workload."""
        self._workers = workers = Workers("cpu", threads)
        self._free, self._batch = work.free_cells(workers), work.batch(workers)
        model, grid, weights = work.warp_model(), work.voxel_grid(workers), work.weights(workers)
        self._config = OptimConfig(learning_rate_density=RATE, learning_rate_rgb=RATE)
        self._parameters = parameters_of(model, grid, weights, self._config)
        self._states = first_states(self._parameters, workers)
        self._update = 0
        scaling = "clamped" if work.scaled else "none"
        self._pass = TrainingPass(
            self._batch.count, model, grid, weights, work.steps(), scaling, "none", workers
        )

    def step(self) -> None:
        """A whole one."""
        self._pass.run(self._free, self._batch)
        self._update += 1
        adam_step(
            self._parameters,
            self._states,
            self._pass.gradients,
            self._update,
            1.0,
            self._config,
            self._workers,
        )


class TorchStep:
    """The best eager torch, and an optimiser of its kind."""

    def __init__(self, work: Workload, threads: int) -> None:
        """Load a workload."""
        self._pass = TorchModels(work, Choices(threads=threads))
        self._grid = MaskedAdam(self._pass.tables(), RATE)
        self._network = torch.optim.Adam(self._pass.network, lr=1e-3, betas=(0.9, 0.99))

    def step(self) -> None:
        """A whole one."""
        self._pass.step()
        self._grid.step()
        self._network.step()

    def choose(self, rounds: int) -> str:
        """Take what is fastest here; says what."""
        seconds = Stopwatch("cpu").seconds
        scatterings: tuple[Scattering, ...] = ("rows", "pairs")
        ways: tuple[Way, ...] = ("all", "rows")
        threads = self._pass.choices.threads
        best: dict[tuple[int, Scattering], float] = {}
        for choice in list(itertools.product((4, 16, 64), scatterings)) * rounds:
            self._pass.choices = Choices(parts=choice[0], scattering=choice[1], threads=threads)
            spent = seconds(self._pass.step)
            best[choice] = min(best.get(choice, np.inf), spent)
        parts, scattering = min(best, key=lambda choice: best[choice])
        self._pass.choices = Choices(parts=parts, scattering=scattering, threads=threads)
        updates: dict[Way, float] = {}
        for way in ways * rounds:
            self._grid.way = way
            updates[way] = min(updates.get(way, np.inf), seconds(self._grid.step))
        self._grid.way = min(updates, key=lambda way: updates[way])
        return f"{parts} parts, gradients by {scattering}, Adam over {self._grid.way}"


def compare(
    scene: Scene, grid: int, n_rays: int, thread_counts: list[int], rounds: int
) -> dict[str, Any]:
    """Check one case, and time it."""
    reach = CAMERA_DISTANCE + math.sqrt(3.0)
    n_steps = round(reach * (grid - 1))
    work = make_workload("random", grid, n_rays, n_steps, scene=scene, model="dvgo")
    sides = {
        ("warpnerf", 1): warpnerf_step.load(work, 1, "cpu"),
        ("torch", 1): TorchModels(work, Choices(parts=16)),
    }
    differences = check(sides, AT_KINKS["dvgo"])
    n_samples = sides["warpnerf", 1].n_samples()
    del sides
    gc.collect()
    theirs = {threads: TorchStep(work, threads) for threads in thread_counts}
    choices = {threads: step.choose(2) for threads, step in theirs.items()}
    ours = {threads: WarpStep(work, threads) for threads in thread_counts}
    calls = {("warpnerf", t): ours[t].step for t in ours}
    calls |= {("torch", t): theirs[t].step for t in theirs}
    seconds = race(calls, rounds, "cpu")
    best = {
        name: [min(s for (n, _), s in turn.items() if n == name) for turn in seconds]
        for name in ("warpnerf", "torch")
    }
    row = {
        "scene": scene,
        "n_steps": n_steps,
        "n_samples": n_samples,
        "differences": differences,
        "torch_choices": choices,
        **{f"{name}_ms": median_interval(1e3 * s for s in best[name]) for name in best},
        "over_warpnerf": median_interval(
            b / a for a, b in zip(best["warpnerf"], best["torch"], strict=True)
        ),
    }
    print(
        f"{scene:7s} {n_samples / n_rays:6.1f} samples/ray   warpnerf {show(row['warpnerf_ms'], 0)}"
        f" ms   torch {show(row['torch_ms'], 0)} ms   torch / warpnerf "
        f"{show(row['over_warpnerf'], 2)}   ({choices[max(choices)]})",
        flush=True,
    )
    return row


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--grid", type=int, default=160, help="nodes per axis")
    parser.add_argument("--rays", type=int, default=8192)
    parser.add_argument("--threads", type=int, nargs="+", default=default_threads())
    parser.add_argument("--rounds", type=int, default=8)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("this one measures CPUs")
    print(f"{args.rays} rays, {args.grid}^3, {args.rounds} rounds; median [95 % interval]\n")
    scenes: tuple[Scene, ...] = ("dense", "sphere")
    rows = []
    for scene in scenes:
        rows.append(compare(scene, args.grid, args.rays, args.threads, args.rounds))
        gc.collect()
    record = {
        "benchmark": "dvgo_step",
        "machine": machine("cpu", max(args.threads)),
        "n_rays": args.rays,
        "grid": args.grid,
        "rounds": args.rounds,
        "rows": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'dvgo_step', 'cpu')}")


if __name__ == "__main__":
    main()
