"""warpnerf's steps in this tree against those in another: is a change slower, and by how much?

    git worktree add ../before COMMIT
    python benchmarks/against.py ../before

The rows are those of throughput.py. Both trees have a process each, with their own modules and
their own kernels; both stay, and take turns: commands go over a pipe. First the two compare what
they compute. In a turn the better of two steps counts, ratios are formed round by round. Where a
process has its arrays lie makes steps a few percent faster or slower for as long as it lives, so
both are started several times: the interval of all rounds is that of these processes, and beside
it stand the least and the greatest median of a start. What is left can be seen by comparing a tree
with a copy of itself. The ratio of the cores' time leaves out when others had the cores; on several
threads it counts a worker that waits for another as at work.

Prints a table and writes benchmarks/results/against_cpu.json.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from cases import Case, make_cases
from measuring import (
    ROOT,
    commit,
    default_threads,
    machine,
    median_interval,
    options,
    show,
    write_record,
)
from throughput import TOLERANCE

Times = tuple[float, float]
"""Seconds of a step, and of the cores in it."""


class Process:
    """one_tree.py in a tree."""

    def __init__(self, tree: Path) -> None:
        """Start it."""
        self._tree = tree
        path = os.pathsep.join(str(tree / part) for part in ("benchmarks", ".", "kernels"))
        # -P: the script's own folder is not this tree's benchmarks.
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(ROOT / "benchmarks" / "one_tree.py")],
            env=os.environ | {"PYTHONPATH": path},
            cwd=tree,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def ask(self, name: str, *arguments: Any) -> Any:
        """Call a method of its Tree."""
        assert self._process.stdin and self._process.stdout
        try:
            self._process.stdin.write(json.dumps([name, arguments]) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        answer = self._process.stdout.readline()
        if not answer:  # it has said why
            raise SystemExit(f"against: the process in {self._tree} has ended.")
        return json.loads(answer)

    def end(self) -> None:
        """No more commands."""
        assert self._process.stdin and self._process.stdout
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def compare(ours: Process, theirs: Process) -> dict[str, float]:
    """The greatest differences in colours and gradient, as shares of the largest value.

    Raises:
        SystemExit: They do not compute the same.
    """
    with tempfile.TemporaryDirectory() as folder:
        paths = [f"{folder}/{name}.npz" for name in ("ours", "theirs")]
        for process, path in zip((ours, theirs), paths, strict=True):
            process.ask("results", path)
        a, b = (np.load(path) for path in paths)
        found = {
            key: float(np.abs(a[key] - b[key]).max() / np.abs(b[key]).max())
            for key in ("rgb", "gradient")
        }
    for what, difference in found.items():
        if not difference < TOLERANCE:
            raise SystemExit(
                f"against: the trees differ in {what} by {difference:.1e} of the largest value "
                f"(allowed: {TOLERANCE}); there is nothing to time."
            )
    return found


def rounds_of(ours: Process, theirs: Process, rounds: int) -> list[tuple[Times, Times]]:
    """Times of ours and theirs, in turns."""
    found = []
    for turn in range(rounds):
        order = (ours, theirs) if turn % 2 else (theirs, ours)
        seconds = {process: process.ask("seconds", 2) for process in order}
        found.append((seconds[ours], seconds[theirs]))
    return found


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("tree", type=Path, help="the other checkout")
    parser.add_argument("--grids", type=int, nargs="+", default=[64, 128, 160])
    parser.add_argument("--models", nargs="+", help="default: all that the other tree has")
    parser.add_argument("--threads", type=int, nargs="+", default=default_threads())
    parser.add_argument("--rays", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=256, help="per ray")
    parser.add_argument("--starts", type=int, default=5, help="of both processes")
    parser.add_argument("--rounds", type=int, default=12, help="of each start")
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("this one compares CPUs")
    tree = args.tree.resolve()
    rows = [(case, threads) for case in make_cases(args.grids) for threads in args.threads]
    if args.models:
        rows = [(case, threads) for case, threads in rows if case.model in args.models]
    left_out: list[str] = []
    seconds: dict[tuple[Case, int], list[list[tuple[Times, Times]]]] = {}
    differences: dict[tuple[Case, int], dict[str, float]] = {}
    for start in range(args.starts):
        # Whoever is first may get the better memory.
        trees = (ROOT, tree) if start % 2 else (tree, ROOT)
        processes = {at: Process(at) for at in trees}
        ours, theirs = processes[ROOT], processes[tree]
        for case, threads in rows:
            if not (ours.ask("knows", case.model) and theirs.ask("knows", case.model)):
                left_out += [str(case)] if str(case) not in left_out else []
                continue
            for at in trees:
                processes[at].ask("load", asdict(case), args.rays, args.steps, threads)
            differences[case, threads] = compare(ours, theirs)
            found = rounds_of(ours, theirs, args.rounds)
            seconds.setdefault((case, threads), []).append(found)
        for process in processes.values():
            process.end()
        print(f"start {start + 1} of {args.starts} done", file=sys.stderr, flush=True)
    records = []
    print(
        f"{args.starts} starts of {args.rounds} rounds; time here over time in {tree.name}: median "
        "[95 % interval], least and greatest median of a start\n"
    )
    print(
        f"{'':48s}threads   here, ms             ratio                starts           of the cores"
    )
    for (case, threads), starts in seconds.items():
        medians = [float(np.median([a[0] / b[0] for a, b in found])) for found in starts]
        pairs = [pair for found in starts for pair in found]
        record = {
            "name": str(case),
            **asdict(case),
            "threads": threads,
            "here_ms": median_interval(1e3 * a for (a, _), _ in pairs),
            "there_ms": median_interval(1e3 * b for _, (b, _) in pairs),
            "ratio": median_interval(a[0] / b[0] for a, b in pairs),
            "ratio_of_cores": median_interval(a[1] / b[1] for a, b in pairs),
            "ratio_by_start": medians,
            "differences": differences[case, threads],
        }
        records.append(record)
        print(
            f"{case!s:48s}{threads:7d}   {show(record['here_ms'], 1):21s}"
            f"{show(record['ratio'], 3):21s}{min(medians):.3f} to {max(medians):.3f}   "
            f"{show(record['ratio_of_cores'], 3)}",
            flush=True,
        )
    for name in left_out:
        print(f"left out: {name}, which one of the trees does not know")
    record = {
        "benchmark": "against",
        "machine": machine("cpu", max(args.threads)),
        "commits": {"here": commit(ROOT), "there": commit(tree)},
        "n_rays": args.rays,
        "n_steps": args.steps,
        "starts": args.starts,
        "rounds": args.rounds,
        "left_out": left_out,
        "rows": records,
    }
    print(f"\nrecord: {write_record(record, args.output, 'against', 'cpu')}")


if __name__ == "__main__":
    main()
