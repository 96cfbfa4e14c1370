"""A whole training step of each model: warpnerf against the best eager torch that does the same.

    python benchmarks/against_torch.py lego_200
    python benchmarks/against_torch.py dense sphere --models dvgo
    python benchmarks/against_torch.py lego_200 fox_q --field vm

A step marches, composites, takes the squared error, goes back through all of it with gradients
scaled by distance, and updates nodes and network by Adam, which leaves nodes alone that no ray has
touched. Beside it the pass alone, without Adam. What is marched through:

    a capture    as for training.py, of a bounded scene: each model is trained on it by warpnerf up
                 to nine tenths of its schedule; from there come grid, network, free space, and a
                 batch of the rays that training draws, which end where they end in training
    dense        the cases of throughput.py: random values everywhere,
    sphere       and a solid one in empty space

Models are as they are by default, and `dvgo`: a density and 12 features in each node and for each
sample of a weight above 1e-4 an MLP of two hidden layers of 128 units that sees the features and
the encoded direction; trained by its preset, in steps of half a voxel.

With `--field` the trained field is one of factors, or a hash, in bounded scenes and in unbounded
ones. Torch is told where the samples lie that warpnerf visits, so it need not march.

Colours and gradients are compared first; where rays end early, a sample more or less at their ends
may show in colours by the light that is left there. Then the two take turns. Each counts with its
better number of threads. Ratios are formed round by round; figures are medians with 95 % intervals.
Prints a table and writes benchmarks/results/against_torch_cpu.json.
"""

from __future__ import annotations

import gc
import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from candidates import warpnerf_step
from candidates.torch_adam import MaskedAdam, Way
from candidates.torch_fields import FieldChoices, TorchFields
from candidates.torch_models import Choices, TorchModels
from field_workload import FIELDS, OF_FIELDS, FieldWorkload, late_field
from measuring import (
    Stopwatch,
    default_threads,
    machine,
    median_interval,
    named,
    options,
    show,
    write_record,
)
from models import train_until_late
from throughput import AT_KINKS, TOLERANCE, check, race
from training import path_of
from workload import CAMERA_DISTANCE, MODELS, ModelName, Workload, make_workload, split_network

import warpnerf as wn
from warpnerf.fields.parameters import head_parameters
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import adam_step, first_states
from warpnerf.training.trainer import Trainer

RATE = 1e-8
"""How far an update moves an entry: too little to change what the next step has to do."""
AT_ENDS = 1e-4
"""The share of the gradient's values that may differ by more where rays end early: which sample is
the last may hang on rounding."""
MADE = ("dense", "sphere")
"""Scenes of throughput.py."""


class WarpStep:
    """The training pass, and Adam, which zeroes the gradient."""

    def __init__(self, work: Workload, threads: int) -> None:
        """Load a workload."""
        self._workers = workers = Workers("cpu", threads)
        self._free, self._batch = work.free_cells(workers), work.batch(workers)
        model, grid, weights = work.warp_model(), work.voxel_grid(workers), work.weights(workers)
        self._config = OptimConfig()
        self._parameters = grid.parameters(model, self._config) + head_parameters(model, weights)
        self._states = first_states(self._parameters, workers)
        self._update = 0
        scaling = "clamped" if work.scaled else "none"
        self._pass = TrainingPass(
            self._batch.count, model, grid, weights, work.steps(), scaling, "none", workers
        )

    def step(self) -> None:
        """A whole step."""
        self._pass.run(self._free, self._batch)
        self._update += 1
        adam_step(
            self._parameters,
            self._states,
            self._pass.gradients,
            self._update,
            RATE,
            self._config,
            self._workers,
        )


class TorchStep:
    """The best eager torch, and Adam in eager torch."""

    def __init__(self, work: Workload, threads: int) -> None:
        """Load a workload."""
        self._pass = torch_of(work, threads)
        self._grid = MaskedAdam(self._pass.tables, RATE)
        weights = self._pass.weights
        self._weights = torch.optim.Adam(weights, lr=RATE, betas=(0.9, 0.99)) if weights else None
        self._of_pass = self._of_step = self._pass.choices

    def run_pass(self) -> None:
        """The pass alone."""
        self._run(self._of_pass)

    def step(self) -> None:
        """A whole step."""
        self._run(self._of_step)
        self._grid.step()
        if self._weights is not None:
            self._weights.step()

    def _run(self, choices: Choices) -> None:
        self._pass.choices = choices
        self._pass.step()

    def choose(self, rounds: int) -> str:
        """Take what is fastest here, for the pass and for the step; describe it."""
        seconds = Stopwatch("cpu").seconds
        ways: tuple[Way, ...] = ("all", "rows")
        passes = self._pass.ways()
        spent = dict.fromkeys(passes, math.inf)
        for choices in passes * rounds:
            self._run(choices)  # leaves what the next one zeroes
            spent[choices] = min(spent[choices], seconds(lambda c=choices: self._run(c)))
        self._of_pass = min(spent, key=lambda choices: spent[choices])
        updates: dict[tuple[bool, Way], float] = {}
        noting = sorted({choices.sparse for choices in passes})
        for sparse, way in list(itertools.product(noting, ways)) * rounds:
            self._of_step, self._grid.way = replace(self._of_pass, sparse=sparse), way
            self.step()
            updates[sparse, way] = min(updates.get((sparse, way), math.inf), seconds(self.step))
        sparse, self._grid.way = min(updates, key=lambda key: updates[key])
        self._of_step = replace(self._of_pass, sparse=sparse)
        noted = ", touched nodes noted" if sparse else ""
        return (
            f"{self._of_pass.parts} parts, {self._of_pass.words}; "
            f"with Adam over {self._grid.way}{noted}"
        )


def torch_of(work: Workload, threads: int, parts: int = 1) -> TorchModels:
    """The torch of a workload."""
    if isinstance(work, FieldWorkload):
        return TorchFields(work, FieldChoices(threads=threads, parts=parts))
    return TorchModels(work, Choices(threads=threads, parts=parts))


def made_workload(scene: Any, model: ModelName, grid: int, n_rays: int) -> Workload:
    """A case of throughput.py; of dvgo in steps of half a voxel, of others in steps of one."""
    reach = CAMERA_DISTANCE + math.sqrt(3.0)
    n_steps = round(reach * (grid - 1) * (1.0 if model == "dvgo" else 0.5))
    return make_workload("random", grid, n_rays, n_steps, scene=scene, model=model)


def late_workload(scene: wn.Scene, model: ModelName, steps: int, voxels: int) -> Workload:
    """Where a training stands at nine tenths of its schedule, and a batch of its rays: dense."""
    if scene.kind == "unbounded":
        raise SystemExit(f"against_torch: {scene.name} is unbounded, which torch is not here.")
    config = wn.PRESETS["dvgo" if model == "dvgo" else "fast"]
    if model != "dvgo":
        config = replace(config, model=named(model))
    config = replace(config, steps=steps, grid=replace(config.grid, voxels=voxels))
    state = train_until_late(scene, config)
    trainer = Trainer(scene, state.config, state)
    grid, march, batch = trainer.storage, trainer.march_steps(), trainer._sampler.draw(steps)
    origins = batch.origins.numpy()
    corners = np.array(
        list(itertools.product(*zip(grid.lattice.box_min, grid.lattice.box_max, strict=True)))
    )
    reach = np.linalg.norm(origins[:, None] - corners, axis=2).max()
    return Workload(
        values=grid.values.numpy().reshape(*grid.lattice.size, -1),
        free=trainer.free.distance.numpy().reshape(trainer.free.size),
        origins=origins,
        directions=batch.directions.numpy(),
        target_rgb=batch.target_rgb.numpy(),
        n_steps=math.ceil(reach / march.step),
        step=march.step,
        background=tuple(batch.background.numpy()[0].tolist()),
        content_distance=trainer.plan.content_distance,
        box=(grid.lattice.box_min, grid.lattice.box_max),
        density_shift=grid.density_shift,
        density_scale=grid.density_scale,
        transmittance_min=march.transmittance_min,
        model=model,
        network=split_network(MODELS[model], trainer.weights.numpy()),
    )


def compare(work: Workload, thread_counts: list[int], rounds: int) -> dict[str, Any]:
    """Check one case, and time it."""
    sides = {
        ("warpnerf", 1): warpnerf_step.load(work, 1, "cpu"),
        ("torch", 1): torch_of(work, 1, parts=16),
    }
    of_field = isinstance(work, FieldWorkload)
    kinks = AT_KINKS.get(work.model, AT_ENDS if work.transmittance_min > 0.0 else 0.0)
    differences = check(sides, kinks, max(TOLERANCE, work.transmittance_min), of_field)
    n_samples = sides["warpnerf", 1].n_samples()
    del sides
    gc.collect()
    theirs = {threads: TorchStep(work, threads) for threads in thread_counts}
    choices = {threads: step.choose(1 if of_field else 2) for threads, step in theirs.items()}
    ours = {threads: WarpStep(work, threads) for threads in thread_counts}
    passes = {threads: warpnerf_step.load(work, threads, "cpu") for threads in thread_counts}
    calls = {("warpnerf", t): ours[t].step for t in ours}
    calls |= {("torch", t): theirs[t].step for t in theirs}
    calls |= {("warpnerf, pass", t): passes[t].step for t in passes}
    calls |= {("torch, pass", t): theirs[t].run_pass for t in theirs}
    seconds = race(calls, rounds, "cpu")

    def best(name: str) -> list[float]:
        return [min(s for (n, _), s in turn.items() if n == name) for turn in seconds]

    figures: dict[str, Any] = {}
    for what, end in (("step", ""), ("pass", ", pass")):
        ours_best, theirs_best = best("warpnerf" + end), best("torch" + end)
        figures |= {
            f"warpnerf_{what}_ms": median_interval(1e3 * s for s in ours_best),
            f"torch_{what}_ms": median_interval(1e3 * s for s in theirs_best),
            f"{what}_over_warpnerf": median_interval(
                b / a for a, b in zip(ours_best, theirs_best, strict=True)
            ),
        }
    return {
        "model": work.model,
        "nodes": list(work.values.shape[:3]),
        "n_rays": len(work.origins),
        "n_steps": work.n_steps,
        "n_samples": n_samples,
        "differences": differences,
        "torch_choices": choices,
        **figures,
    }


def print_row(row: dict[str, Any]) -> None:
    """One model in one scene."""
    print(
        f"{row['scene']:14s}{row['model']:10s}{row['n_samples'] / row['n_rays']:8.1f}   "
        f"{row['warpnerf_step_ms']['median']:9.1f}{row['torch_step_ms']['median']:9.1f}   "
        f"{show(row['step_over_warpnerf'], 2):21s}"
        f"{row['warpnerf_pass_ms']['median']:9.1f}{row['torch_pass_ms']['median']:9.1f}   "
        f"{show(row['pass_over_warpnerf'], 2):21s}",
        flush=True,
    )


def main() -> None:
    parser = options(__doc__)
    known = "dense, sphere, builtin:room, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--models", nargs="+", choices=list(MODELS), help="default: all; deferred")
    parser.add_argument("--field", choices=FIELDS, help="in place of a dense grid; of captures")
    parser.add_argument("--grid", type=int, default=160, help="nodes along an axis, or their mean")
    parser.add_argument("--rays", type=int, default=8192, help="of dense and sphere")
    parser.add_argument("--steps", type=int, default=4000, help="of a capture's training")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--threads", type=int, nargs="+", default=default_threads())
    parser.add_argument("--rounds", type=int, default=8)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("this one measures CPUs")
    if args.field is not None and not set(args.scenes).isdisjoint(MADE):
        parser.error(f"{' and '.join(MADE)} are dense grids")
    if args.field is not None and not set(args.models or ()) <= set(OF_FIELDS):
        parser.error(f"--field goes with {', '.join(OF_FIELDS)}")
    models = args.models or (list(MODELS) if args.field is None else ["deferred"])
    print(
        f"{args.rounds} rounds; median [95 % interval]\n\n{'scene':14s}{'model':10s}samples/ray  "
        "a step, ms: ours, torch's; torch's over ours     the pass likewise"
    )
    rows = []
    for name in args.scenes:
        is_made = name in MADE
        scene = None if is_made else wn.load_scene(path_of(name), downscale=args.downscale)
        for model in models:
            if scene is None and model == "rgb":
                print(f"{name}: rgb is left out, for which throughput.py has a faster torch")
                continue
            if scene is None:
                work = made_workload(name, model, args.grid, args.rays)
            elif args.field is not None:
                work = late_field(scene, model, args.field, args.steps, args.grid**3)
            else:
                work = late_workload(scene, model, args.steps, args.grid**3)
            row = {"scene": name, **compare(work, args.threads, args.rounds)}
            rows.append(row)
            print_row(row)
            del work
            gc.collect()
    record = {
        "benchmark": "against_torch",
        "machine": machine("cpu", max(args.threads)),
        "grid": args.grid,
        "field": args.field or "dense",
        "steps": args.steps,
        "rounds": args.rounds,
        "rows": rows,
    }
    name = "against_torch" + ("" if args.field is None else f"_{args.field}")
    print(f"\nrecord: {write_record(record, args.output, name, 'cpu')}")


if __name__ == "__main__":
    main()
