"""What it brings that box and content distance come from points, photographs, or a short training.

    python benchmarks/extents.py room-scan path/to/scene --steps 1200 --seeds 0 1

Scenes are folders that bring points or not, and room-scan, room-inward and room-mixed: the built-in
room seen outward, inward and both, written as photographs and a COLMAP model by room_scan.py. Each
is trained with the extent that the cameras give alone, with the one that comparing the photographs
finds and the one of short trainings, whose steps count to neither, and with that of the points
where there are some; of all but the first also with a content distance for each camera; for as many
steps, whatever the time. Prints PSNR and SSIM of the test views, optical depth within a tenth of
the content distance of the training cameras, and seconds; writes
benchmarks/results/extents_<device>.json.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

from measuring import machine, options, plain_training, write_record
from room_scan import SCANS, write_scan
from training import path_of

import warpnerf as wn
from warpnerf.model.models import MODELS
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.focus import estimate_extent
from warpnerf.training import coarse
from warpnerf.training.coarse import prepare_trainer

COARSE = "coarse"


def main() -> None:
    parser = options(__doc__)
    known = f"folders, {', '.join(SCANS)}"
    parser.add_argument("scenes", nargs="*", default=["room-scan"], help=known)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--voxels", type=int, default=112**3)
    parser.add_argument("--threads", type=int, help="by default one per usable core")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--views", type=int, default=125, help="photographs of a scan")
    parser.add_argument("--model", default="rgb", choices=list(MODELS))
    arguments = parser.parse_args()
    config = plain_training(
        model=arguments.model,
        steps=arguments.steps,
        grid=wn.GridConfig(voxels=arguments.voxels),
        device=arguments.device,
        threads=arguments.threads,
    )
    rows: list[dict[str, Any]] = []
    print(
        "scene         seed  extent              distance  longest edge   PSNR   SSIM  near_mass  "
        "seconds"
    )
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.scenes:
            scene, truth = load(name, Path(temporary) / name, arguments.views)
            for seed in arguments.seeds:
                for extent, (scene_of, chosen) in variants(scene).items():
                    how = replace(config, seed=seed, **chosen)
                    found = measure(scene, scene_of, how, extent.startswith(COARSE))
                    row = {
                        "scene": name,
                        "seed": seed,
                        "extent": extent,
                        "true_distance": truth,
                        **found,
                    }
                    rows.append(row)
                    print(
                        f"{name:12}  {seed:4}  {extent:18}  {row['content_distance']:8.3f}  "
                        f"{row['longest_edge']:12.3f}  {row['psnr']:5.2f}  {row['ssim']:.3f}  "
                        f"{row['near_mass']:9.4f}  {row['seconds']:7.1f}",
                        flush=True,
                    )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device, arguments.threads).count),
        "model": arguments.model,
        "steps": arguments.steps,
        "voxels": arguments.voxels,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'extents', arguments.device)}")


def load(name: str, folder: Path, views: int) -> tuple[wn.Scene, float | None]:
    """A scene, and the median true distance of what its cameras see, where that is known."""
    if name not in SCANS:
        return wn.load_scene(path_of(name)), None
    truth = write_scan(folder, views, n_points=32 * views, scan=name)
    return wn.load_scene(folder), truth


def variants(scene: wn.Scene) -> dict[str, tuple[wn.Scene, dict[str, Any]]]:
    """The scene with each extent, and what the configuration says."""
    alone = estimate_extent(scene.training_cameras, unbounded=scene.unbounded)
    without = replace(
        scene,
        box_min=alone.box_min,
        box_max=alone.box_max,
        content_distance=alone.content_distance,
        content_distances=None,
        observations=None,
        guessed=alone.guessed,
    )
    each = {"content_distance": "per-camera"}
    found: dict[str, tuple[wn.Scene, dict[str, Any]]] = {
        "cameras": (without, {"coarse_steps": 0}),
        "photographs": (without, {}),
        "photographs, per camera": (without, each),
        COARSE: (without, {}),
        f"{COARSE}, per camera": (without, each),
    }
    if scene.content_distances is not None:
        found |= {"points": (scene, {}), "points, per camera": (scene, each)}
    return found


def measure(
    scene: wn.Scene, trained: wn.Scene, config: wn.TrainConfig, by_training: bool
) -> dict[str, float]:
    """Train, and look at the test views and at the space before the training cameras.

    Args:
        scene: Whose views are looked at.
        trained: With the extent that the training begins with.
        config: Of the training.
        by_training: Whether a short training finds the extent even where photographs tell it.
    """
    if by_training:
        with mock.patch.object(coarse, "extent_by_sweep", lambda scene: None):
            trainer = prepare_trainer(trained, config)
    else:
        trainer = prepare_trainer(trained, config)
    progress = trainer.run()
    found = wn.evaluate(trainer.field(), scene)
    return {
        "content_distance": trainer.plan.content_distance,
        "longest_edge": float((trainer.scene.box_max - trainer.scene.box_min).max()),
        "psnr": found.mean["psnr"],
        "ssim": found.mean["ssim"],
        "near_mass": found.near_field.near_mass,
        "seconds": progress.seconds,
    }


if __name__ == "__main__":
    main()
