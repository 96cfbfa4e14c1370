"""What it brings to tighten the box of an object early, and whether that needs a grid of its own.

    python benchmarks/tightening.py path/to/scene --time-limit 40 --seeds 0 1

Scenes have alpha. Each is trained with the box tightened when the grid first grows, with the box
tightened before, and with the box and the free space that a short training on a small grid shows.
Trainings take turns of a fraction of a second, each for as long on a clock of its own, to which the
short training counts. Prints PSNR on the test views, in dB, and steps; writes
benchmarks/results/tightening_<device>.json.
"""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
from measuring import add_model, machine, options, write_record
from training import path_of
from turns import take_turns

import warpnerf as wn
from warpnerf.model.grid import FreeCells
from warpnerf.rendering.render import march_struct
from warpnerf.runtime.parallel import Workers
from warpnerf.training import extent
from warpnerf.training.trainer import Trainer

SMALL_STEPS, SMALL_VOXELS = 250, 48**3
"""Of the short training."""
MARGIN = 0.02
"""Around its box, in edges of it."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scenes", nargs="+", help="folders of photographs with alpha")
    parser.add_argument("--time-limit", type=float, default=40.0, help="seconds each")
    parser.add_argument("--steps", type=int, default=4000, help="at most so many steps")
    parser.add_argument("--voxels", type=int, default=128**3)
    parser.add_argument("--threads", type=int, help="by default one per usable core")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--downscale", type=int, default=1)
    add_model(parser)
    arguments = parser.parse_args()
    config = wn.TrainConfig(
        model=arguments.model,
        steps=arguments.steps,
        time_limit=arguments.time_limit,
        grid=wn.GridConfig(voxels=arguments.voxels),
        device=arguments.device,
        threads=arguments.threads,
    )
    print("scene           seed  box            PSNR   SSIM  steps  longest edge")
    rows = []
    for name in arguments.scenes:
        scene = wn.load_scene(path_of(name), downscale=arguments.downscale)
        for seed in arguments.seeds:
            for way, found in race(scene, replace(config, seed=seed)).items():
                rows.append({"scene": name, "seed": seed, "box": way, **found})
                print(
                    f"{name:14}  {seed:4}  {way:12}  {found['psnr']:5.2f}  {found['ssim']:.3f}  "
                    f"{found['steps']:5.0f}  {found['longest_edge']:12.3f}",
                    flush=True,
                )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device, arguments.threads).count),
        "model": arguments.model,
        "time_limit": arguments.time_limit,
        "steps": arguments.steps,
        "voxels": arguments.voxels,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'tightening', arguments.device)}")


def race(scene: wn.Scene, config: wn.TrainConfig) -> dict[str, dict[str, float]]:
    """Train in each of the ways, in turns."""
    with mock.patch.object(extent, "TIGHTEN_AT", 1.0):
        trainers = {"at growth": Trainer(scene, config), "own grid": from_small(scene, config)}
    trainers["early"] = Trainer(scene, config)
    take_turns(trainers, lambda name, seconds: None)
    found = {}
    for name, trainer in trainers.items():
        grid, mean = trainer.grid, wn.evaluate(trainer.field(), scene).mean
        found[name] = {
            "psnr": mean["psnr"],
            "ssim": mean["ssim"],
            "steps": trainer.steps_done,
            "longest_edge": float((grid.box_max - grid.box_min).max()),
        }
    return found


def from_small(scene: wn.Scene, config: wn.TrainConfig) -> Trainer:
    """A training that begins with the box and the free space of a short one on a small grid."""
    grid = replace(config.grid, voxels=SMALL_VOXELS, grow_at=())
    small = Trainer(scene, replace(config, steps=SMALL_STEPS, time_limit=None, grid=grid))
    seconds = small.run().seconds
    field, workers = small.field(), small.workers
    march = march_struct(field.model, "float32", field.steps, workers)
    seen = FreeCells.of(field.grid, workers, march, config.alpha_min).occupied_range()
    assert seen is not None, "nothing opaque has grown"
    edges = scene.box_max - scene.box_min
    low = np.maximum(0.0, seen[0] - MARGIN * (seen[1] - seen[0]))
    high = np.minimum(1.0, seen[1] + MARGIN * (seen[1] - seen[0]))
    box = scene.box_min + low * edges, scene.box_min + high * edges
    fine = Trainer(replace(scene, box_min=box[0], box_max=box[1]), config, seconds=seconds)
    there = field.grid.resized(workers, field.grid.size, box)
    fine.free = FreeCells.of(there, workers, march, config.alpha_min)
    return fine


if __name__ == "__main__":
    main()
