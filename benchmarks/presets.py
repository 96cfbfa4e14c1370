"""What a configuration brings within equal time, or equal steps, against others.

    python benchmarks/presets.py lego_200 fox_q --time-limit 180 --seeds 0 1 \\
        --candidate fast --candidate "quality grid.voxels=4000000 model.specular=12"

A candidate is a preset, and fields of its TrainConfig that are something else, by their path and as
JSON without spaces, such as field={"name":"vm","density":8,"appearance":24}. Scenes are as for
training.py. Trainings of a scene and a seed take turns of a fraction of a second, each for as long
on a clock of its own; so a machine that is slow for a while is slow for all. Where the extent is
looked for first, that is off the clock. Prints PSNR on the test views, that of the middle quarter
of their pictures, SSIM, where depths are known their error in scene units, and of a sample of
training views PSNR, the mean and half of the range over the seeds; writes
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
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_to_json
from warpnerf.evaluation.metrics import psnr
from warpnerf.model import sampler_kinds, storage_kinds
from warpnerf.model.models import model_of
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.runtime.parallel import Workers
from warpnerf.training import coarse
from warpnerf.training.plan import resolve
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
    parser.add_argument(
        "--hold-out",
        action="store_true",
        help="test on every 8th training view, which is not trained on, and not on the test views",
    )
    args = parser.parse_args()
    limit = args.time_limit or (None if args.steps else 180.0)
    fixed = {"steps": args.steps or 10_000_000, "time_limit": limit, "device": args.device}
    candidates = {
        text: replace(configured(text), **fixed) for text in args.candidate or list(DEFAULT_PRESETS)
    }
    rows = []
    for name in args.scenes:
        scene = wn.load_scene(path_of(name), downscale=args.downscale)
        if args.hold_out:
            scene = held_out(scene)
        looked_at = {
            "test": some(scene.splits["test"], args.test_views or len(scene.views)),
            "training": some(scene.splits["train"], TRAINING_VIEWS),
        }
        scene = replace(scene, splits={**scene.splits, **looked_at})
        for seed in args.seeds:
            for candidate, found in race(scene, candidates, seed).items():
                rows.append({"scene": scene.name, "seed": seed, "candidate": candidate, **found})
        print(f"\n{name}\n  PSNR           middle  SSIM    training  steps    samples  candidate")
        for candidate in candidates:
            of_seeds = [r for r in rows if (r["scene"], r["candidate"]) == (scene.name, candidate)]
            figures = [row["psnr"] for row in of_seeds]
            mean = {key: float(np.mean([r[key] for r in of_seeds])) for key in FIGURES}
            errors = [row["depth_error"] for row in of_seeds if "depth_error" in row]
            depth = f"  (depth error {np.mean(errors):.3f})" if errors else ""
            print(
                f"  {mean['psnr']:5.2f} +-{np.ptp(figures) / 2:5.2f}  "
                f"{mean['middle_psnr']:5.2f}   {mean['ssim']:.4f}  "
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
            "hold_out": args.hold_out,
            "test_views": args.test_views,
            "candidates": {text: config_to_json(config) for text, config in candidates.items()},
            "rows": rows,
        }
        path = write_record(record, args.output, "presets", args.device)
    print(f"\nrecord: {path}")


def held_out(scene: wn.Scene) -> wn.Scene:
    """The scene with every 8th training view in place of its test views, so that these choose none.

    Its extent stays: points that only views now held out see are seen by the others as well.
    """
    train = scene.splits["train"]
    test = train[4::8] or train[-1:]
    left = tuple(index for index in train if index not in test)
    return replace(scene, splits={"train": left, "test": test})


def middle_psnr(field: wn.Field, scene: wn.Scene) -> float:
    """Mean PSNR of the middle quarter of the test views: half of their width and height."""
    figures = []
    for index in scene.splits["test"]:
        view = scene.views[index]
        truth = view.image[..., :3].astype(np.float32) / 255.0
        if view.channels == 4:  # on the background that it is trained before
            alpha = view.image[..., 3:].astype(np.float32) / 255.0
            truth = alpha * truth + (1.0 - alpha) * np.array(field.background, np.float32)
        h, w = truth.shape[:2]
        inner = slice(h // 4, h - h // 4), slice(w // 4, w - w // 4)
        figures.append(psnr(field.render(view.camera).rgb[inner], truth[inner]))
    return float(np.mean(figures))


def some(indices: tuple[int, ...], n: int) -> tuple[int, ...]:
    """At most n of them, spread."""
    return indices[:: max(1, -(-len(indices) // n))]


FIGURES = ("psnr", "middle_psnr", "ssim", "training_psnr", "steps", "samples_per_ray", "seconds")


def race(scene: wn.Scene, candidates: dict[str, TrainConfig], seed: int) -> dict[str, Any]:
    """Train all in turns, and look at the test views.

    Returns:
        Of each candidate: FIGURES.
    """
    trainers = {}
    for text, config in candidates.items():
        config, observed = replace(config, seed=seed), None
        plan = resolve(scene, config)
        if plan.looks_first:
            observed, _ = coarse.extent_by_training(scene, plan)
        trainers[text] = Trainer(scene, config, observed=observed)
    seconds = take_turns(trainers, lambda _, __: None)
    found = {}
    for text in candidates:
        trainer = trainers.pop(text)  # and its memory
        field = trainer.field()
        mean = wn.evaluate(field, scene).mean
        found[text] = {
            **{name: mean[name] for name in ("depth_error",) if name in mean},
            "psnr": mean["psnr"],
            "middle_psnr": middle_psnr(field, scene),
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
    elif name == "field" and isinstance(value, dict):  # with options that go together only
        value = storage_kinds.from_json(value)
    elif name == "sampler" and isinstance(value, dict):
        value = sampler_kinds.from_json(value)
    return replace(config, **{name: value})


def _value(text: str) -> Any:
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        return text
    return tuple(value) if isinstance(value, list) else value


if __name__ == "__main__":
    main()
