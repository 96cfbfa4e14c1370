"""What a training step of each model costs late in a training, beside one of rgb.

    python benchmarks/models.py lego_200 fox_q

Scenes are as for training.py. Each model is trained on each scene by the preset fast up to nine
tenths of its schedule; there the grid has all its nodes, and an update takes as many steps as it
ever does. From there all continue in turns, each time with the same batches: eight updates, one of
which smooths. A step is all that training does for 4096 rays: drawing them, the pass, its share of
total variation and of Adam. Free space is not looked for, nor anything reported. Models differ in
what they find to be free, too, so samples per ray are given.

Ratios are formed round by round; figures are medians with 95 % intervals. Prints a table, with the
parts of a step, and writes benchmarks/results/models_cpu.json.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any
from unittest import mock

from measuring import (
    Interval,
    default_threads,
    machine,
    median_interval,
    named,
    options,
    show,
    write_record,
)
from training import PARTS, Clock, path_of

import warpnerf as wn
from warpnerf.model.models import MODELS
from warpnerf.training.trainer import Trainer

LATE = 0.9
"""Share of the training after which steps are timed."""
TIMED = ("rays", "drawing", "Adam", "smoothing")
"""The parts of a step."""


class Late:
    """A model late in its training, on a number of threads."""

    def __init__(self, scene: wn.Scene, state: wn.TrainingState, threads: int) -> None:
        """Continue from a state."""
        config = replace(state.config, threads=threads)
        self._trainer = trainer = Trainer(scene, config, state)
        self._step = trainer.steps_done
        trainer.config = replace(config, occupancy_every=1 << 60, steps=1 << 60)
        self._updates = trainer.config.optim.tv_every
        self._clock = Clock(on_cuda=False)
        self.turn()  # compiles, and touches all memory

    def turn(self) -> dict[str, float]:
        """The updates from where the state was; seconds of a step, and of each of its parts."""
        self._trainer.steps_done = self._step
        self._clock.seconds.clear()
        patches = [
            mock.patch.object(owner, function, self._clock.timing(part, getattr(owner, function)))
            for part in TIMED
            for owner, function in PARTS[part]
        ]
        patches.append(mock.patch.object(Trainer, "fraction", LATE))
        for patch in patches:
            patch.start()
        try:
            begin = time.perf_counter()
            for _ in range(self._updates):
                self._trainer.update()
            spent = time.perf_counter() - begin
        finally:
            for patch in patches:
                patch.stop()
        n_steps = self._trainer.steps_done - self._step
        return {
            "step": spent / n_steps,
            **{part: self._clock.seconds[part] / n_steps for part in TIMED},
        }

    def about(self) -> dict[str, Any]:
        """Steps of an update, samples per ray, nodes, and the share of cells that is not free."""
        n_steps = self._trainer.schedule.steps_an_update(LATE)
        rays = self._trainer._pass.n_rays
        return {
            "steps_an_update": n_steps,
            "samples_per_ray": float(self._trainer._pass.n_samples.numpy()[:rays].mean()),
            "grid": self._trainer.lattice.size,
            "occupied": self._trainer.free.share(),
        }


def train_until_late(scene: wn.Scene, config: wn.TrainConfig) -> wn.TrainingState:
    """Train nine tenths of the steps."""
    trainer = Trainer(scene, config)
    trainer.run(stop=lambda: trainer.fraction >= LATE)
    return trainer.state()


def race(late: dict[str, Late], rounds: int) -> dict[str, list[dict[str, float]]]:
    """Seconds of each model, by part, in each round."""
    found: dict[str, list[dict[str, float]]] = {model: [] for model in late}
    order = list(late)
    for turn in range(rounds):
        first = turn % len(order)
        turns = order[first:] + order[:first]
        if turn % 2:
            turns.reverse()
        for model in turns:
            found[model].append(late[model].turn())
    return found


def summarise(found: dict[str, list[dict[str, float]]]) -> dict[str, dict[str, Interval]]:
    """For each model: milliseconds of a step and its parts, and steps over rgb's."""
    return {
        model: {
            "over_rgb": median_interval(
                own["step"] / rgb["step"] for own, rgb in zip(rounds, found["rgb"], strict=True)
            ),
            "pass_over_rgb": median_interval(
                own["rays"] / rgb["rays"] for own, rgb in zip(rounds, found["rgb"], strict=True)
            ),
            **{
                f"{part}_ms": median_interval(1e3 * seconds[part] for seconds in rounds)
                for part in ("step", *TIMED)
            },
        }
        for model, rounds in found.items()
    }


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--steps", type=int, default=4000, help="that the schedule is made for")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--threads", type=int, nargs="+", default=default_threads())
    parser.add_argument("--rounds", type=int, default=12)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("this one measures CPUs")
    models = ["rgb", *(model for model in args.models if model != "rgb")]
    print(f"{args.rounds} rounds; median [95 % interval]\n")
    print(
        f"{'scene':20s}threads  model      samples/ray  a step, ms            over rgb"
        f"{'':14s}the pass over rgb     " + "  ".join(f"{part:>9s}" for part in TIMED)
    )
    rows = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name), downscale=args.downscale)
        states = {
            model: train_until_late(
                scene, replace(wn.PRESETS["fast"], model=named(model), steps=args.steps)
            )
            for model in models
        }
        for threads in args.threads:
            late = {model: Late(scene, state, threads) for model, state in states.items()}
            figures = summarise(race(late, args.rounds))
            for model in models:
                row = {
                    "scene": name,
                    "threads": threads,
                    "model": model,
                    **late[model].about(),
                    **figures[model],
                }
                rows.append(row)
                print_row(row)
            del late
    record = {
        "benchmark": "models",
        "machine": machine("cpu", max(args.threads)),
        "steps": args.steps,
        "downscale": args.downscale,
        "rounds": args.rounds,
        "rows": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'models', 'cpu')}")


def print_row(row: dict[str, Any]) -> None:
    """One model."""
    parts = "  ".join(f"{row[f'{part}_ms']['median']:9.2f}" for part in TIMED)
    print(
        f"{row['scene']:20s}{row['threads']:7d}  {row['model']:11s}{row['samples_per_ray']:11.1f}  "
        f"{show(row['step_ms'], 1):22s}{show(row['over_rgb'], 2):22s}"
        f"{show(row['pass_over_rgb'], 2):22s}{parts}",
        flush=True,
    )


if __name__ == "__main__":
    main()
