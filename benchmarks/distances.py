"""The content distance that photographs and short trainings tell, beside the true one.

    python benchmarks/distances.py room-scan room-inward room-mixed path/to/scene --seeds 0 1

Scenes are folders and those that room_scan.py writes, of which the true distance of each pixel is
known. Prints the content distance that the cameras give, that comparing the photographs tells, that
short trainings find, that of the points where there are some, and the median true one over all
pixels; how many short trainings there were, the longest edges of the boxes around what photographs
and short trainings tell, and the seconds of both. Writes
benchmarks/results/distances_<device>.json.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

from extents import load, variants
from measuring import add_model, machine, options, plain_training, write_record
from room_scan import SCANS

from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.points import ObservedExtent
from warpnerf.scenes.extent.swept import extent_by_sweep
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
    print(
        "scene         seed  cameras  photographs  found  points   true  rounds  longest edges  "
        "seconds"
    )
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
                began = time.perf_counter()
                swept, comparing = extent_by_sweep(alone), time.perf_counter() - began
                observed, seconds = extent_by_training(alone, resolve(alone, config))
                assert observed is not None, f"{name}: nothing opaque has grown"
                row = {
                    "scene": name,
                    "seed": seed,
                    "cameras": alone.content_distance,
                    "photographs": None if swept is None else swept.content_distance,
                    "found": observed.content_distance,
                    "points": None if scene.content_distances is None else scene.content_distance,
                    "true": truth,
                    "box_found": alone.guessed,
                    "photographs_edge": None if swept is None else longest_edge(swept),
                    "longest_edge": longest_edge(observed),
                    "comparing_seconds": comparing,
                    "seconds": seconds,
                }
                rows.append(row)
                told, edge, points, true = (
                    f"{row[key]:6.3g}" if row[key] else "     -"
                    for key in ("photographs", "photographs_edge", "points", "true")
                )
                print(
                    f"{name:12}  {seed:4}  {row['cameras']:7.3g}  {told:>11} {row['found']:6.3g}  "
                    f"{points}  {true}  {2 if alone.guessed else 1:6}  "
                    f"{edge} {row['longest_edge']:6.3g}  {comparing:.1f} {seconds:.1f}",
                    flush=True,
                )
    record = {
        "machine": machine(arguments.device, Workers(arguments.device, arguments.threads).count),
        "model": arguments.model,
        "views": arguments.views,
        "rows": rows,
    }
    print(f"wrote {write_record(record, arguments.output, 'distances', arguments.device)}")


def longest_edge(observed: ObservedExtent) -> float:
    """Of the box around what is seen, scene units."""
    return float((observed.box_max - observed.box_min).max())


if __name__ == "__main__":
    main()
