"""The content distance that a short training finds, beside the true one.

    python benchmarks/distances.py room-scan room-inward room-mixed path/to/scene --seeds 0 1

Scenes are folders and those that room_scan.py writes, of which the true distance of each pixel is
known. Prints the content distance that the cameras give, that short trainings find, that of the
points where there are some, and the median true one over all pixels; how many short trainings there
were, the longest edge of the box around what they saw, and their seconds. Writes
benchmarks/results/distances_<device>.json.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from extents import load, variants
from measuring import add_model, machine, options, plain_training, write_record
from room_scan import SCANS

from warpnerf.runtime.parallel import Workers
from warpnerf.training.coarse import extent_by_training
from warpnerf.training.plan import resolve


def main() -> None:
    parser = options(__doc__)
    known = f"folders, {', '.join(SCANS)}"
    parser.add_argument("scenes", nargs="*", default=list(SCANS), help=known)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--threads", type=int, help="by default one per usable core")
    parser.add_argument("--views", type=int, default=125, help="photographs of a scan")
    add_model(parser)
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    print("scene         seed  cameras  found  points   true  rounds  longest edge  seconds")
    with tempfile.TemporaryDirectory() as temporary:
        for name in arguments.scenes:
            scene, truth = load(name, Path(temporary) / name, arguments.views)
            alone, _ = variants(scene)["cameras"]
            for seed in arguments.seeds:
                config = plain_training(
                    model=arguments.model,
                    seed=seed,
                    device=arguments.device,
                    threads=arguments.threads,
                )
                observed, seconds = extent_by_training(alone, resolve(alone, config))
                assert observed is not None, f"{name}: nothing opaque has grown"
                row = {
                    "scene": name,
                    "seed": seed,
                    "cameras": alone.content_distance,
                    "found": observed.content_distance,
                    "points": None if scene.content_distances is None else scene.content_distance,
                    "true": truth,
                    "box_found": alone.guessed,
                    "longest_edge": float((observed.box_max - observed.box_min).max()),
                    "seconds": seconds,
                }
                rows.append(row)
                shown = [f"{row[key]:6.3g}" if row[key] else "     -" for key in ("points", "true")]
                print(
                    f"{name:12}  {seed:4}  {row['cameras']:7.3g} {row['found']:6.3g}  "
                    f"{'  '.join(shown)}  {2 if alone.guessed else 1:6}  "
                    f"{row['longest_edge']:12.3g}  {seconds:7.1f}",
                    flush=True,
                )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device, arguments.threads).count),
        "model": arguments.model,
        "views": arguments.views,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'distances', arguments.device)}")


if __name__ == "__main__":
    main()
