"""What the scaling does: builtin:room-sparse, trained with and without it, near plane 0.

The model is rgb: colour that depends on the direction of view can hide a floater from cameras.

Measured on the trained fields: PSNR and depth error on the test views, and density where no surface
can be, nearer to a training camera than anything in the room: the mean optical depth of a ray from
the camera to its clearance, the distance to the nearest true surface in any direction.

    python benchmarks/floaters.py --time-limit 120

Prints a table and writes benchmarks/results/floaters_<device>.json and a picture of each field.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from measuring import RESULTS, machine, write_record

import warpnerf as wn
from warpnerf.evaluation.floater_metrics import near_density
from warpnerf.media.pictures import comparison, write_png
from warpnerf.scenes.builtin.room import first_hit


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds each")
    parser.add_argument("--steps", type=int, default=100_000, help="steps, where fewer")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--output", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    scene = wn.load_scene("builtin:room-sparse", downscale=arguments.downscale)
    print("scaling   steps   PSNR    SSIM  depth error [m]  density before any surface")
    rows = {}
    for scaling in ("none", "clamped"):
        config = wn.TrainConfig(
            model="rgb",
            steps=arguments.steps,
            time_limit=arguments.time_limit,
            scaling=scaling,
            device=arguments.device,
        )
        result = wn.train(scene, config)
        row = wn.evaluate(result.field, scene).mean
        row["near_density"] = near_density(result.field, scene.training_cameras, first_hit)
        row["steps"] = result.progress.step
        rows[scaling] = row
        print(
            f"{scaling:8} {row['steps']:6d}  {row['psnr']:5.2f}  {row['ssim']:.4f}  "
            f"{row['depth_error']:15.3f}  {row['near_density']:.5f}",
            flush=True,
        )
        view = scene.views[scene.splits["test"][4]]
        picture = comparison(view.image / 255.0, result.field.render(view.camera), 0.0, 6.0)
        write_png(arguments.output / f"floaters_{scaling}.png", picture)
    record = {
        "machine": machine(arguments.device, result.field.workers.count),
        "time_limit": arguments.time_limit,
        **rows,
    }
    name = f"floaters_{arguments.device.replace(':', '')}.json"
    path = write_record(record, arguments.output / name, "floaters", arguments.device)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
