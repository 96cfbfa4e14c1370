"""A scene in blocks against one training of the whole: seconds, bytes and PSNR.

    python benchmarks/blocks.py builtin:building-4 --count 4 --steps 400 --voxels 32768

Blocks are trained one after the other by one thread and by two, then two at a time by one thread
each: in processes, and by two workers of Ray, where that is installed. All by `warpnerf
train-blocks`, as users do. The whole is trained with as many nodes and steps as all blocks
together. Prints wall seconds with reading, compiling, saving, and starting Ray, seconds of training
alone, PSNR of the test views, and what a block reads and writes; writes
benchmarks/results/blocks_<device>.json.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from measuring import machine, options, write_record

from warpnerf.blocks.folder import BlockFolder
from warpnerf.runs.listing import last_report

WAYS = {
    "1 process, 1 thread": (1, 1, "local"),
    "1 process, 2 threads": (1, 2, "local"),
    "2 processes": (2, 1, "local"),
    "2 workers of Ray": (2, 1, "ray"),
}
"""Workers, threads of each, and engine."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scene", nargs="?", default="builtin:building-4")
    parser.add_argument("--count", type=int, default=4, help="blocks")
    parser.add_argument("--downscale", type=int, default=4)
    parser.add_argument("--steps", type=int, default=400, help="of a block")
    parser.add_argument("--voxels", type=int, default=32768, help="of a block")
    parser.add_argument("--sampler", default="march", choices=["march", "resampled"])
    arguments = parser.parse_args()
    given = ["--model", "rgb", "--sampler", arguments.sampler, "--device", arguments.device]
    size = ["--downscale", str(arguments.downscale)]
    of_block = [*given, "--steps", str(arguments.steps), "--voxels", str(arguments.voxels)]
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary)
        warm(root, arguments.scene, size, of_block)
        for way, (workers, threads, engine) in WAYS.items():
            if engine == "ray" and find_spec("ray") is None:
                print("Ray is not installed: pip install 'warpnerf[scale]'")
                continue
            folder = root / way.replace(" ", "_")
            command(
                "blocks", arguments.scene, *size, "--output", folder, "--count", arguments.count
            )
            how = ("--engine", engine, "--workers", workers, "--threads", threads)
            seconds = command("train-blocks", folder, *how, "--", *of_block)
            rows.append({"way": way, "wall": seconds, **of_folder(folder), **psnr(folder)})
        whole = root / "whole"
        most = ["--steps", arguments.count * arguments.steps]
        most += ["--voxels", arguments.count * arguments.voxels, "--eval-views", "none"]
        seconds = command(
            *("train", arguments.scene, *size, "--output", whole, "--threads", 1, *given, *most)
        )
        trained = last_report(whole / "log.jsonl").seconds
        field = (whole / "field.safetensors").stat().st_size
        found = {"training": trained, "field": field, **psnr(whole)}
        rows.append({"way": "the whole, 1 thread", "wall": seconds, **found})
    print("way                      wall [s]  training [s]    PSNR")
    for row in rows:
        print(f"{row['way']:22}  {row['wall']:9.1f}  {row['training']:12.1f}  {row['psnr']:6.2f}")
    for name in ("part", "field", "photographs"):
        print(f"{name} of a block: {rows[0][name]:.0f}{' bytes' * (name != 'photographs')}")
    record = {"machine": machine(arguments.device, 2), **vars(arguments), "rows": rows}
    record["output"] = None
    print(f"wrote {write_record(record, arguments.output, 'blocks', arguments.device)}")


def warm(root: Path, scene: str, size: list[str], of_block: list[str]) -> None:
    """Compile what trainings of blocks and of the whole need."""
    command("blocks", scene, *size, "--output", root / "warm", "--count", 1)
    command("train-blocks", root / "warm", "--", *of_block, "--steps", 2)
    command(
        *("train", scene, *size, "--output", root / "warm-whole", *of_block, "--steps", 2),
        *("--eval-views", "none"),
    )


def command(*words: object) -> float:
    """Run the command, and return the seconds that it took."""
    begin = time.perf_counter()
    line = [sys.executable, "-m", "warpnerf", *map(str, words)]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{' '.join(line)}: {done.stderr or done.stdout}")
    return time.perf_counter() - begin


def of_folder(folder: Path) -> dict[str, float]:
    """Training seconds of all blocks, and means of what a block has."""
    blocks = BlockFolder.read(folder)
    numbers = range(len(blocks))
    logs = [last_report(blocks.run(n).folder / "log.jsonl") for n in numbers]
    fields = [(blocks.run(n).folder / "field.safetensors").stat().st_size for n in numbers]
    return {
        "training": sum(report.seconds for report in logs),
        "part": sum(blocks.part(n).stat().st_size for n in numbers) / len(blocks),
        "field": sum(fields) / len(blocks),
        "photographs": sum(b.photographs for b in blocks.config.blocks) / len(blocks),
    }


def psnr(folder: Path) -> dict[str, float]:
    """Mean PSNR of the test views."""
    file = folder / "benchmark.json"
    command("eval", folder, "--json", file)
    return {"psnr": json.loads(file.read_text())["mean"]["psnr"]}


if __name__ == "__main__":
    main()
