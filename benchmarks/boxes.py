"""Whether the plan of space predicts what trainings in other boxes reach.

    python benchmarks/boxes.py room-table cup_colmap --downscale 2 --voxels 512000 --steps 800

Scenes are those of ``room_scan.py``, with grain, and folders that bring points. Of the boxes and
borders that ``warpnerf.scenes.extent.space_plan`` tries, some are trained in that are spread over
what it predicts, the best among them, and the scene's own with a border of 0.2; for as many steps,
on one thread each. Prints the predicted error, PSNR on the test views and in the middle quarter of
their pictures, samples per ray and processor seconds, with the correlation of prediction and PSNR;
writes benchmarks/results/boxes_<device>.json."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from measuring import machine, options, write_record
from presets import held_out, middle_psnr, some
from room_scan import SCANS, write_scan
from training import path_of

import warpnerf as wn
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.extent.space_plan import predicted_error, resolve_space, spaces
from warpnerf.training.trainer import Trainer


def main() -> None:
    parser = options(__doc__)
    known = f"folders, {', '.join(SCANS)}"
    parser.add_argument("scenes", nargs="*", default=["room-table"], help=known)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--voxels", type=int, default=80**3)
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--boxes", type=int, default=8, help="besides the scene's own")
    parser.add_argument("--views", type=int, default=120, help="photographs of a scan")
    args = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("scene         edges                  border  predicted   PSNR  middle  samples  seconds")
    with tempfile.TemporaryDirectory() as temporary:
        for name in args.scenes:
            scene = load(name, Path(temporary) / name, args.views, args.downscale)
            found = [
                measure(scene, space, args.steps, args.voxels, args.device)
                for space in chosen(scene, args.voxels, args.boxes)
            ]
            for row in found:
                edges = " x ".join(f"{edge:.3g}" for edge in row["edges"])
                print(
                    f"{scene.name:12}  {edges:21}  {row['border']:6.2f}  {row['predicted']:9.2f}  "
                    f"{row['psnr']:5.2f}  {row['middle_psnr']:6.2f}  {row['samples']:7.1f}  "
                    f"{row['seconds']:7.1f}",
                    flush=True,
                )
            error, psnr = ([row[key] for row in found] for key in ("predicted", "psnr"))
            print(f"{scene.name:12}  correlation {np.corrcoef(error, psnr)[0, 1]:.2f}\n")
            rows += [{"scene": scene.name, **row} for row in found]
    record = {
        "benchmark": "boxes",
        "machine": machine(args.device, 1),
        "steps": args.steps,
        "voxels": args.voxels,
        "downscale": args.downscale,
        "rows": rows,
    }
    print(f"wrote {write_record(record, args.output, 'boxes', args.device)}")


def load(name: str, folder: Path, views: int, downscale: int) -> wn.Scene:
    """A scene whose test views choose nothing: others are held out."""
    if name in SCANS:
        write_scan(folder, views, n_points=20 * views, size=(400, 266), scan=name, grainy=True)
    scene = held_out(wn.load_scene(folder if name in SCANS else path_of(name), downscale=downscale))
    test = some(scene.splits["test"], 12)
    return replace(scene, splits={**scene.splits, "test": test})


def chosen(scene: wn.Scene, voxels: int, n: int) -> list[Space]:
    """The scene's own box with a border of 0.2, then others from the best to the worst."""
    assert scene.observations is not None, f"{scene.name} brings no points"
    grid = wn.GridConfig(voxels=voxels, box="scene", border=0.2)
    own = resolve_space(scene, wn.TrainConfig(grid=grid))
    tried = spaces(own, scene.observations, None, box=True)
    tried.sort(key=lambda space: predicted_error(space, scene.observations, voxels))
    spread = np.unique(np.linspace(0, len(tried) - 1, n).round().astype(int))
    return [own, *(tried[k] for k in spread)]


def measure(
    scene: wn.Scene, space: Space, steps: int, voxels: int, device: str
) -> dict[str, object]:
    """Train in a space, and look at the test views."""
    box = (*map(float, space.box_min), *map(float, space.box_max))
    config = replace(
        wn.PRESETS["fast"],
        steps=steps,
        threads=1,
        device=device,
        grid=wn.GridConfig(voxels=voxels, box=box, border=space.border),
    )
    trainer = Trainer(scene, config)
    before = time.process_time()
    progress = trainer.run()
    seconds = time.process_time() - before
    field = trainer.field()
    assert scene.observations is not None
    return {
        "edges": (space.box_max - space.box_min).tolist(),
        "border": space.border,
        "predicted": predicted_error(space, scene.observations, voxels),
        "psnr": wn.evaluate(field, scene).mean["psnr"],
        "middle_psnr": middle_psnr(field, scene),
        "samples": progress.samples_per_ray,
        "seconds": seconds,
    }


if __name__ == "__main__":
    main()
