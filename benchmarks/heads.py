"""Which model sees best after how many seconds of training.

    python benchmarks/heads.py lego_200 fox_q stitch --time-limit 180 --seeds 0 1

Scenes are as for training.py. Trainings that differ in nothing but the model take turns of a
fraction of a second, each for as long on a clock of its own; so a machine that is slow for a while
is slow for all. On the way, at the same seconds of each one's clock, the test views are rendered;
that is not on the clock. The schedules of all are squeezed to the whole time: what a curve shows
before its end is not what a shorter training would reach.

Prints PSNR and SSIM on the test views, writes benchmarks/results/heads_<device>.json, and beside it
a picture of the curves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from measuring import machine, named, options, plain_training, write_record
from plotting import plot_heads
from training import path_of
from turns import take_turns

import warpnerf as wn
from warpnerf.model.models import MODELS
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--models", nargs="+", default=list(MODELS), choices=list(MODELS))
    parser.add_argument("--time-limit", type=float, default=180.0, help="seconds each")
    parser.add_argument("--steps", type=int, default=100_000, help="at most so many steps, from 2")
    parser.add_argument("--points", type=int, default=10, help="of a curve, the last at the end")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--downscale", type=int, default=1)
    args = parser.parse_args()
    config = plain_training(steps=args.steps, time_limit=args.time_limit, device=args.device)
    print("scene                 seed  model      seconds   steps   PSNR    SSIM")
    rows = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name), downscale=args.downscale)
        for seed in args.seeds:
            found = race(scene, replace(config, seed=seed), args.models, args.points)
            for model, curve in found.items():
                rows.append({"scene": name, "seed": seed, "model": model, "curve": curve})
                last = curve[-1]
                print(
                    f"{name:20s}  {seed:4d}  {model:9s}  {last['seconds']:7.1f}  "
                    f"{last['steps']:6d}  {last['psnr']:5.2f}  {last['ssim']:.4f}",
                    flush=True,
                )
    record = {
        "benchmark": "heads",
        "machine": machine(args.device, Workers(args.device).count),
        "time_limit": args.time_limit,
        "steps": args.steps,
        "downscale": args.downscale,
        "rows": rows,
    }
    path = write_record(record, args.output, "heads", args.device)
    print(f"\nrecord: {path}")
    print(plot_heads(record, path.with_suffix(".png")))


def race(
    scene: wn.Scene, config: wn.TrainConfig, models: Sequence[str], n_points: int
) -> dict[str, list[dict[str, Any]]]:
    """Train all in turns.

    Returns:
        Of each model: seconds, steps, PSNR and SSIM at so many points on the way.
    """
    trainers = {model: Trainer(scene, replace(config, model=named(model))) for model in models}
    curves: dict[str, list[dict[str, Any]]] = {model: [] for model in models}

    def look(model: str, seconds: float) -> None:
        trainer, curve = trainers[model], curves[model]
        if trainer.fraction < (len(curve) + 1) / n_points:
            return
        mean = wn.evaluate(trainer.field(), scene).mean
        point = {"seconds": seconds, "steps": trainer.steps_done}
        curve.append({**point, "psnr": mean["psnr"], "ssim": mean["ssim"]})

    take_turns(trainers, look)
    return curves


if __name__ == "__main__":
    main()
