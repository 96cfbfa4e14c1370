"""What it brings that rays of a batch follow each other by where their middles lie.

    python benchmarks/ray_order.py builtin:room path/to/scene --time-limit 25

Scenes are as for training.py. Each is trained; then batches of one, four and sixteen steps go
through the training pass twice in turns, as they do, and in each worker's slabs of the grid as they
are drawn. Prints the ratios of their times and writes benchmarks/results/ray_order_cpu.json.
"""

from __future__ import annotations

from functools import partial
from typing import Any
from unittest import mock

import numpy as np
import warp as wp
from measuring import (
    Stopwatch,
    add_model,
    machine,
    median_interval,
    options,
    plain_training,
    show,
    write_record,
)
from training import path_of
from warpnerf_kernels.base.types import vec3
from warpnerf_kernels.cpu import schedule
from warpnerf_kernels.launch import packed

import warpnerf as wn
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.render import TrainingPass
from warpnerf.rendering.structs import variant_of
from warpnerf.runtime.parallel import Workers

SLAB = sum(1 << (3 * bit + 2) for bit in range(schedule.BITS))
"""The bits of a cell's number that name its slab."""
cell_at = schedule.cell_at


@wp.func
def cell_of_slab(x: vec3) -> int:
    """The same for all cells of a slab, so that their rays stay as they are."""
    return cell_at(x) & wp.static(SLAB)


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--time-limit", type=float, default=25.0, help="seconds of training each")
    parser.add_argument("--steps", type=int, default=100_000, help="at most so many steps")
    parser.add_argument("--downscale", type=int, default=1)
    add_model(parser)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=12)
    arguments = parser.parse_args()
    if arguments.device != "cpu":
        parser.error("rays are put in order on the CPU only")
    rows: dict[str, dict[str, Any]] = {}
    print("scene           threads  steps  time in order over time as drawn")
    for name in arguments.scenes:
        scene = wn.load_scene(path_of(name), downscale=arguments.downscale)
        config = plain_training(
            model=arguments.model,
            steps=arguments.steps,
            time_limit=arguments.time_limit,
        )
        field = wn.train(scene, config, progress=False).field
        rows[name] = {}
        for threads in arguments.threads:
            for steps in (1, 4, 16):
                found = median_interval(ratios(scene, field, steps, threads, arguments.rounds))
                rows[name][f"{threads} threads, {steps} steps"] = found
                print(f"{name:14}  {threads:7}  {steps:5}  {show(found, 2)}", flush=True)
    record = {
        "machine": machine("cpu", max(arguments.threads)),
        "model": arguments.model,
        "time_limit": arguments.time_limit,
        "rounds": arguments.rounds,
        "scenes": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'ray_order', 'cpu')}")


def ratios(scene: wn.Scene, field: wn.Field, steps: int, threads: int, rounds: int) -> list[float]:
    """Of each round, with a batch of its own: the time in order over that as drawn."""
    workers = Workers("cpu", threads)
    n_rays = wn.TrainConfig().rays_per_step
    views = [scene.views[i] for i in scene.splits["train"]]
    distances = np.full(len(views), scene.content_distance)
    sampler = PixelSampler(views, distances, None, n_rays, True, 0, workers)
    ordered, drawn = (
        TrainingPass(
            steps * n_rays,
            field.model,
            field.storage,
            field.weights,
            field.steps,
            "clamped",
            "none",
            workers,
        )
        for _ in range(2)
    )
    drawn.launch._kernel = as_drawn(field, workers)
    watch, found = Stopwatch("cpu"), []
    for turn in range(rounds + 1):
        batch = sampler.draw(turn * steps, steps)
        passes = (ordered, drawn) if turn % 2 else (drawn, ordered)
        seconds = {p: watch.seconds(partial(p.run, field.free, batch, steps)) for p in passes}
        if turn == 0:  # the first finds nothing in memory, and is compared
            a, b = (p.gradients.values.numpy() for p in (ordered, drawn))
            assert np.abs(a - b).max() <= 1e-4 * np.abs(b).max()
        else:
            found.append(seconds[ordered] / seconds[drawn])
    return found


def as_drawn(field: wn.Field, workers: Workers) -> wp.Kernel:
    """The kernel of a training pass, but for it all cells of a slab are one."""
    variant = variant_of(
        field.model, "float32", field.lattice.contraction, "clamped", "none", packed=True
    )
    # All recomputed, for what is kept of them has the cells.
    with (
        mock.patch.object(schedule, "cell_at", cell_of_slab),
        mock.patch.object(packed, "ray_schedule", schedule.ray_schedule.__wrapped__),
        mock.patch.object(packed, "ray_taker", packed.ray_taker.__wrapped__),
    ):
        kernel = packed.train.__wrapped__(variant)
        workers.load(kernel)
    return kernel


if __name__ == "__main__":
    main()
