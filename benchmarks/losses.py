"""What the losses besides the squared error do: to the quality after equal steps, and to a step.

    python benchmarks/losses.py builtin:room-sparse lego_200 fox_q --steps 1000

Scenes are as for training.py. On each, one model is trained with each loss alone, by the same
schedule and seeds, and its test views are measured. Then batches go through the field that the
squared error has left, in turns with and without the loss: forward, loss and adjoint, the part of a
step that losses can slow down. Ratios are formed round by round; figures of time are medians with
95 % intervals, so other work on the machine spreads them, but favours neither side.

near_clip is DVGO's: there each sample's slope is 1, which is not divided by the rays of a step, and
colours' errors are means over channels. Its distance is a tenth of the content distance.

Prints a table and writes benchmarks/results/losses_cpu.json.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from measuring import (
    Interval,
    Stopwatch,
    default_threads,
    machine,
    median_interval,
    options,
    plain_training,
    show,
    write_record,
)
from training import path_of

import warpnerf as wn
from warpnerf.config import LossConfig
from warpnerf.model.models import MODELS
from warpnerf.rendering.losses import Objective
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.render import TrainingPass
from warpnerf.runtime.parallel import Workers

NAMES = ("huber", "distortion", "entropy", "opacity", "near_clip", "sample_colour")


def losses_of(scene: wn.Scene, config: wn.TrainConfig) -> dict[str, LossConfig]:
    """The losses by name, the squared error first."""
    found = {
        "squared": LossConfig(),
        "huber": LossConfig(photometric="huber", huber_delta=0.1),
        "distortion": LossConfig(distortion=0.03),
        "entropy": LossConfig(entropy=0.003),
        "near_clip": LossConfig(
            near_clip=3.0 * config.rays_per_step,
            near_clip_distance=0.1 * scene.content_distance,
        ),
    }
    if not scene.has_alpha:
        found["opacity"] = LossConfig(opacity=0.001)
    if config.model.name != "deferred":
        found["sample_colour"] = LossConfig(sample_colour=0.03)
    return found


def quality(
    scene: wn.Scene, config: wn.TrainConfig, seeds: int
) -> tuple[wn.Field, list[dict[str, float]]]:
    """The field of the last seed, and figures of the test views for each."""
    figures = []
    for seed in range(seeds):
        field = wn.train(scene, replace(config, seed=seed), progress=False).field
        figures.append(wn.evaluate(field, scene, split="test").mean)
    return field, figures


def ratios(
    scene: wn.Scene, field: wn.Field, losses: LossConfig, threads: int, rounds: int
) -> Interval:
    """Of each round, with a batch of its own: the time with the losses over that without."""
    workers, n_rays = Workers("cpu", threads), wn.TrainConfig().rays_per_step
    views = [scene.views[i] for i in scene.splits["train"]]
    distances = np.full(len(views), scene.content_distance)
    sampler = PixelSampler(views, distances, field.background, n_rays, True, 0, workers)
    ours, plain = (
        TrainingPass(
            n_rays,
            field.model,
            field.storage,
            field.weights,
            field.steps,
            "clamped",
            "none",
            workers,
            Objective(config=config, content_distance=scene.content_distance),
        )
        for config in (losses, LossConfig())
    )
    watch, found = Stopwatch("cpu"), []
    for turn in range(-1, rounds):  # the first touches memory
        batch = sampler.draw(1 + turn, 1)
        seconds = {
            p: watch.seconds(partial(p.run, field.free, batch))
            for p in ((ours, plain) if turn % 2 else (plain, ours))
        }
        if turn >= 0:
            found.append(seconds[ours] / seconds[plain])
    return median_interval(found)


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--model", default="rgb", choices=list(MODELS))
    parser.add_argument("--losses", nargs="+", default=list(NAMES), choices=list(NAMES))
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=default_threads()[-1])
    parser.add_argument("--rounds", type=int, default=40)
    args = parser.parse_args()
    if args.device != "cpu":
        parser.error("this one measures CPUs")
    print(f"{'scene':20s}loss           PSNR [dB]  SSIM    time of a batch over squared")
    rows: list[dict[str, Any]] = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name))
        config = plain_training(model=args.model, steps=args.steps, threads=args.threads)
        field: Any = None
        for loss, losses in losses_of(scene, config).items():
            if loss != "squared" and loss not in args.losses:
                continue
            trained, figures = quality(scene, replace(config, loss=losses), args.seeds)
            if loss == "squared":
                field = trained
            row: dict[str, Any] = {
                "scene": name,
                "loss": loss,
                "config": asdict(losses),
                "figures": figures,
                "over_squared": ratios(scene, field, losses, args.threads, args.rounds),
            }
            rows.append(row)
            psnr, ssim = (float(np.mean([f[k] for f in figures])) for k in ("psnr", "ssim"))
            print(
                f"{name:20s}{loss:15s}{psnr:9.2f}  {ssim:.3f}   {show(row['over_squared'], 3)}",
                flush=True,
            )
    record = {
        "benchmark": "losses",
        "machine": machine("cpu", args.threads),
        "model": args.model,
        "steps": args.steps,
        "seeds": args.seeds,
        "rounds": args.rounds,
        "rows": rows,
    }
    print(f"\nrecord: {write_record(record, args.output, 'losses', 'cpu')}")


if __name__ == "__main__":
    main()
