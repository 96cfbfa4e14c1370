"""What distance scaling costs in the adjoint, per 300 000 samples of a training-like step.

    python benchmarks/gradient_scaling.py

1500 rays x 200 steps, all in the box: exactly 300 000 samples. Measured in pairs, with and without:

    render_backward    our adjoint launch, scaled ("clamped") against compiled without
    render_train       our forward + loss + adjoint launch, likewise
    control            our adjoint launch without scaling against itself: what the method of
                       measuring makes of no difference at all
    torch backward     the same rendering in torch, with the paper's operation against without
    operation alone    the backward of the paper's operation on 300 000 samples

Of rgb with a dense grid all five, of other models and fields the first three; the launches of each
are compared with torch's gradient before. What one takes turns with is its own. Fields besides
dense grids (`--fields vm hash`) are of random numbers.

The two of a pair take turns (ABBA), each counts its fastest; the figure is the median over pairs
of their difference, with a 95 % interval from order statistics. Shares are of the unscaled backward
pass of the same pipeline. Both of our variants write to the same arrays, so that their place in
memory makes no difference. Compile time is not in it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import torch
from adjoint_launches import Call, WarpAdjoint
from candidates import Candidate, torch_models
from candidates.torch_eager import Choices, ScaleGradient, TorchPipeline, fastest
from candidates.torch_fields import FieldChoices, TorchFields
from field_workload import FieldWorkload, add_fields, made_field, models_of
from measuring import Stopwatch, machine, median_interval, options, write_record
from workload import DEFAULT_MODELS, ModelName, Workload, make_workload

from warpnerf.config import Scaling
from warpnerf.runtime.memory import usable_cores

N_RAYS = 1500
N_STEPS = 200
N_SAMPLES = 300_000
SCALED: tuple[Scaling, ...] = ("none", "clamped")


AT_KINKS = 1e-3
"""The share of the gradient's values that may differ from torch's by more where an MLP is in
between: where a unit is next to 0, rounding decides what flows back."""


def check(ours: WarpAdjoint, theirs: dict[Scaling, Candidate], at_kinks: float = 0.0) -> None:
    """Raise SystemExit unless all launches have the gradient that torch has, but for a share."""
    for scaling, pipeline in theirs.items():
        pipeline.step()
        for launch in (ours.backward(scaling), ours.train(scaling)):
            for name, found in ours.gradient_of(launch).items():
                of_field = hasattr(pipeline, "gradients")
                expected = pipeline.gradients()[name] if of_field else pipeline.gradient()
                apart = np.sort(np.abs(found.ravel() - expected.ravel()))
                apart = apart[: len(apart) - int(at_kinks * len(apart))]
                error = apart[-1] / np.abs(expected).max()
                if not error < 1e-4:
                    raise SystemExit(
                        f"gradient_scaling: with scaling {scaling!r} the gradient of {name} "
                        f"differs from torch's by {error:.1e} of the largest; there is nothing to "
                        "time."
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
        self,
        of: dict[str, str],
        name: str,
        without: Call,
        with_it: Call,
        stopwatch: Stopwatch,
    ) -> None:
        """Run both once, so that they are compiled and warm; `of` is a model and a field."""
        self.of = of
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
            **self.of,
            "name": self.name,
            "pairs": len(self._times),
            "without_us": self.without_us(),
            "with_us": 1e6 * float(np.median([t[1] for t in self._times])),
            "difference_us": difference,
            "backward_us": backward_us,
            "share_of_backward": {key: value / backward_us for key, value in difference.items()},
        }


def counted_instructions(grid: int, field: str, model: str, scaling: Scaling) -> float | None:
    """Instructions of one sample's adjoint, by the hardware's counter; None where there is none.

    A process that launches more often is set against one that launches less often, so that all but
    the launches cancels.
    """
    few, many = 20, 120
    counts = []
    for launches in (few, many):
        command = ["perf", "stat", "-x", ",", "-e", "instructions:u", sys.executable, __file__]
        command += ["--grid", str(grid), "--fields", field, "--models", model]
        command += ["--launch", scaling, str(launches)]
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

    of = {"model": "rgb", "field": "dense"}
    return [
        Pairs(
            of,
            "torch backward",
            backward(pipelines["none"]),
            backward(pipelines["clamped"]),
            stopwatch,
        ),
        Pairs(
            of,
            "operation alone",
            lambda: None,
            operation_alone(device, choices.threads),
            stopwatch,
        ),
    ]


def inside(field: str, model: ModelName, grid: int) -> Workload:
    """All of its samples lie in the box, of random numbers."""
    work = make_workload("inside", grid, N_RAYS, N_STEPS, model=model)
    return work if field == "dense" else made_field(field, work)


def torch_of(work: Workload, threads: int, device: str) -> Candidate:
    """What launches of models besides rgb, or with other fields, are compared with."""
    if isinstance(work, FieldWorkload):
        return TorchFields(work, FieldChoices(threads=threads, parts=4))
    return torch_models.TorchModels(work, torch_models.Choices(threads=threads), device)


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--grid", type=int, default=64, help="nodes along each axis")
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--repeats", type=int, default=2, help="of each side in a pair")
    parser.add_argument("--threads", type=int, default=usable_cores())
    parser.add_argument(
        "--models", nargs="+", default=list(DEFAULT_MODELS), choices=list(DEFAULT_MODELS)
    )
    add_fields(parser)
    parser.add_argument("--launch", nargs=2, metavar=("SCALING", "N"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    pairs_asked = models_of(parser, args)
    if args.launch:  # the process that counted_instructions watches
        ((field, model),) = pairs_asked
        launches = WarpAdjoint(inside(field, model, args.grid), "cpu", 1, N_SAMPLES)
        launch = launches.backward(args.launch[0])
        for _ in range(int(args.launch[1])):
            launch()
        return
    if args.device != "cpu" and args.fields != ["dense"]:
        parser.error("fields besides dense grids are compared with torch on the CPU")

    stopwatch = Stopwatch(args.device)
    records: list[dict[str, Any]] = []
    best: Choices | None = None
    for field, model in pairs_asked:
        of = {"model": model, "field": field}
        work = inside(field, model, args.grid)
        ours = WarpAdjoint(work, args.device, args.threads, N_SAMPLES)
        sides: dict[Scaling, Workload] = {s: replace(work, scaled=s != "none") for s in SCALED}
        in_torch: list[Pairs] = []
        if model == "rgb" and field == "dense":
            best = fastest_choices(work, args, stopwatch)
            theirs = {s: TorchPipeline(side, best, args.device) for s, side in sides.items()}
            check(ours, theirs)
            in_torch = pairs_in_torch(theirs, best, args.device, stopwatch)
        else:
            check(
                ours,
                {s: torch_of(side, args.threads, args.device) for s, side in sides.items()},
                AT_KINKS if model in ("deferred", "per_sample") else 0.0,
            )
        plain = ours.backward("none")
        backward = Pairs(of, "render_backward", plain, ours.backward("clamped"), stopwatch)
        train = Pairs(of, "render_train", ours.train("none"), ours.train("clamped"), stopwatch)
        control = Pairs(of, "control", plain, plain, stopwatch)
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
        f"{'':34s}{'without us':>11s}{'with us':>11s}   {'difference us':26s}   "
        "of the backward pass"
    )
    for r in records:
        d, s = r["difference_us"], r["share_of_backward"]
        whose = f"{r['model']}, {r['field']}"
        difference = f"{d['median']:+.1f} [{d['low']:+.1f}, {d['high']:+.1f}]"
        print(
            f"{whose:17s}{r['name']:17s}{r['without_us']:11.0f}{r['with_us']:11.0f}   "
            f"{difference:26s}   {s['median']:+.2%} [{s['low']:+.2%}, {s['high']:+.2%}]"
        )

    instructions: dict[str, dict[str, float | None]] | None = None
    if not args.device.startswith("cuda") and has_counters():
        instructions = {
            f"{model}, {field}": {
                s: counted_instructions(args.grid, field, model, s) for s in SCALED
            }
            for field, model in pairs_asked
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
