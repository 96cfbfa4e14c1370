"""What training takes whose photographs are on disk: memory, and time against those in memory.

    python benchmarks/photos_on_disk.py --photographs 200 --size 4000 3000

Makes a scene of generated JPEGs in a temporary folder. First `warpnerf train --images disk` runs as
users run it, and the most memory of its own that it takes is read from the system: pages that no
file holds (RssAnon), and all pages, those of files included (VmHWM). Then, in this process, two
trainings that differ in where their photographs are take turns, on so few of them that memory holds
both; a round's ratio is of the time for as many updates. Prints these and writes
benchmarks/results/photos_on_disk_<device>.json.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from measuring import (
    add_model,
    machine,
    median_interval,
    options,
    plain_training,
    show,
    write_record,
)
from PIL import Image

import warpnerf as wn
from warpnerf.runtime.parallel import Workers
from warpnerf.training.trainer import Trainer

DISTINCT = 8
"""Photographs that are generated; the others are copies."""


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("--photographs", type=int, default=200)
    parser.add_argument("--size", type=int, nargs=2, default=(4000, 3000), help="width, height")
    parser.add_argument("--steps", type=int, default=300, help="of the training that is watched")
    parser.add_argument("--in-turns", type=int, default=60, help="photographs of those in turns")
    parser.add_argument("--rounds", type=int, default=31)
    parser.add_argument("--updates", type=int, default=5, help="of each side in a round")
    parser.add_argument("--folder", type=Path, help="for the scene; there has to be room on disk")
    add_model(parser)
    arguments = parser.parse_args()
    if arguments.device != "cpu":
        parser.error("on CUDA photographs are copied to the device, wherever they were")
    with tempfile.TemporaryDirectory(dir=arguments.folder) as temporary:
        folder = Path(temporary)
        write_scene(folder / "scene", arguments.photographs, *arguments.size)
        decoded = 3 * arguments.photographs * arguments.size[0] * arguments.size[1]
        watched = watch(folder, arguments)
        write_scene(folder / "fewer", arguments.in_turns, *arguments.size)
        ratios = race(folder / "fewer", arguments)
    print(f"decoded                {decoded / 2**30:6.2f} GiB")
    print(f"memory of its own      {(watched['anonymous'] or 0) / 2**30:6.2f} GiB")
    print(f"with pages of files    {(watched['resident'] or 0) / 2**30:6.2f} GiB")
    print(f"time of an update on disk over in memory: {show(median_interval(ratios), 3)}")
    record = {
        "machine": machine(arguments.device, Workers(arguments.device).count),
        "model": arguments.model,
        "photographs": arguments.photographs,
        "in_turns": arguments.in_turns,
        "size": list(arguments.size),
        "steps": arguments.steps,
        "decoded_bytes": decoded,
        "most_anonymous_bytes": watched["anonymous"],
        "most_resident_bytes": watched["resident"],
        "whole_seconds": watched["seconds"],
        "disk_over_memory": median_interval(ratios),
    }
    print(f"wrote {write_record(record, arguments.output, 'photos_on_disk', arguments.device)}")


def write_scene(folder: Path, n: int, width: int, height: int) -> None:
    """Photographs from a ring, of smooth noise, which JPEG packs as it does what lenses see.

    Some are copies of others, which costs nobody less: all are decoded, and kept.
    """
    (folder / "images").mkdir(parents=True)
    frames: list[dict[str, Any]] = []

    def write(number: int) -> None:
        rng = np.random.default_rng(number)
        coarse = rng.integers(0, 256, (-(-height // 20), -(-width // 20), 3), np.uint8)
        image = Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC)
        image.save(folder / f"images/{number:04}.jpg", quality=85)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(write, range(min(n, DISTINCT))))
    for number in range(n):
        if number >= DISTINCT:
            shutil.copy(
                folder / f"images/{number % DISTINCT:04}.jpg", folder / f"images/{number:04}.jpg"
            )
        a = 2.0 * np.pi * number / n
        back = np.array([np.cos(a), np.sin(a), 0.3]) / np.hypot(1.0, 0.3)
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, 4.0 * back], axis=1)
        path = f"images/{number:04}.jpg"
        frames.append({"file_path": path, "transform_matrix": pose.tolist()})
    content = {"fl_x": 0.8 * width, "fl_y": 0.8 * width, "w": width, "h": height, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))


def watch(folder: Path, arguments: Any) -> dict[str, Any]:
    """Run the command until its training is done, and look at its memory all the while."""
    command = [sys.executable, "-m", "warpnerf", "train", str(folder / "scene")]
    command += ["--output", str(folder / "run"), "--images", "disk"]
    command += ["--steps", str(arguments.steps), "--model", arguments.model]
    command += ["--device", arguments.device]
    begin = time.perf_counter()
    most: dict[str, int] = {}
    field = folder / "run" / "field.safetensors"
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None and not field.exists():  # test views are large to look at
            for name, value in memory_of(process.pid).items():
                most[name] = max(most.get(name, 0), value)
            time.sleep(0.05)
        if process.poll() not in (None, 0):
            raise SystemExit("the training failed")
        process.kill()
    return {
        "anonymous": most.get("RssAnon"),
        "resident": most.get("VmHWM"),
        "seconds": time.perf_counter() - begin,
    }


def memory_of(process: int) -> dict[str, int]:
    """Bytes, by the names of Linux; nothing on other systems."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return {}
    words = [line.split() for line in lines if line.startswith(("RssAnon:", "VmHWM:"))]
    return {name.rstrip(":"): int(value) << 10 for name, value, *_ in words}


def race(scene: Path, arguments: Any) -> list[float]:
    """Time on disk over time in memory, of each round."""
    config = plain_training(model=arguments.model, steps=10**6, device=arguments.device)
    trainers = [Trainer(wn.load_scene(scene, images=place), config) for place in ("disk", "memory")]
    ratios = []
    for number in range(arguments.rounds + 1):
        seconds = [0.0, 0.0]
        for side in (0, 1) if number % 2 else (1, 0):
            begin = time.perf_counter()
            for _ in range(arguments.updates):
                trainers[side].update()
            seconds[side] = time.perf_counter() - begin
        if number:  # the first compiles
            ratios.append(seconds[0] / seconds[1])
    return ratios


if __name__ == "__main__":
    main()
