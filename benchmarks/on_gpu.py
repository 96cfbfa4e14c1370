"""Everything that a GPU has to show, in one command with a time limit: for machines that are lent.

    python benchmarks/on_gpu.py lego_800 --minutes 14 --folder runs/gpu

One job after another, the most telling first, each in a process with a time limit of its own; one
that fails or takes too long does not stop the next. What each prints is kept as FOLDER/NAME.txt,
records as FOLDER/NAME.json, and FOLDER/summary.json has seconds and exit codes. A job that has been
through is not done again when the command is given once more.

    check        gradients and whole trainings on this device (`warpnerf check`)
    cold, warm   seconds of a training of one step, without and with compiled kernels
    models       a gradient against eager torch, all models
    scaling      what the scaling costs per 300 000 samples
    lego         `quality` with 16 384 rays a step, test PSNR on the way, 60 s; and its evaluation
    kernels      tests of the kernels
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from measuring import ROOT, options
from training import path_of

BENCHMARKS = ROOT / "benchmarks"
TIMED_OUT = 124
"""Exit code of a job that was stopped, as of the command `timeout`."""


@dataclass(frozen=True)
class Job:
    """One measurement."""

    name: str
    command: list[str]
    seconds: float
    """It is stopped after so many."""


def jobs(scene: str, device: str, folder: Path) -> list[Job]:
    """All of them, in order.

    Args:
        scene: A capture of an object.
        device: cuda:0.
        folder: Where they write.
    """
    python, warpnerf = [sys.executable], [sys.executable, "-m", "warpnerf"]
    on = ["--device", device]
    one_step = [*warpnerf, "train", "builtin:room", *on, "--steps", "1", "--eval-views", "none"]
    quality = ["--preset", "quality", "--rays-per-step", "16384", "--eval-every", "500"]
    eager_only = ["--without", "torch.compile", "numba", "taichi", "drjit"]
    run = str(folder / "runs" / "lego")

    def record(script: str, name: str) -> list[str]:
        return [*python, str(BENCHMARKS / script), *on, "--output", str(folder / f"{name}.json")]

    return [
        Job("check", [*warpnerf, "check", *on], 150),
        Job("cold", [*one_step, "--output", str(folder / "runs" / "cold")], 120),
        Job("warm", [*one_step, "--output", str(folder / "runs" / "warm")], 60),
        Job(
            "models",
            [*record("throughput.py", "models"), "--grids", "160", "--rounds", "7", *eager_only],
            240,
        ),
        Job("scaling", [*record("gradient_scaling.py", "scaling"), "--pairs", "100"], 120),
        Job(
            "lego",
            [*warpnerf, "train", scene, *on, *quality, "--time-limit", "60", "--output", run],
            180,
        ),
        Job("evaluation", [*warpnerf, "eval", run, *on], 60),
        Job(
            "kernels",
            [*python, "-m", "pytest", "-q", "-m", "not slow", *on, str(ROOT / "tests" / "kernels")],
            240,
        ),
    ]


def main() -> None:
    parser = options(__doc__)
    parser.add_argument("scene", help="a capture of an object, such as lego_800")
    parser.add_argument("--minutes", type=float, default=14.0, help="for all jobs together")
    parser.add_argument("--folder", type=Path, default=Path("runs/gpu"))
    parser.add_argument("--only", nargs="+", help="jobs by name")
    args = parser.parse_args()
    folder = args.folder.resolve()
    wanted = [
        job
        for job in jobs(path_of(args.scene), args.device, folder)
        if args.only is None or job.name in args.only
    ]
    folder.mkdir(parents=True, exist_ok=True)
    until = time.perf_counter() + 60.0 * args.minutes
    run_all(wanted, folder, until)


def run_all(wanted: list[Job], folder: Path, until: float) -> None:
    """Do the jobs that have not been through, and say how each went.

    Args:
        wanted: Which ones.
        folder: Where their output goes, and the kernels that they compile.
        until: When time is up, by ``time.perf_counter``.
    """
    summary = folder / "summary.json"
    done = json.loads(summary.read_text()) if summary.exists() else {}
    environment = {**os.environ, "WARP_CACHE_PATH": str(folder / "kernels")}
    for job in wanted:
        left = until - time.perf_counter()
        if done.get(job.name, {}).get("exit_code") == 0 or left <= 0.0:
            continue
        start = time.perf_counter()
        with (folder / f"{job.name}.txt").open("w") as output:
            try:
                exit_code = subprocess.run(
                    job.command,
                    env=environment,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    timeout=min(job.seconds, left),
                ).returncode
            except subprocess.TimeoutExpired:
                exit_code = TIMED_OUT
        seconds = round(time.perf_counter() - start, 1)
        done[job.name] = {"exit_code": exit_code, "seconds": seconds, "command": job.command}
        summary.write_text(json.dumps(done, indent=2))
        print(f"{job.name}: {seconds} s, exit code {exit_code}", flush=True)


if __name__ == "__main__":
    main()
