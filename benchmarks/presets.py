"""What a configuration brings within equal time, or equal steps, against others.

    python benchmarks/presets.py lego_200 fox_q --time-limit 180 --seeds 0 1 \\
        --candidate fast --candidate "quality grid.voxels=4000000 model.specular=12"

A candidate is a preset, and fields of its TrainConfig that are something else, by their path and as
JSON. Scenes are as for training.py. Trainings of a scene and a seed take turns of a fraction of a
second, each for as long on a clock of its own; so a machine that is slow for a while is slow for
all. Where the extent is looked for first, that is off the clock. Prints PSNR and SSIM on the test
views, where depths are known their error in scene units, and of a sample of training views PSNR,
the mean and half of the range over the seeds; writes
benchmarks/results/presets_<device>.json.
"""

from __future__ import annotations

import gc
import json
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
from measuring import machine, options, write_record
from training import path_of
from turns import take_turns

import warpnerf as wn
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig, config_to_json
from warpnerf.model.models import model_of
from warpnerf.presets import EVERYDAY, PRESETS
from warpnerf.runtime.parallel import Workers
from warpnerf.training import coarse
from warpnerf.training.trainer import Trainer

TRAINING_VIEWS = 4
"""That are looked at: how far test views lie below them tells fitting from generalising."""


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="*", default=["builtin:room"], help=known)
    parser.add_argument("--candidate", action="append", help="a preset, and what is different")
    parser.add_argument("--time-limit", type=float, help="seconds each, by default 180")
    parser.add_argument("--steps", type=int, help="equal steps instead of equal time")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--test-views", type=int, help="at most so many, spread; by default all")
    parser.add_argument("--downscale", type=int, default=1)
    args = parser.parse_args()
    limit = args.time_limit or (None if args.steps else 180.0)
    fixed = {"steps": args.steps or 10_000_000, "time_limit": limit, "device": args.device}
    candidates = {
        text: replace(configured(text), **fixed) for text in args.candidate or list(EVERYDAY)
    }
    rows = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name), downscale=args.downscale)
        looked_at = {
            "test": some(scene.splits["test"], args.test_views or len(scene.views)),
            "training": some(scene.splits["train"], TRAINING_VIEWS),
        }
        scene = replace(scene, splits={**scene.splits, **looked_at})
        for seed in args.seeds:
            for candidate, found in race(scene, candidates, seed).items():
                rows.append({"scene": scene.name, "seed": seed, "candidate": candidate, **found})
        print(f"\n{name}\n  PSNR           SSIM    training  steps    samples  candidate")
        for candidate in candidates:
            of_seeds = [r for r in rows if (r["scene"], r["candidate"]) == (scene.name, candidate)]
            psnr = [row["psnr"] for row in of_seeds]
            mean = {key: float(np.mean([r[key] for r in of_seeds])) for key in FIGURES}
            errors = [row["depth_error"] for row in of_seeds if "depth_error" in row]
            depth = f"  (depth error {np.mean(errors):.3f})" if errors else ""
            print(
                f"  {mean['psnr']:5.2f} +-{np.ptp(psnr) / 2:5.2f}  {mean['ssim']:.4f}  "
                f"{mean['training_psnr']:8.2f}  {mean['steps']:7.0f}  "
                f"{mean['samples_per_ray']:7.1f}  {candidate}{depth}",
                flush=True,
            )
        record = {
            "benchmark": "presets",
            "machine": machine(args.device, Workers(args.device).count),
            "time_limit": limit,
            "steps": args.steps,
            "downscale": args.downscale,
            "test_views": args.test_views,
            "candidates": {text: config_to_json(config) for text, config in candidates.items()},
            "rows": rows,
        }
        path = write_record(record, args.output, "presets", args.device)
    print(f"\nrecord: {path}")


def some(indices: tuple[int, ...], n: int) -> tuple[int, ...]:
    """At most n of them, spread."""
    return indices[:: max(1, -(-len(indices) // n))]


FIGURES = ("psnr", "ssim", "training_psnr", "steps", "samples_per_ray", "seconds")


def race(scene: wn.Scene, candidates: dict[str, TrainConfig], seed: int) -> dict[str, Any]:
    """Train all in turns, and look at the test views.

    Returns:
        Of each candidate: FIGURES.
    """
    trainers = {}
    for text, config in candidates.items():
        config, sight = replace(config, seed=seed), None
        if coarse.is_needed(scene, config):
            sight, _ = coarse.find_sight(scene, config)
        trainers[text] = Trainer(scene, config, sight=sight)
    seconds = take_turns(trainers, lambda _, __: None)
    found = {}
    for text in candidates:
        trainer = trainers.pop(text)  # and its memory
        field = trainer.field()
        mean = wn.evaluate(field, scene).mean
        found[text] = {
            **{name: mean[name] for name in ("depth_error",) if name in mean},
            "psnr": mean["psnr"],
            "ssim": mean["ssim"],
            "training_psnr": wn.evaluate(field, scene, split="training").mean["psnr"],
            "steps": trainer.steps_done,
            "samples_per_ray": trainer.report().samples_per_ray,
            "seconds": seconds[text],
        }
        del trainer, field
        gc.collect()
    return found


def configured(text: str) -> TrainConfig:
    """The configuration that a candidate names.

    Raises:
        InputError: There is no such preset or field, or it cannot have that value.
    """
    name, *changes = text.split()
    if name not in PRESETS:
        raise InputError(f"--candidate: {name!r} is no preset of {', '.join(PRESETS)}.")
    config = PRESETS[name]
    for change in changes:
        path, equals, value = change.partition("=")
        if not equals:
            raise InputError(f"--candidate: {change!r} is no field=value.")
        config = _changed(config, path.split("."), _value(value))
    return config


def _changed(config: Any, path: Sequence[str], value: Any) -> Any:
    name = path[0]
    known = [field.name for field in fields(config)] if is_dataclass(config) else []
    if name not in known:
        raise InputError(f"--candidate: {name!r} is none of {', '.join(known)}.")
    if len(path) > 1:
        value = _changed(getattr(config, name), path[1:], value)
    elif name == "model":
        value = model_of(value)
    return replace(config, **{name: value})


def _value(text: str) -> Any:
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    return tuple(value) if isinstance(value, list) else value


if __name__ == "__main__":
    main()
