"""What the scaling does: builtin:room-sparse, trained with and without it, near plane 0.

The model is rgb: colour that depends on the direction of view can hide a floater from cameras.

Measured on the trained fields: PSNR and depth error on the test views; PSNR of training cameras
moved back, where what hangs in front of them shows; and density where no surface can be, nearer to
a training camera than anything in the room: the mean optical depth of a ray from the camera to its
clearance, the distance to the nearest true surface in any direction.

    python benchmarks/floaters.py --steps 1000 4000 16000 --seeds 0 1 2

Prints a table, mean and half of the range over the seeds, and writes
benchmarks/results/floaters_<device>.json and a picture of each field of the first seed and the
fewest steps.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from measuring import RESULTS, machine, plain_training, write_record

import warpnerf as wn
from warpnerf.evaluation.floater_metrics import near_density
from warpnerf.evaluation.near_field import pulled_psnr
from warpnerf.media.pictures import comparison, write_png
from warpnerf.scenes.builtin.room import first_hit

FIGURES = ("psnr", "depth_error", "pulled_psnr", "near_density")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--steps", type=int, nargs="+", default=[1000, 4000, 16000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=RESULTS, help="a folder")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    scene = wn.load_scene("builtin:room-sparse", downscale=args.downscale)
    rows = []
    print(f"{'steps':>6} {'scaling':8} " + " ".join(f"{name:>17}" for name in FIGURES))
    for steps in args.steps:
        for scaling in ("none", "clamped"):
            found = []
            for seed in args.seeds:
                config = plain_training(
                    model="rgb", steps=steps, scaling=scaling, device=args.device, seed=seed
                )
                field = wn.train(scene, config, progress=False).field
                found.append(look(field, scene))
                if steps == min(args.steps) and seed == args.seeds[0]:
                    view = scene.views[scene.splits["test"][4]]
                    picture = comparison(view.image / 255.0, field.render(view.camera), 0.0, 6.0)
                    write_png(args.output / f"floaters_{scaling}.png", picture)
            row = {name: [one[name] for one in found] for name in FIGURES}
            rows.append({"steps": steps, "scaling": scaling, "seeds": args.seeds, **row})
            print(
                f"{steps:6} {scaling:8} "
                + " ".join(
                    f"{np.mean(values):8.4f} +- {np.ptp(values) / 2:.4f}" for values in row.values()
                ),
                flush=True,
            )
    record = {"machine": machine(args.device, field.workers.count), "rows": rows}
    name = f"floaters_{args.device.replace(':', '')}.json"
    print(f"wrote {write_record(record, args.output / name, 'floaters', args.device)}")


def look(field: wn.Field, scene: wn.Scene) -> dict[str, float]:
    """FIGURES of a trained field."""
    mean = wn.evaluate(field, scene).mean
    return {
        "psnr": mean["psnr"],
        "depth_error": mean["depth_error"],
        "pulled_psnr": float(np.mean(pulled_psnr(field, scene))),
        "near_density": near_density(field, scene.training_cameras, first_hit),
    }


if __name__ == "__main__":
    main()
