"""What distance scaling costs in the adjoint, per 300 000 samples of a training-like step.

    python benchmarks/gradient_scaling.py

1500 rays x 200 steps, all in the box: exactly 300 000 samples. Measured in pairs, with and without:

    render_backward    our adjoint launch, scaled ("clamped") against compiled without
    render_train       our forward + loss + adjoint launch, likewise
    control            our adjoint launch without scaling against itself: what the method of
                       measuring makes of no difference at all
    torch backward     the same rendering in torch, with the paper's operation against without
    operation alone    the backward of the paper's operation on 300 000 samples

Of rgb all five, of the other models the first three; each model's launches are compared with
torch's gradient before. What one model takes turns with is its own.

The two of a pair take turns (ABBA), each counts its fastest; the figure is the median over pairs
of their difference, with a 95 % interval from order statistics. Shares are of the unscaled backward
pass of the same pipeline. Both of our variants write to the same arrays, so that their place in
memory makes no difference. Compile time is not in it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
import warp as wp
from candidates import Candidate, torch_models
from candidates.torch_eager import Choices, ScaleGradient, TorchPipeline, fastest
from measuring import Stopwatch, machine, median_interval, options, write_record
from warpnerf_kernels.base.types import real, vec3
from warpnerf_kernels.launch import assembly
from workload import DEFAULT_MODELS, Workload, make_workload

from warpnerf.config import Scaling
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.render import TrainingPass
from warpnerf.rendering.structs import (
    FieldStructs,
    render_outputs_struct,
    render_params_struct,
    scratch_struct,
    variant_of,
)
from warpnerf.runtime.memory import usable_cores
from warpnerf.runtime.parallel import Workers

N_RAYS = 1500
N_STEPS = 200
N_SAMPLES = 300_000
SCALED: tuple[Scaling, ...] = ("none", "clamped")

Call = Callable[[], object]


class WarpAdjoint:
    """The workload's launches in warpnerf, for each scaling, on the same arrays."""

    def __init__(self, work: Workload, device: str, threads: int) -> None:
        """Load a workload and render it once, for what the adjoint starts from."""
        self._workers = workers = Workers(device, threads)
        self._model = work.warp_model()
        self._grid = work.voxel_grid(workers)
        self._weights = work.weights(workers)
        self._free = FreeCells.none(workers)
        self._steps = work.steps()
        self._batch = work.batch(workers)
        self._scene = render_params_struct(
            self._model,
            "float32",
            FieldStructs.of(self._grid, self._weights, self._free, self._steps, self._workers),
            self._steps,
            workers,
        )
        self._seen = self._render()
        n = int(self._seen.n_samples.numpy().sum())
        if n != N_SAMPLES:
            raise SystemExit(f"gradient_scaling: {n} samples were visited, not {N_SAMPLES}.")
        rgb = self._seen.rgb.numpy()
        self._adj_rgb = wp.array(
            2.0 / len(rgb) * (rgb - work.target_rgb), dtype=vec3, device=workers.device
        )
        self._nothing = wp.zeros(len(rgb), dtype=real, device=workers.device)
        self._passes = {scaling: self._training_pass(scaling) for scaling in ("none", "clamped")}
        share_memory(self._passes["none"], self._passes["clamped"])

    def _variant(self, scaling: Scaling) -> assembly.Variant:
        packed = not self._workers.device.is_cuda
        return variant_of(self._model, "float32", "none", scaling, "none", packed)

    def _render(self) -> Any:
        variant, n = self._variant("none"), self._batch.count
        seen = render_outputs_struct(variant, n, self._workers, assembly)
        self._workers.launch_owned(
            assembly.render_forward_kernel(variant),
            -(-n // variant.batch),
            n,
            self._scene,
            self._batch.struct,
            scratch_struct(variant, 1, self._workers, assembly),
            seen,
        )
        return seen

    def _training_pass(self, scaling: Scaling) -> TrainingPass:
        return TrainingPass(
            self._batch.count,
            self._model,
            self._grid,
            self._weights,
            self._steps,
            scaling,
            "none",
            self._workers,
        )

    @property
    def gradients(self) -> Gradients:
        """What all launches add to."""
        return self._passes["none"].gradients

    def train(self, scaling: Scaling) -> Call:
        """The fused launch."""
        training_pass = self._passes[scaling]
        return lambda: training_pass.run(self._free, self._batch)

    def backward(self, scaling: Scaling) -> Call:
        """The adjoint launch."""
        variant = self._variant(scaling)
        launch = AdjointLaunch(
            assembly.render_backward_kernel(variant),
            variant,
            self._model.most_steps(self._steps, self._grid.lattice.diagonal),
            self._batch.count,
            self._workers,
        )
        share_sink(self._passes["none"].launch, launch)
        arguments = (
            self._scene,
            self._batch.struct,
            self._seen,
            self._adj_rgb,
            self._nothing,
            self._nothing,
            scratch_struct(variant, 1, launch.workers, assembly),
        )
        gradient = self.gradients.struct
        return lambda: launch.run(self._batch.count, gradient, *arguments)

    def gradient_of(self, launch: Call) -> np.ndarray:
        """What a launch adds, [X, Y, Z, n_values]."""
        self.gradients.values.zero_()
        launch()
        return self.gradients.values.numpy().reshape(*self._grid.lattice.size, self._grid.n_floats)


def share_memory(of: TrainingPass, to: TrainingPass) -> None:
    """Give one pass the other's arrays, so that the two differ in what they do and not where."""
    for name, value in vars(of).items():
        if isinstance(value, wp.array | Gradients):
            vars(to)[name] = value
    to._scene, to._outputs = of._scene, of._outputs
    if of.launch.sink is not None:
        to._scratch.packs, to._scratch.rows = of._scratch.packs, of._scratch.rows
    share_sink(of.launch, to.launch)


def share_sink(of: AdjointLaunch, to: AdjointLaunch) -> None:
    """Have two launches leave records in the same place, with where workers meet."""
    to.sink = of.sink


AT_KINKS = 1e-3
"""The share of the gradient's values that may differ from torch's by more where an MLP is in
between: where a unit is next to 0, rounding decides what flows back."""


def check(ours: WarpAdjoint, theirs: dict[Scaling, Candidate], at_kinks: float = 0.0) -> None:
    """Raise SystemExit unless all launches have the gradient that torch has, but for a share."""
    for scaling, pipeline in theirs.items():
        pipeline.step()
        expected = pipeline.gradient()
        for launch in (ours.backward(scaling), ours.train(scaling)):
            apart = np.sort(np.abs(ours.gradient_of(launch) - expected), axis=None)
            apart = apart[: len(apart) - int(at_kinks * len(apart))]
            error = apart[-1] / np.abs(expected).max()
            if not error < 1e-4:
                raise SystemExit(
                    f"gradient_scaling: scaling {scaling!r} differs from torch by {error:.1e} of "
                    "the largest gradient; there is nothing to time."
                )


def operation_alone(device: str, threads: int) -> Call:
    """The backward of the paper's operation, on as many samples."""
    rgb = torch.rand(N_SAMPLES, 3, device=device, requires_grad=True)
    sigma = torch.rand(N_SAMPLES, device=device, requires_grad=True)
    out = ScaleGradient.apply(rgb, sigma, 1.5 * torch.rand(N_SAMPLES, device=device), 1.0)
    adj = (torch.rand_like(rgb), torch.rand_like(sigma))

    def call() -> object:
        torch.set_num_threads(threads)
        return torch.autograd.grad(out, (rgb, sigma), adj, retain_graph=True)

    return call


class Pairs:
    """Times of two calls, taken in turns."""

    def __init__(
        self, model: str, name: str, without: Call, with_it: Call, stopwatch: Stopwatch
    ) -> None:
        """Run both once, so that they are compiled and warm."""
        self.model = model
        self.name = name
        self._calls = (without, with_it)
        self._stopwatch = stopwatch
        self._times: list[tuple[float, float]] = []
        without()
        with_it()

    def take(self, repeats: int) -> None:
        """One more pair: the fastest of some repeats of each, ABBA or BAAB."""
        fastest = [float("inf"), float("inf")]
        for repeat in range(repeats):
            first = (len(self._times) + repeat) % 2
            for side in (first, 1 - first):
                seconds = self._stopwatch.seconds(self._calls[side])
                fastest[side] = min(fastest[side], seconds)
        self._times.append((fastest[0], fastest[1]))

    def without_us(self) -> float:
        """Median time of the first, microseconds."""
        return 1e6 * float(np.median([t[0] for t in self._times]))

    def record(self, backward_us: float) -> dict[str, Any]:
        """The median difference and its interval, also as shares of a backward pass."""
        difference = median_interval([1e6 * (t[1] - t[0]) for t in self._times])
        return {
            "model": self.model,
            "name": self.name,
            "pairs": len(self._times),
            "without_us": self.without_us(),
            "with_us": 1e6 * float(np.median([t[1] for t in self._times])),
            "difference_us": difference,
            "backward_us": backward_us,
            "share_of_backward": {key: value / backward_us for key, value in difference.items()},
        }


def counted_instructions(grid: int, model: str, scaling: Scaling) -> float | None:
    """Instructions of one sample's adjoint, by the hardware's counter; None where there is none.

    A process that launches more often is set against one that launches less often, so that all but
    the launches cancels.
    """
    few, many = 20, 120
    counts = []
    for launches in (few, many):
        command = ["perf", "stat", "-x", ",", "-e", "instructions:u", sys.executable, __file__]
        command += ["--grid", str(grid), "--models", model, "--launch", scaling, str(launches)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=300)
        except (OSError, subprocess.TimeoutExpired):
            return None
        line = next((s for s in done.stderr.splitlines() if ",instructions:u," in s), "")
        count = line.split(",")[0]
        if done.returncode != 0 or not count.isdigit():
            return None
        counts.append(int(count))
    return (counts[1] - counts[0]) / (many - few) / N_SAMPLES


def has_counters() -> bool:
    """Whether perf can count instructions here."""
    command = ["perf", "stat", "-x", ",", "-e", "instructions:u", "true"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.stderr.split(",")[0].strip().isdigit()


def fastest_choices(work: Workload, args: argparse.Namespace, stopwatch: Stopwatch) -> Choices:
    """Of torch; more threads are not always faster."""
    counts = [1] if args.device.startswith("cuda") else sorted({1, args.threads})
    found = [fastest(work, n, args.device) for n in counts]
    times = [np.median([stopwatch.seconds(one.step) for _ in range(5)]) for one in found]
    return found[int(np.argmin(times))].choices


def pairs_in_torch(
    pipelines: dict[Scaling, TorchPipeline], choices: Choices, device: str, stopwatch: Stopwatch
) -> list[Pairs]:
    """What the paper's operation costs in torch."""

    def backward(pipeline: TorchPipeline) -> Call:
        loss = pipeline.loss()
        return lambda: pipeline.backward(loss, keep_graph=True)

    return [
        Pairs(
            "rgb",
            "torch backward",
            backward(pipelines["none"]),
            backward(pipelines["clamped"]),
            stopwatch,
        ),
        Pairs(
            "rgb",
            "operation alone",
            lambda: None,
            operation_alone(device, choices.threads),
            stopwatch,
        ),
    ]


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--grid", type=int, default=64, help="nodes along each axis")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=2, help="of each side in a pair")
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument(
        "--models", nargs="+", default=list(DEFAULT_MODELS), choices=list(DEFAULT_MODELS)
    )
    parser.add_argument("--launch", nargs=2, metavar=("SCALING", "N"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.launch:  # the process that counted_instructions watches
        work = make_workload("inside", args.grid, N_RAYS, N_STEPS, model=args.models[0])
        launch = WarpAdjoint(work, "cpu", 1).backward(args.launch[0])
        for _ in range(int(args.launch[1])):
            launch()
        return

    stopwatch = Stopwatch(args.device)
    records: list[dict[str, Any]] = []
    best: Choices | None = None
    for model in args.models:
        work = make_workload("inside", args.grid, N_RAYS, N_STEPS, model=model)
        ours = WarpAdjoint(work, args.device, args.threads)
        in_torch: list[Pairs] = []
        if model == "rgb":
            best = fastest_choices(work, args, stopwatch)
            theirs = {
                s: TorchPipeline(replace(work, scaled=s != "none"), best, args.device)
                for s in SCALED
            }
            check(ours, theirs)
            in_torch = pairs_in_torch(theirs, best, args.device, stopwatch)
        else:
            choices = torch_models.Choices(threads=args.threads)
            check(
                ours,
                {
                    s: torch_models.TorchModels(
                        replace(work, scaled=s != "none"), choices, args.device
                    )
                    for s in SCALED
                },
                AT_KINKS if model in ("deferred", "per_sample") else 0.0,
            )
        plain = ours.backward("none")
        backward = Pairs(model, "render_backward", plain, ours.backward("clamped"), stopwatch)
        train = Pairs(model, "render_train", ours.train("none"), ours.train("clamped"), stopwatch)
        control = Pairs(model, "control", plain, plain, stopwatch)
        all_pairs = (backward, train, control, *in_torch)
        for _ in range(args.pairs):
            for pairs in all_pairs:
                pairs.take(args.repeats)
        records += [pairs.record(backward.without_us()) for pairs in (backward, train, control)]
        records += [pairs.record(in_torch[0].without_us()) for pairs in in_torch]

    print(
        f"{N_SAMPLES} samples, {args.grid}^3 grid, {args.pairs} pairs, {args.threads} threads"
        f"{f' (torch: {best.threads})' if best else ''}; median difference [95 % interval]\n"
    )
    print(
        f"{'':27s}{'without us':>11s}{'with us':>11s}   {'difference us':26s}   "
        "of the backward pass"
    )
    for r in records:
        d, s = r["difference_us"], r["share_of_backward"]
        difference = f"{d['median']:+.1f} [{d['low']:+.1f}, {d['high']:+.1f}]"
        print(
            f"{r['model']:10s}{r['name']:17s}{r['without_us']:11.0f}{r['with_us']:11.0f}   "
            f"{difference:26s}   {s['median']:+.2%} [{s['low']:+.2%}, {s['high']:+.2%}]"
        )

    instructions: dict[str, dict[str, float | None]] | None = None
    if not args.device.startswith("cuda") and has_counters():
        instructions = {
            model: {s: counted_instructions(args.grid, model, s) for s in SCALED}
            for model in args.models
        }
        print(f"\ninstructions of a sample's adjoint: {instructions}")
    else:
        print("\nno hardware counters on this machine")
    record = {
        "benchmark": "gradient_scaling",
        "machine": machine(args.device, args.threads),
        "n_samples": N_SAMPLES,
        "grid": args.grid,
        "repeats": args.repeats,
        "torch_choices": asdict(best) if best else None,
        "results": records,
        "instructions_per_sample": instructions,
    }
    print(f"record: {write_record(record, args.output, 'gradient_scaling', args.device)}")


if __name__ == "__main__":
    main()
