"""What a schedule of learning rates and updates brings within equal time.

    python benchmarks/schedules.py builtin:room path/to/scene --time-limit 25 --seeds 0 1

Scenes are as for training.py. Trainings that differ in nothing but their ``OptimConfig`` take turns
of a fraction of a second, each for as long on a clock of its own; so a machine that is slow for a
while is slow for all. Prints PSNR on the test views, in dB, steps, and the share of the time that
is not rays and their gradient; writes benchmarks/results/schedules_<device>.json.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from unittest import mock

from measuring import add_model, machine, options, plain_training, write_record
from training import Clock, path_of
from turns import take_turns

import warpnerf as wn
from warpnerf.optim_config import ACCUMULATE_AT
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer

SCHEDULES = {
    "1 step": wn.OptimConfig(accumulate_at=()),
    "up to 4": wn.OptimConfig(accumulate_at=ACCUMULATE_AT["unbounded"]),
    "up to 16": wn.OptimConfig(accumulate_at=ACCUMULATE_AT["bounded"]),
    "up to 16, earlier": wn.OptimConfig(accumulate_at=ACCUMULATE_AT["object"]),
}
"""What is compared, by the steps of an update: what ``auto`` takes for one kind of scene or other,
and updates of a step each."""


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--time-limit", type=float, default=25.0, help="seconds each")
    parser.add_argument("--steps", type=int, default=100_000, help="at most so many steps, from 2")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--downscale", type=int, default=1)
    add_model(parser)
    arguments = parser.parse_args()
    config = plain_training(
        model=arguments.model,
        steps=arguments.steps,
        time_limit=arguments.time_limit,
        device=arguments.device,
    )
    print("scene           seed  schedule            seconds   PSNR  steps  besides rays")
    rows = []
    for name in arguments.scenes:
        scene = wn.load_scene(path_of(name), downscale=arguments.downscale)
        for seed in arguments.seeds:
            for schedule, found in race(scene, replace(config, seed=seed)).items():
                rows.append({"scene": name, "seed": seed, "schedule": schedule, **found})
                print(
                    f"{name:14}  {seed:4}  {schedule:17}  {found['seconds']:7.1f}  "
                    f"{found['psnr']:5.2f}  {found['steps']:5.0f}  "
                    f"{100 * found['besides_rays']:10.1f} %",
                    flush=True,
                )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device).count),
        "model": arguments.model,
        "time_limit": arguments.time_limit,
        "steps": arguments.steps,
        "downscale": arguments.downscale,
        "schedules": {name: asdict(optim) for name, optim in SCHEDULES.items()},
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'schedules', arguments.device)}")


def race(scene: wn.Scene, config: wn.TrainConfig) -> dict[str, dict[str, float]]:
    """Train by each of the schedules, in turns."""
    trainers = {
        name: Trainer(scene, replace(config, optim=optim)) for name, optim in SCHEDULES.items()
    }
    rays = dict.fromkeys(trainers, 0.0)
    clock = Clock(Workers(config.device).device.is_cuda)

    def note(name: str, seconds: float) -> None:
        rays[name] += clock.seconds.pop("rays", 0.0)

    with mock.patch.object(TrainingPass, "run", clock.timing("rays", TrainingPass.run)):
        seconds = take_turns(trainers, note)
    return {
        name: {
            "seconds": seconds[name],
            "psnr": wn.evaluate(trainer.field(), scene).mean["psnr"],
            "steps": trainer.steps_done,
            "besides_rays": 1.0 - rays[name] / seconds[name],
        }
        for name, trainer in trainers.items()
    }


if __name__ == "__main__":
    main()
