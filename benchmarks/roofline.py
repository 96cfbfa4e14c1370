"""What this machine can do, and how long a workload's step would take at that: a lower bound.

    python benchmarks/roofline.py

Measured, on a number of threads at once:

    stream    an array much larger than the caches, read and written: bytes a second, both counted
    line      a random 64-byte line read from a grid of some size, and added to a line of a gradient
              of that size, in the thread's own part: what nodes cost if they are in no cache
    peak      fused multiply-adds on vectors in registers: operations a second, two for each
    cached    a sample of warpnerf's step on a grid that lies in a core's own caches

Derived for a workload of the model rgb, in seconds:

    arithmetic  its samples times the operations of one, at peak. They are counted as the formulas
                need them, in OPERATIONS; shuffles, loads, stores, addresses and what depends on the
                result before it come on top, so no program gets near it
    traffic     each line of the grid that a sample needs read once, each line of the gradient
                written once, at the rate of the stream: for any order of the work
    walk        the lines that 64 rays in a row need, counted once for those 64, at the cost of a
                random line: for whoever takes ray after ray
    cached      its samples at that cost: warpnerf if memory cost nothing

The first two bound every program on this machine; walk binds the order that most programs work in,
cached this one program.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np
import warp as wp
from candidates.warpnerf_step import WarpStep
from measuring import Stopwatch, default_threads, options
from workload import Workload, make_workload

from warpnerf.runtime.parallel import Workers

OPERATIONS = {
    "place a sample: distance, position, box test, cell, fraction, shares of columns": 38,
    "read: four columns of two nodes of four channels, then between the two": 68,
    "shade: five exponentials, a logarithm, five divisions, opacity": 125,
    "composite, and what flows back into density and colour, scaled": 40,
    "scatter it to eight nodes of four channels": 84,
}
"""Floating-point operations of a sample, by what they are for."""

LINE = 64
"""Bytes."""
SHARING = 64
"""Rays in a row whose common lines are counted once: their lines fit into a core's own caches."""
STREAM_BYTES = 1 << 28

WIDE = "typedef float wide __attribute__((ext_vector_type(16), aligned(4), may_alias));"


@wp.func_native(
    WIDE
    + """
const size_t n = data.shape[0] / n_workers;
wide* x = (wide*)(data.data + worker * n);
for (size_t i = 0; i < n / 16; ++i) x[i] = x[i] * 1.0000001f;
"""
)
def update_stream(data: wp.array(dtype=wp.float32), worker: int, n_workers: int):
    """Multiply a worker's share of an array by a number."""
    ...


@wp.func_native(
    WIDE
    + """
const size_t n_lines = grid.shape[0] / 16, n_own = n_lines / n_workers;
const wide* from = (const wide*)grid.data;
wide* to = (wide*)gradient.data + worker * n_own;
for (unsigned i = 0; i < (unsigned)count; ++i) {
    unsigned long long x = (i + 1ull + ((unsigned long long)worker << 32)) * 0x9E3779B97F4A7C15ull;
    x = (x ^ (x >> 32)) * 0xD6E8FEB86659FD93ull;
    to[((x >> 32) * n_own) >> 32] += from[((x >> 32) * n_lines) >> 32];
}
"""
)
def visit_lines(
    grid: wp.array(dtype=wp.float32),
    gradient: wp.array(dtype=wp.float32),
    worker: int,
    n_workers: int,
    count: int,
):
    """Read random lines of the grid, and add them to lines of the worker's part of the gradient."""
    ...


@wp.func_native(
    WIDE
    + """
wide x[10];
for (int j = 0; j < 10; ++j) x[j] = wide(out.data[worker] + j);
const wide a = wide(0.999f), b = wide(0.001f);
for (int i = 0; i < count; ++i) {
    #pragma clang loop unroll(full)
    for (int j = 0; j < 10; ++j) {
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
        x[j] = __builtin_elementwise_fma(x[j], a, b);
#else
        x[j] = x[j] * a + b;
#endif
    }
}
wide sum = x[0];
for (int j = 1; j < 10; ++j) sum += x[j];
out.data[worker] = sum[0] + sum[15];
"""
)
def multiply_add(out: wp.array(dtype=wp.float32), worker: int, count: int):
    """Ten chains of fused multiply-adds on sixteen numbers each."""
    ...


@wp.kernel(enable_backward=False)
def stream(first: int, worker: int, n_workers: int, data: wp.array(dtype=wp.float32)):
    update_stream(data, worker, n_workers)


@wp.kernel(enable_backward=False)
def lines(
    first: int,
    worker: int,
    count: int,
    grid: wp.array(dtype=wp.float32),
    gradient: wp.array(dtype=wp.float32),
    n_workers: int,
):
    visit_lines(grid, gradient, worker, n_workers, count)


@wp.kernel(enable_backward=False)
def peak(first: int, worker: int, count: int, out: wp.array(dtype=wp.float32)):
    multiply_add(out, worker, count)


@dataclass(frozen=True, kw_only=True)
class Machine:
    """What it did, on that many threads at once."""

    threads: int
    stream: float
    """Bytes a second."""
    line: dict[int, float]
    """Seconds for a line of a grid with so many nodes along each axis, for all threads together."""
    peak: float
    """Operations a second."""
    cached: float
    """Seconds for a sample."""


def measure(threads: int, grids: list[int], repeats: int = 5) -> Machine:
    """The machine at its fastest of some repeats."""
    workers = Workers("cpu", threads)
    stopwatch = Stopwatch("cpu")

    def seconds(kernel: wp.Kernel, *arguments: object) -> float:
        def launch() -> None:
            workers.launch_owned(kernel, threads, *arguments)

        launch()
        return min(stopwatch.seconds(launch) for _ in range(repeats))

    # What is read is written first: memory that never was lies nowhere.
    data = wp.full(STREAM_BYTES // 4, 1.0, dtype=wp.float32, device="cpu")
    streamed = 2 * STREAM_BYTES / seconds(stream, threads, data)
    del data
    per_line = {}
    n_lines, n_chains = 1 << 21, 1 << 21
    for grid in grids:
        numbers = 4 * grid**3
        values = wp.full(numbers, 1.0, dtype=wp.float32, device="cpu")
        gradient = wp.full(numbers, 1.0, dtype=wp.float32, device="cpu")
        cost = seconds(lines, n_lines, values, gradient, threads)
        per_line[grid] = cost / (n_lines * threads)
    out = wp.zeros(threads, dtype=wp.float32, device="cpu")
    operations = 2 * 16 * 10 * n_chains * threads
    small = make_workload("random", 16, 4096, 256)
    step = WarpStep(small, threads, "cpu").step
    step()
    return Machine(
        threads=threads,
        stream=streamed,
        line=per_line,
        peak=operations / seconds(peak, n_chains, out),
        cached=min(stopwatch.seconds(step) for _ in range(repeats)) / needs(small).n_samples,
    )


@dataclass(frozen=True, kw_only=True)
class Needs:
    """What a workload touches."""

    n_samples: int
    lines: int
    """Different lines of the grid that its samples need."""
    lines_by_rays: int
    """The same, counted again every 64 rays."""


def needs(work: Workload) -> Needs:
    """Count what a workload touches."""
    q, needed = work.positions()
    nodes = np.array(work.values.shape[:3])
    lowest = np.minimum(((q[needed] + 1.0) * (0.5 * (nodes - 1))).astype(np.int64), nodes - 2)
    base = (lowest[:, 0] * nodes[1] + lowest[:, 1]) * nodes[2] + lowest[:, 2]
    group = np.repeat(np.arange(len(needed)) // SHARING, needed.sum(axis=1))
    node_bytes = work.values.shape[3] * 4  # a power of two
    n_lines = -(-math.prod(nodes) * node_bytes // LINE)
    touched = np.zeros((group.max(initial=0) + 1, n_lines), bool)
    for column in (0, nodes[2], nodes[1] * nodes[2], (nodes[1] + 1) * nodes[2]):
        for node in (base + column, base + column + 1):
            for byte in range(0, node_bytes, LINE):
                touched[group, (node * node_bytes + byte) // LINE] = True
    return Needs(
        n_samples=len(base),
        lines=int(touched.any(axis=0).sum()),
        lines_by_rays=int(touched.sum()),
    )


@dataclass(frozen=True, kw_only=True)
class Bounds:
    """Seconds of a step, as above."""

    arithmetic: float
    traffic: float
    walk: float
    cached: float

    @property
    def least(self) -> float:
        """What no program on this machine undercuts."""
        return max(self.arithmetic, self.traffic)


def bounds(work: Workload, needed: Needs, machine: Machine) -> Bounds:
    """How long a workload's step takes at the machine's best."""
    return Bounds(
        arithmetic=needed.n_samples * sum(OPERATIONS.values()) / machine.peak,
        traffic=needed.lines * 2 * LINE / machine.stream,
        walk=needed.lines_by_rays * machine.line[work.values.shape[0]],
        cached=needed.n_samples * machine.cached,
    )


def describe(machine: Machine) -> str:
    """As text, one line."""
    per_line = ", ".join(f"{1e9 * s:.2f} ns at {n}^3" for n, s in machine.line.items())
    return (
        f"{machine.threads} threads: stream {machine.stream / 1e9:.1f} GB/s; line {per_line}; "
        f"peak {machine.peak / 1e9:.0f} G operations/s; "
        f"cached {1e9 * machine.cached:.1f} ns a sample"
    )


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--grids", type=int, nargs="+", default=[64, 128, 160])
    args = parser.parse_args()
    for threads in default_threads():
        machine = measure(threads, args.grids)
        print(describe(machine))
        for grid in args.grids:
            work = make_workload("random", grid, 4096, 256)
            needed = needs(work)
            bound = {
                k: f"{1e3 * v:.1f} ms" for k, v in asdict(bounds(work, needed, machine)).items()
            }
            print(f"  {grid}^3, random rays: {asdict(needed)}, {bound}")


if __name__ == "__main__":
    main()
