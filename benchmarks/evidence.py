"""What the scaling changes, in pairs of trainings that differ in nothing else.

    python benchmarks/evidence.py builtin:room-sparse fox_q --seeds 5 --steps 1000 \\
        --folder runs/evidence

Trains, with each seed, `rgb` without other losses and the preset `fast`, both without and with the
scaling, for equal steps, and measures them as `warpnerf eval --measures` does; docs/metrics.md has
the formulas. All runs stay in the folder, an experiment per capture as of `warpnerf compare`: what
was stopped continues with the same command, and more seeds are added to those that are there.
Prints mean differences over the seeds with Student's interval; writes
benchmarks/results/evidence_<device>.json.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import machine, options, write_record
from training import path_of

import warpnerf as wn
from warpnerf.config import LossConfig, Scaling, TrainConfig
from warpnerf.reports.comparison import FIGURES, compare_figures
from warpnerf.reports.experiment import Candidate, Capture, Experiment

CAPTURES = ("builtin:room-sparse", "builtin:room", "fox_q", "lund_door", "stitch", "cup_colmap")
KINDS = {
    "rgb": TrainConfig(model="rgb", loss=LossConfig()),
    "fast": wn.PRESETS["fast"],
}
"""What is trained with and without the scaling."""
SCALINGS: tuple[Scaling, ...] = ("none", "clamped")
SHOWN = ("psnr", "training_psnr", "pulled_psnr", "front_train", "behind_train", "seen_depth_error")


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    parser = options(__doc__)
    parser.add_argument("captures", nargs="*", default=list(CAPTURES))
    parser.add_argument("--folder", type=Path, required=True, help="of the runs")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--downscale", type=int, default=2)
    args = parser.parse_args(words)
    rows = []
    for name in args.captures:
        source = path_of(name)
        scene = wn.load_scene(source, downscale=args.downscale)
        place = source if ":" in source else str(Path(source).resolve())
        capture = Capture(scene=scene, source=place, downscale=args.downscale)
        candidates = [
            Candidate(
                name=f"{kind}-{scaling}",
                config=replace(config, scaling=scaling, steps=args.steps, device=args.device),
                against=None if scaling == SCALINGS[0] else f"{kind}-{SCALINGS[0]}",
            )
            for kind, config in KINDS.items()
            for scaling in SCALINGS
        ]
        folder = args.folder / Path(name.replace(":", "-")).name
        experiment = Experiment(folder, capture, candidates, args.seeds)
        experiment.begin()
        for candidate, seed in experiment.trials:
            experiment.train(candidate, seed)
        for row in compare_figures(experiment):
            rows.append(
                {
                    "scene": Path(name).name,
                    "name": row.candidate.name,
                    "values": row.values,
                    "differences": {key: asdict(d) for key, d in row.differences.items()},
                    "left_out": row.left_out,
                }
            )
            show(rows[-1])
    record = {
        "machine": machine(args.device, wn.PRESETS["fast"].threads or 0),
        "seeds": args.seeds,
        "steps": args.steps,
        "downscale": args.downscale,
        "rows": rows,
    }
    print(f"record: {write_record(record, args.output, 'evidence', args.device)}")
    return record


def show(row: dict[str, Any]) -> None:
    """A line of figures, and of differences where there are any."""
    cells = []
    for name in SHOWN:
        digits = FIGURES[name].digits
        if name in row["differences"]:
            d = row["differences"][name]
            interval = (
                "" if d["low"] is None else f" ({d['low']:+.{digits}f}, {d['high']:+.{digits}f})"
            )
            cells.append(f"{name} {d['mean']:+.{digits}f}{interval}")
        elif name in row["values"]:
            cells.append(f"{name} {np.mean(row['values'][name]):.{digits}f}")
    print(f"{row['scene']:20} {row['name']:14} {'; '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
