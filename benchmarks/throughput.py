"""A training step's gradient, as everybody would compute it: milliseconds, and who is how fast.

    python benchmarks/throughput.py

4096 rays x 256 steps: march, composite, squared error, adjoint scaled by distance, and a gradient
of the grid, and of the network where there is one, that is zeroed, summed and ready to be used.
warpnerf against eager torch, torch.compile, numba, Taichi and Dr.Jit where installed
(`pip install ".[bench]"`), each on one and two threads; candidates/ holds them. The models are
those of warpnerf, as they are by default: `per_sample` computes the colour of samples of a weight
above 1e-4 only, whoever runs it. A case is one workload:

    random   single pixels of random cameras around the box, two thirds of the steps in it
    patches  8 x 8 neighbouring pixels of each camera
    dense    random values everywhere
    sphere   a solid sphere in empty space, which may be skipped: where it is free is given to all

Fields besides dense grids (`--fields vm hash`) are of random numbers in all of the box, and only
eager torch has them; it is told where samples lie.

All are checked against each other before anything is timed. Then they take turns, in an order that
changes from round to round; in a turn the better of two steps counts. Ratios are formed within a
round; all figures are medians over the rounds with 95 % intervals from order statistics. With two
threads allowed, the better of one and two threads counts for each candidate, round by round: more
are not always faster. Compile time is not in it. Beside it what the machine could do (roofline.py),
and what memory a step needs besides grid and gradient, as the number of steps grows.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace
from typing import Any

import candidates
import numpy as np
import roofline
from candidates import Candidate, Load, torch_eager
from candidates.warpnerf_step import WarpStep
from cases import Case, FieldCase, make_cases
from field_workload import FieldWorkload, add_fields, models_of
from measuring import (
    Interval,
    Stopwatch,
    default_threads,
    machine,
    median_interval,
    options,
    show,
    write_record,
)
from plotting import plot_throughput
from workload import DEFAULT_MODELS, Workload, make_workload

TOLERANCE = 1e-4
"""Of the largest value: by how much candidates may differ from the first."""
AT_KINKS = {"per_sample": 1e-4, "dvgo": 4e-4}
"""The share of the gradient's values that may differ by more: where a unit of a sample is next to
0, or its weight next to the threshold, rounding decides what flows back; dvgo has four times the
units."""
AT_FINE = 1e-4
"""Likewise where a hash is read, whose fine levels amplify rounding of positions."""
OURS = "warpnerf"
IN_TURN, AT_ONCE = "apart, in turn", "apart, at once"


def check(
    runs: dict[tuple[str, int], Candidate],
    at_kinks: float = 0.0,
    of_rgb: float = TOLERANCE,
    of_field: bool = False,
) -> dict[str, dict[str, float]]:
    """Run all, and compare them with the first.

    Args:
        runs: By name and number of threads.
        at_kinks: The share of a gradient's values that is left out, those of greatest difference.
            Where it is not 0, those of a network and of a field's decoder, sums over all samples,
            may differ by ten times as much: fine levels of a hash amplify rounding of positions.
        of_rgb: Of the largest colour, by how much colours may differ.
        of_field: Whether gradients are those of each array that a field is stored in.

    Returns:
        For each, the greatest differences in colours, gradient and the network's, if there is one,
        as shares of the largest value.

    Raises:
        SystemExit: One does not compute the same.
    """
    expected: dict[str, np.ndarray] = {}
    differences: dict[str, dict[str, float]] = {}
    for (name, threads), run in runs.items():
        run.step()
        run.step()  # a gradient that is not zeroed would show
        found = {"rgb": run.rgb()}
        found |= run.gradients() if of_field else {"gradient": run.gradient()}
        network = run.network_gradient() if hasattr(run, "network_gradient") else np.zeros(0)
        if network.size:
            found["network"] = network
        expected = expected or {what: values.copy() for what, values in found.items()}
        by_value = differences[f"{name}, {threads} threads"] = {}
        for what, values in found.items():
            largest = np.abs(expected[what]).max()
            apart = np.abs(values - expected[what]).ravel()
            if at_kinks and what not in ("rgb", "network"):
                apart = np.sort(apart)[: int(len(apart) * (1.0 - at_kinks))]
            difference = by_value[what] = float(apart.max() / largest)
            allowed = of_rgb if what == "rgb" else TOLERANCE
            if what in ("network", "decoder") and at_kinks:
                allowed *= 10.0
            if not difference < allowed:
                raise SystemExit(
                    f"throughput: {name} on {threads} threads differs in {what} by "
                    f"{difference:.1e} of the largest value (allowed: {allowed:g}); there is "
                    "nothing to time."
                )
    return differences


class Apart:
    """What the machine's threads are worth: as many warpnerfs, on one thread each.

    Each has its share of the rays, and a grid and a gradient of its own; so all that slows them
    down when they work at once is the machine.
    """

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Share a workload out."""
        self.steps = [
            WarpStep(replace(work, origins=o, directions=d, target_rgb=rgb), 1, device)
            for o, d, rgb in zip(
                np.array_split(work.origins, threads),
                np.array_split(work.directions, threads),
                np.array_split(work.target_rgb, threads),
                strict=True,
            )
        ]
        self._pool = ThreadPoolExecutor(threads - 1)
        self.at_once()  # compiles, and touches all memory

    def in_turn(self) -> None:
        """One after the other."""
        for step in self.steps:
            step.step()

    def at_once(self) -> None:
        """All together."""
        others = [self._pool.submit(step.step) for step in self.steps[1:]]
        self.steps[0].step()
        for other in others:
            other.result()


def race(
    calls: dict[tuple[str, int], Callable[[], None]], rounds: int, device: str
) -> list[dict[tuple[str, int], float]]:
    """Seconds of each, by name and number of threads, in each round."""
    stopwatch = Stopwatch(device)
    order = list(calls)
    seconds = []
    for turn in range(rounds):
        first = turn % len(order)
        turns = order[first:] + order[:first]
        if turn % 2:
            turns.reverse()
        seconds.append({key: stopwatch.better_of_two(calls[key]) for key in turns})
    return seconds


def summarise(
    seconds: list[dict[tuple[str, int], float]], names: Sequence[str], threads: int, n_samples: int
) -> dict[str, dict[str, Any]]:
    """For each candidate, what it needs with up to that many threads."""
    best = {
        name: [min(s for (n, t), s in r.items() if n == name and t <= threads) for r in seconds]
        for name in names
    }
    return {
        name: {
            "ms": median_interval(1e3 * s for s in best[name]),
            "ns_per_sample": median_interval(1e9 * s / n_samples for s in best[name]),
            "over_warpnerf": median_interval(
                s / ours for s, ours in zip(best[name], best[OURS], strict=True)
            ),
            "over_one_thread": median_interval(
                r[name, min(t for n, t in r if n == name)] / s
                for r, s in zip(seconds, best[name], strict=True)
            ),
        }
        for name in names
    }


def compare_threads(
    seconds: list[dict[tuple[str, int], float]], threads: int
) -> dict[str, Interval]:
    """How much faster threads are than one: those of Apart, and of warpnerf in shares of that."""
    apart = [r[IN_TURN, threads] / r[AT_ONCE, threads] for r in seconds]
    ours = [r[OURS, 1] / r[OURS, threads] for r in seconds]
    return {
        "apart_over_one_thread": median_interval(apart),
        "share_of_apart": median_interval(a / b for a, b in zip(ours, apart, strict=True)),
    }


def run_case(
    case: Case,
    args: argparse.Namespace,
    machines: dict[int, roofline.Machine],
) -> dict[str, Any]:
    """Load, check, time and describe one case."""
    work = case.workload(args.rays, args.steps)
    of_field = isinstance(work, FieldWorkload)
    if isinstance(work, FieldWorkload):
        counts = {"n_samples": len(work.distances)}
    else:
        counts = asdict(roofline.needs(work))
    print(f"\n{case}: {counts['n_samples']} samples")
    found, missing = wanted(case, args)
    if (case.model != "rgb" or of_field) and missing:
        print(f"  left out: {'; '.join(f'{name}, {reason}' for name, reason in missing.items())}")
    runs = {(n, t): load(work, t, args.device) for n, load in found.items() for t in args.threads}
    kinks = AT_KINKS.get(work.model, AT_FINE if of_field else 0.0)
    differences = check(runs, kinks, of_field=of_field)
    calls = {key: run.step for key, run in runs.items()}
    several = [t for t in args.threads if t > 1 and 1 in args.threads]
    for t in several:
        apart = Apart(work, t, args.device)
        calls |= {(IN_TURN, t): apart.in_turn, (AT_ONCE, t): apart.at_once}
    seconds = race(calls, args.rounds, args.device)
    rows = []
    for threads in args.threads:
        row: dict[str, Any] = {
            "threads": threads,
            "candidates": summarise(seconds, list(found), threads, counts["n_samples"]),
        }
        if threads in several:
            row |= compare_threads(seconds, threads)
        if threads in machines and case.model == "rgb" and not of_field:  # that is counted
            bound = roofline.bounds(work, roofline.Needs(**counts), machines[threads])
            row["bounds_ms"] = {key: 1e3 * value for key, value in asdict(bound).items()}
            row["least_ms"] = 1e3 * bound.least
        rows.append(row)
        print_row(row)
    return {
        "name": str(case),
        **asdict(case),
        **counts,
        "left_out": missing,
        "differences": differences,
        "rows": rows,
    }


def wanted(case: Case, args: argparse.Namespace) -> tuple[dict[str, Load], dict[str, str]]:
    """Who takes part in a case, and why the others do not."""
    found, missing = candidates.find(
        args.device, case.model, case.field if isinstance(case, FieldCase) else "dense"
    )
    missing |= {name: "not wanted" for name in args.without if found.pop(name, None)}
    return found, missing


def print_row(row: dict[str, Any]) -> None:
    """One number of threads of one case, a line each candidate."""
    print(
        f"  {'threads: ' + str(row['threads']):16s}{'ms':22s}over warpnerf         times one thread"
    )
    for name, figures in row["candidates"].items():
        print(
            f"  {name:16s}{show(figures['ms'], 1):22s}{show(figures['over_warpnerf'], 2):22s}"
            f"{show(figures['over_one_thread'], 2)}",
            flush=True,
        )
    if "apart_over_one_thread" in row:
        print(
            f"  that many apart: {show(row['apart_over_one_thread'], 2)} times one thread; "
            f"warpnerf reaches {show(row['share_of_apart'], 2)} of it",
            flush=True,
        )


def print_summary(records: list[dict[str, Any]]) -> None:
    """The medians again, all cases under each other; and how far warpnerf is from the bounds."""
    names = list(dict.fromkeys(name for r in records for name in r["rows"][0]["candidates"]))
    print("\nmedian ms of warpnerf, and how many times as long the others take\n")
    print(f"{'':48s}threads" + "".join(f"{name:>15s}" for name in names))
    for record in records:
        for row in record["rows"]:
            line = f"{record['name']:48s}{row['threads']:7d}"
            for name in names:
                figures = row["candidates"].get(name)
                if figures is None:
                    line += f"{'-':>15s}"
                elif name == OURS:
                    line += f"{figures['ms']['median']:15.1f}"
                else:
                    line += f"{figures['over_warpnerf']['median']:15.2f}"
            print(line)
    records = [record for record in records if "bounds_ms" in record["rows"][0]]
    if not records:
        return
    print("\nwarpnerf beside what the machine could do (see roofline.py), ms\n")
    columns = ("arithmetic", "traffic", "walk", "cached")
    head = "".join(f"{column:>12s}" for column in ("warpnerf", *columns, "over bound"))
    print(f"{'':48s}threads{head}")
    for record in records:
        for row in record["rows"]:
            ours = row["candidates"][OURS]["ms"]["median"]
            print(
                f"{record['name']:48s}{row['threads']:7d}{ours:12.1f}"
                + "".join(f"{row['bounds_ms'][column]:12.1f}" for column in columns)
                + f"{ours / row['least_ms']:12.1f}"
            )


def memory(grid: int, args: argparse.Namespace) -> list[dict[str, int]]:
    """Bytes that a step uses besides grid and gradient, at growing numbers of steps."""
    rows = []
    for n_steps in (args.steps // 2, args.steps, 2 * args.steps):
        work = make_workload("inside", grid, args.rays, n_steps)
        theirs = torch_eager.fastest(work, 1, args.device, rounds=1)
        used, room = WarpStep(work, args.threads[-1], args.device).scratch_bytes()
        rows.append(
            {
                "n_steps": n_steps,
                "n_samples": len(work.origins) * n_steps,
                "warpnerf_bytes": used,
                "warpnerf_room_bytes": room,
                "torch_bytes": theirs.saved_bytes(),
            }
        )
    print("\nmemory of a step besides grid and gradient (torch: held between the passes)\n")
    print("steps    samples    warpnerf MB    has room for    torch MB")
    for row in rows:
        print(
            f"{row['n_steps']:5d}  {row['n_samples']:9d}    {row['warpnerf_bytes'] / 1e6:11.2f}"
            f"    {row['warpnerf_room_bytes'] / 1e6:12.1f}    {row['torch_bytes'] / 1e6:8.1f}"
        )
    return rows


def main() -> None:
    parser = options(__doc__)
    parser.add_argument(
        "--grids", type=int, nargs="+", default=[64, 128, 160], help="nodes per axis"
    )
    parser.add_argument(
        "--threads", type=int, nargs="+", default=default_threads(), help="CPU threads, from 1 up"
    )
    parser.add_argument(
        "--models", nargs="+", default=list(DEFAULT_MODELS), choices=list(DEFAULT_MODELS)
    )
    add_fields(parser)
    parser.add_argument(
        "--without", nargs="+", default=[], choices=list(candidates.MODULES)[1:], metavar="NAME"
    )
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=256, help="per ray")
    parser.add_argument("--rounds", type=int, default=15)
    args = parser.parse_args()
    on_cuda = args.device.startswith("cuda")
    if on_cuda:
        args.threads = [1]
    cases = make_cases(args.grids, models_of(parser, args))
    dense = "dense" in args.fields

    found, missing = wanted(Case("random", args.grids[0]) if dense else cases[0], args)
    print(
        f"{args.rays} rays x {args.steps} steps, {args.rounds} rounds; median [95 % interval]\n"
        f"compared: {', '.join(found)}"
    )
    for name, reason in missing.items():
        print(f"left out: {name}, {reason}")
    measured_on = [] if on_cuda or not dense else args.threads
    machines = {t: roofline.measure(t, args.grids) for t in measured_on}
    for measured in machines.values():
        print(roofline.describe(measured))
    records = []
    for case in cases:
        records.append(run_case(case, args, machines))
        gc.collect()
    print_summary(records)
    record = {
        "benchmark": "throughput",
        "machine": machine(args.device, max(args.threads)),
        "n_rays": args.rays,
        "n_steps": args.steps,
        "rounds": args.rounds,
        "left_out": missing,
        "roofline": [asdict(measured) for measured in machines.values()],
        "operations_per_sample": roofline.OPERATIONS,
        "cases": records,
        "memory": memory(args.grids[0], args) if dense else [],
    }
    path = write_record(record, args.output, "throughput", args.device)
    print(f"\nrecord: {path}")
    print(plot_throughput(record, path.with_suffix(".png")))


if __name__ == "__main__":
    main()
