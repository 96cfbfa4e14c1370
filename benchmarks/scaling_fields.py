"""What distance scaling is worth in each kind of field, in equal steps, near plane 0.

    python benchmarks/scaling_fields.py builtin:room-sparse room-scan fox_q stitch

The fields dense, vm and hash, each in the preset fast, hash also with two other
epsilons of Adam, and the preset mip360, also without its distortion loss; scalings none, quadratic
and clamped; several seeds. Trainings are small: so many steps of so many rays on so many voxels,
one after another. The record is written after each, and a run that was stopped resumes when it is
started again.

Prints, by capture and field, mean and half of the range over the seeds without scaling, and what
the others gain over that with the same seed: PSNR and SSIM of test views, LPIPS with --lpips, near
mass and PSNR of training views pulled back, and the depth error where depths are known. Writes
benchmarks/results/scaling_fields_<device>.json.
"""

from __future__ import annotations

import gc
import json
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from measuring import RESULTS, machine, options, write_record
from presets import configured, some
from training import path_of

import warpnerf as wn
from warpnerf.checks import InputError
from warpnerf.runtime.parallel import Workers

FIELDS = {
    "dense": "fast",
    "vm": "fast field=vm",
    "hash": "fast field=hash",
    "hash, epsilon 1e-8": "fast field=hash field.epsilon=1e-8",
    "hash, epsilon 1e-15": "fast field=hash field.epsilon=1e-15",
    "mip360": "mip360",
    "mip360, no distortion": "mip360 loss.distortion=0",
}
SCALINGS = ("none", "quadratic", "clamped")
FIGURES = ("psnr", "ssim", "lpips", "near_mass", "pulled_psnr", "depth_error")
LOOKED_AT = 5
"""Views of each split that are looked at, at most."""


def main() -> None:
    parser = options(__doc__)
    known = "builtin:room, builtin:room-sparse, folders"
    parser.add_argument("scenes", nargs="+", help=known)
    parser.add_argument("--fields", nargs="+", choices=FIELDS, default=list(FIELDS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--rays", type=int, default=1024, help="of a step")
    parser.add_argument("--voxels", type=int, default=1_000_000)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--lpips", type=Path, help="weights, as for warpnerf eval")
    args = parser.parse_args()
    settings = {name: getattr(args, name) for name in ("steps", "rays", "voxels", "downscale")}
    output = args.output or RESULTS / f"scaling_fields_{args.device.replace(':', '')}.json"
    rows = done_before(output, settings)
    n_asked = len(args.scenes) * len(args.fields) * len(args.seeds) * len(SCALINGS)
    scenes = {name: wn.load_scene(path_of(name), downscale=args.downscale) for name in args.scenes}
    asked = product(args.seeds, scenes.items(), args.fields, SCALINGS)
    for number, (seed, (name, scene), field, scaling) in enumerate(asked, start=1):
        key = {"scene": name, "field": field, "scaling": scaling, "seed": seed}
        if any(key.items() <= row.items() for row in rows):
            continue
        rows.append(key | trained(scene, field, scaling, seed, args))
        record = {
            "benchmark": "scaling_fields",
            "machine": machine(args.device, Workers(args.device).count),
            "settings": settings,
            "fields": FIELDS,
            "rows": rows,
        }
        write_record(record, output, "scaling_fields", args.device)
        said = f"{name}, {field}, {scaling}, seed {seed}: {rows[-1]['psnr']:.2f} dB"
        print(f"[{number} of {n_asked}] {said}", flush=True)
    for name in args.scenes:
        print(f"\n{name}")
        for line in table([row for row in rows if row["scene"] == name]):
            print("  " + line)
    print(f"\nrecord: {output}")


def done_before(output: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The rows of a record that an earlier run has left, or none.

    Raises:
        InputError: It had other settings or fields.
    """
    if not output.is_file():
        return []
    record = json.loads(output.read_text())
    known = {name: FIELDS.get(name) for name in record["fields"]}
    if (record["settings"], record["fields"]) != (settings, known):
        raise InputError(f"{output} has other settings or fields; name another --output.")
    return list(record["rows"])


def trained(scene: wn.Scene, field: str, scaling: str, seed: int, args: Any) -> dict[str, Any]:
    """Train, and look: FIGURES that there are, and the seconds of training."""
    config = configured(FIELDS[field])
    config = replace(
        config,
        steps=args.steps,
        rays_per_step=args.rays,
        scaling=scaling,
        seed=seed,
        device=args.device,
        grid=replace(config.grid, voxels=args.voxels),
    )
    result = wn.train(scene, config, progress=False)
    splits = {**scene.splits}
    for split in ("train", "test"):
        splits[split] = some(splits[split], LOOKED_AT)
    lpips = None
    if args.lpips is not None:
        from warpnerf.evaluation.lpips import Lpips

        lpips = Lpips(args.lpips)
    found = wn.evaluate(result.field, replace(result.scene, splits=splits), lpips=lpips)
    figures = found.mean | found.near_field.to_dict()
    seconds = result.progress.seconds
    del result
    gc.collect()
    return {name: figures[name] for name in FIGURES if name in figures} | {"seconds": seconds}


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of a capture: of each field without scaling, and what the others gain, paired."""
    names = [name for name in FIGURES if any(name in row for row in rows)]
    lines = [f"{'':30}" + "".join(f"{name:>20}" for name in names)]
    for field in dict.fromkeys(row["field"] for row in rows):
        by_seed = {(r["scaling"], r["seed"]): r for r in rows if r["field"] == field}
        seeds = [
            seed
            for seed in sorted({seed for _, seed in by_seed})
            if all((scaling, seed) in by_seed for scaling in SCALINGS)
        ]
        if not seeds:  # interrupted before it had all scalings
            continue
        for scaling in SCALINGS:
            cells = []
            for name in names:
                if any(name not in by_seed[which, seed] for which in SCALINGS for seed in seeds):
                    cells.append("")
                    continue
                figures = np.array([by_seed[scaling, seed][name] for seed in seeds])
                if scaling != "none":
                    figures = figures - [by_seed["none", seed][name] for seed in seeds]
                sign = "" if scaling == "none" else "+"
                cells.append(f"{np.mean(figures):{sign}.4f} +-{np.ptp(figures) / 2:.4f}")
            lines.append(f"{field:20}{scaling:>10}" + "".join(f"{cell:>20}" for cell in cells))
    return lines


if __name__ == "__main__":
    main()
