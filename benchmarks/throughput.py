"""Forward + loss + scaled adjoint of 4096 random rays x 256 steps, against the best eager torch.

    python benchmarks/throughput.py

Both sides do the same work in the same run, round by round in turn: march, composite, squared
error, adjoint into a zeroed gradient, clamped distance scaling (torch: the paper's operation). They
are first checked against each other. Torch runs on one thread and on as many as warpnerf, and in
each round its faster time counts: on the CPU it is not always the second. `inside`: all 256 samples
of each ray lie in the box; `crossing`: rays from outside, about two thirds of the steps in the box.
Also reports what memory a step needs besides grid and gradient, as the number of steps grows.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from torch_pipeline import TorchPipeline, fastest_by_threads
from workload import (
    Rays,
    Stopwatch,
    Workload,
    machine,
    make_workload,
    quartiles,
    write_record,
)

from warpnerf.grid import FreeCells
from warpnerf.parallel import Workers
from warpnerf.render import TrainingPass, render_rays

TOLERANCE = 1e-4
"""Of the largest value: by how much the two sides may differ."""


class WarpStep:
    """A workload's training step in warpnerf."""

    def __init__(self, work: Workload, device: str, threads: int) -> None:
        """Load a workload."""
        self._workers = Workers(device, threads)
        self._grid = work.voxel_grid(self._workers)
        self._free = FreeCells.none(self._workers)
        self._steps = work.steps()
        self._batch = work.batch(self._workers)
        self._pass = TrainingPass(
            self._batch.count,
            self._grid.values.shape[0],
            "clamped",
            "none",
            "none",
            self._workers,
        )

    def __call__(self) -> None:
        """Forward, loss and adjoint into a zeroed gradient."""
        self.zero()
        self._pass.run(self._grid, self._free, self._steps, self._batch)

    def zero(self) -> None:
        """The zeroing alone, of all nodes; in training, the optimiser zeroes what was touched."""
        self._pass.gradients.rows.zero_()
        self._pass.gradients.touched.zero_()

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._pass.gradients.rows.numpy().sum(axis=0).reshape(*self._grid.size, 4)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        batch = self._batch
        return render_rays(
            self._grid,
            self._free,
            self._steps,
            batch.origins,
            batch.directions,
            batch.offsets,
            batch.background,
            self._workers,
        ).rgb.numpy()

    def n_samples(self) -> int:
        """Visited steps of the last call."""
        return int(self._pass.n_samples.numpy().sum())

    def scratch_bytes(self) -> int:
        """All arrays of the training pass but the gradient."""
        arrays = [*vars(self._pass).values(), self._pass.gradients.touched]
        return sum(array.capacity for array in arrays if isinstance(array, wp.array))


def check(ours: WarpStep, theirs: TorchPipeline) -> dict[str, float]:
    """Greatest differences of colours and gradient, as shares of the largest value.

    Raises:
        SystemExit: The two do not compute the same.
    """
    ours()
    rgb = theirs.render().detach().cpu().numpy()
    gradient = theirs.training_step()[0].permute(1, 2, 3, 0).cpu().numpy()
    differences = {
        "rgb": float(np.abs(ours.rgb() - rgb).max() / np.abs(rgb).max()),
        "gradient": float(np.abs(ours.gradient() - gradient).max() / np.abs(gradient).max()),
    }
    for what, difference in differences.items():
        if not difference < TOLERANCE:
            raise SystemExit(
                f"throughput: the two sides differ in {what} by {difference:.1e} of the largest "
                f"value (allowed: {TOLERANCE}); there is nothing to time."
            )
    return differences


class Case:
    """Both sides of one workload."""

    def __init__(
        self, rays: Rays, grid: int, threads: int, args: argparse.Namespace, stopwatch: Stopwatch
    ) -> None:
        """Load, check and choose."""
        self._stopwatch = stopwatch
        work = make_workload(rays, grid, args.rays, args.steps)
        self._ours = WarpStep(work, args.device, threads)
        self._theirs = fastest_by_threads(work, True, threads, args.device, stopwatch.seconds)
        self._rounds: list[dict[str, float]] = []
        self._case = {
            "rays": rays,
            "grid": grid,
            "threads": threads,
            "differences": [check(self._ours, theirs) for theirs in self._theirs],
            "n_samples": self._ours.n_samples(),
            "torch_choices": [asdict(theirs.choices) for theirs in self._theirs],
        }

    def round(self) -> None:
        """Time each side, in alternating order."""
        sides: list[tuple[str, Callable[[], object]]] = [("warpnerf", self._ours)]
        for theirs in self._theirs:
            sides.append((f"torch {theirs.choices.threads}", theirs.training_step))
        if len(self._rounds) % 2:
            sides.reverse()
        # The better of two in a row: the first finds the caches, and the cores, as the other
        # side left them.
        times = {
            name: min(self._stopwatch.seconds(side), self._stopwatch.seconds(side))
            for name, side in sides
        }
        times["torch"] = min(times[name] for name, _ in sides if name != "warpnerf")
        times["zero"] = self._stopwatch.seconds(self._ours.zero)
        self._rounds.append(times)

    def record(self) -> dict[str, Any]:
        """Medians and quartiles of the rounds."""
        n = self._case["n_samples"]
        ours = [r["warpnerf"] for r in self._rounds]
        return {
            **self._case,
            "rounds": len(self._rounds),
            "warpnerf_ms": quartiles([1e3 * t for t in ours]),
            "warpnerf_zeroing_ms": quartiles([1e3 * r["zero"] for r in self._rounds]),
            "torch_ms": quartiles([1e3 * r["torch"] for r in self._rounds]),
            "torch_ms_by_threads": {
                theirs.choices.threads: quartiles(
                    [1e3 * r[f"torch {theirs.choices.threads}"] for r in self._rounds]
                )
                for theirs in self._theirs
            },
            "ratio": quartiles([r["torch"] / r["warpnerf"] for r in self._rounds]),
            "warpnerf_ns_per_sample": quartiles([1e9 * t / n for t in ours]),
        }


def memory(grid: int, args: argparse.Namespace) -> list[dict[str, int]]:
    """Bytes that a step needs besides grid and gradient, at growing numbers of steps."""
    rows = []
    for n_steps in (args.steps // 2, args.steps, 2 * args.steps):
        work = make_workload("inside", grid, args.rays, n_steps)
        ours = WarpStep(work, args.device, args.threads[-1])
        ours()
        seconds = Stopwatch(args.device).seconds
        theirs = fastest_by_threads(work, True, 1, args.device, seconds, rounds=1)[0]
        rows.append(
            {
                "n_steps": n_steps,
                "n_samples": ours.n_samples(),
                "warpnerf_bytes": ours.scratch_bytes(),
                "torch_bytes": theirs.saved_bytes(),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0")
    parser.add_argument("--grids", type=int, nargs="+", default=[64, 160], help="nodes per axis")
    parser.add_argument(
        "--threads",
        type=int,
        nargs="+",
        default=sorted({1, min(2, os.cpu_count() or 1)}),
        help="CPU threads of both sides",
    )
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=256, help="per ray")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--output", type=Path, help="where the record goes")
    args = parser.parse_args()
    if args.device.startswith("cuda"):
        args.threads = [1]

    stopwatch = Stopwatch(args.device)
    kinds: tuple[Rays, ...] = ("inside", "crossing")
    cases = [
        Case(rays, grid, threads, args, stopwatch)
        for grid in args.grids
        for rays in kinds
        for threads in args.threads
    ]
    for _ in range(args.rounds):
        for case in cases:
            case.round()
    records = [case.record() for case in cases]
    print(f"{args.rays} rays x {args.steps} steps, {args.rounds} rounds; median [quartiles]\n")
    print(
        "grid  rays      threads   samples    "
        f"{'warpnerf ms':21s}  {'torch ms':21s}  torch / warpnerf"
    )
    for r in records:
        print(
            f"{r['grid']:4d}  {r['rays']:8s}  {r['threads']:7d}  {r['n_samples']:8d}    "
            f"{_show(r['warpnerf_ms'], 1):21s}  {_show(r['torch_ms'], 1):21s}  "
            f"{_show(r['ratio'], 2)}"
        )
    rows = memory(args.grids[0], args)
    print("\nmemory of a step besides grid and gradient (torch: held between the passes)\n")
    print("steps    samples    warpnerf MB    torch MB")
    for row in rows:
        print(
            f"{row['n_steps']:5d}  {row['n_samples']:9d}    {row['warpnerf_bytes'] / 1e6:11.2f}"
            f"    {row['torch_bytes'] / 1e6:8.1f}"
        )
    record = {
        "benchmark": "throughput",
        "machine": machine(args.device, max(args.threads)),
        "n_rays": args.rays,
        "n_steps": args.steps,
        "quantiles": [0.25, 0.5, 0.75],
        "cases": records,
        "memory": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'throughput', args.device)}")


def _show(three: tuple[float, float, float], digits: int) -> str:
    low, middle, high = three
    return f"{middle:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


if __name__ == "__main__":
    main()
