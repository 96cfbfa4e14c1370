"""How much faster a training step is on several threads, while their cores are really theirs.

    python benchmarks/threads.py

The steps are those of throughput.py. Machines are shared: two cores of a virtual one may for a
while be the halves of one core, or somebody else's, and then no program is faster on both. So each
step is timed between two controls: multiply-adds in registers, on as many threads. It counts where
neither took more than a tenth longer than one thread alone does when it is not disturbed (the fifth
percentile of its controls); what others do to the memory these do not see. One thread and several
take turns; a round counts where all its steps do. Prints medians with 95 % intervals of the rounds
that count and of all, and writes benchmarks/results/threads_cpu.json.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import roofline
import warp as wp
from candidates.warpnerf_step import WarpStep
from cases import make_cases
from measuring import Stopwatch, machine, median_interval, options, show, write_record

from warpnerf.runtime.parallel import Workers

CHAINS = 1_200_000
"""Rounds of multiply-adds of a control: some 4 ms, of which the launch is a few hundredths."""
ALLOWED = 1.1
"""How much longer than undisturbed a control may take."""

Round = dict[int, tuple[float, float]]
"""By number of threads: seconds of a step, and of the longer of the two controls around it."""


def time_rounds(
    steps: dict[int, Callable[[], None]], controls: dict[int, Callable[[], None]], rounds: int
) -> list[Round]:
    """Steps on one thread and on several, each between its controls, in turns."""
    watch = Stopwatch("cpu")
    found = []
    for turn in range(rounds):
        order = list(steps) if turn % 2 else list(reversed(steps))
        timed: Round = {}
        for threads in order:
            steps[threads]()  # finds the caches as the others left them
            before = watch.seconds(controls[threads])
            seconds = watch.seconds(steps[threads])
            timed[threads] = seconds, max(before, watch.seconds(controls[threads]))
        found.append(timed)
    return found


def undisturbed(rounds: Sequence[Round]) -> list[Round]:
    """Those whose controls found the cores free."""
    alone = float(np.quantile([timed[1][1] for timed in rounds], 0.05))
    return [r for r in rounds if all(control <= ALLOWED * alone for _, control in r.values())]


def summarise(rounds: Sequence[Round], threads: int) -> dict[str, Any]:
    """Milliseconds on one thread and on several, and how many times as fast the latter are."""
    return {
        "rounds": len(rounds),
        "one_ms": median_interval(1e3 * r[1][0] for r in rounds),
        "several_ms": median_interval(1e3 * r[threads][0] for r in rounds),
        "times_as_fast": median_interval(r[1][0] / r[threads][0] for r in rounds),
    }


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--grids", type=int, nargs="+", default=[64, 128, 160])
    parser.add_argument("--threads", type=int, default=2, help="to compare with one")
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=256, help="per ray")
    parser.add_argument("--rounds", type=int, default=200)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("threads are the CPU's")
    if args.threads < 2:
        parser.error("--threads is to be compared with one: 2 or more")
    several = args.threads
    controls: dict[int, Callable[[], None]] = {}
    for threads in (1, several):
        workers = Workers("cpu", threads)
        out = wp.zeros(threads, dtype=wp.float32, device="cpu")
        controls[threads] = partial(workers.launch_owned, roofline.peak, threads, CHAINS, out)
        controls[threads]()
    cases = []
    print(f"{'':48s}one thread, ms       {several} threads, ms        times as fast      rounds")
    for case in make_cases(args.grids):
        work = case.workload(args.rays, args.steps)
        steps = {threads: WarpStep(work, threads, "cpu").step for threads in (1, several)}
        for step in steps.values():
            step()
        rounds = time_rounds(steps, controls, args.rounds)
        kept = undisturbed(rounds)
        record = {"name": str(case), "all": summarise(rounds, several), "undisturbed": None}
        if kept:
            record["undisturbed"] = summarise(kept, several)
        cases.append(record)
        for which in ("undisturbed", "all"):
            print_row(str(case) if which == "undisturbed" else "  all rounds", record[which])
    record = {
        "benchmark": "threads",
        "machine": machine("cpu", several),
        "n_rays": args.rays,
        "n_steps": args.steps,
        "allowed": ALLOWED,
        "cases": cases,
    }
    print(f"\nrecord: {write_record(record, args.output, 'threads', 'cpu')}")


def print_row(name: str, figures: dict[str, Any] | None) -> None:
    """One line."""
    if figures is None:
        print(f"{name:48s}no round without somebody else on the cores", flush=True)
        return
    print(
        f"{name:48s}{show(figures['one_ms'], 1):21s}{show(figures['several_ms'], 1):21s}"
        f"{show(figures['times_as_fast'], 2):19s}{figures['rounds']}",
        flush=True,
    )


if __name__ == "__main__":
    main()
