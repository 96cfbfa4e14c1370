"""Kills trainings of blocks at random, and asks that nothing is lost.

    python tests/kill_blocks.py --kills 50 [--seed 0] [--engine ray]

Two blocks of the built-in room are trained by `warpnerf train-blocks` with two workers, again and
again, while one process of them after another is killed: the command itself, or the training of a
block. After each kill a block resumes no earlier than from the last checkpoint that it had, and in
the end its field has the same bits as that of a training which nobody killed.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "kernels"))

from tests.support.tiny_runs import start
from warpnerf.blocks.folder import BlockFolder

SCENE = ("builtin:room-sparse", "--downscale", "8", "--count", "2")
OPTIONS = ("--voxels", "512", "--model", "rgb", "--sampler", "march", "--checkpoint-every", "0.3")
LIMIT = 300.0
"""Seconds within which a training without kills ends."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=600, help="of a block")
    parser.add_argument("--engine", choices=["local", "ray"], default="local")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    engine = ("--engine", args.engine, "--workers", "2", "--threads", "1")
    options = (*engine, "--", "--steps", str(args.steps), *OPTIONS)
    kills: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as temporary:
        expected = fields(trained(cut(Path(temporary) / "whole"), options))
        repeated = 0
        while kills.total() < args.kills:
            blocks = cut(Path(temporary) / f"killed-{repeated}")
            while not done(blocks):
                if kills.total() < args.kills:
                    kills += killed(blocks, options, rng)
                else:
                    trained(blocks, options)
            assert fields(blocks) == expected, "a field differs from that of a training unkilled"
            repeated += 1
    of = ", ".join(f"{n} of {what}" for what, n in sorted(kills.items()))
    print(f"{kills.total()} kills ({of}): blocks have the bits of those that nobody killed")


def cut(folder: Path) -> BlockFolder:
    """Cut the room into blocks."""
    finished(start("blocks", *SCENE, "--output", folder))
    return BlockFolder.read(folder)


def trained(blocks: BlockFolder, options: tuple[str, ...]) -> BlockFolder:
    """Train what is not trained, without kills."""
    finished(start("train-blocks", blocks.folder, *options))
    return blocks


def finished(process: subprocess.Popen[str]) -> None:
    """Wait for success."""
    out, err = process.communicate(timeout=LIMIT)
    assert process.returncode == 0, (out, err)


def killed(blocks: BlockFolder, options: tuple[str, ...], rng: random.Random) -> Counter[str]:
    """Continue, kill something soon after a block has trained on, see it resume, and kill all.

    Returns:
        How many processes of which kind were killed.
    """
    kills: Counter[str] = Counter()

    def kill(kind: str, pids: list[int]) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                kills[kind] += 1

    process = start("train-blocks", blocks.folder, *options)
    saved, until = last_steps(blocks), time.monotonic() + LIMIT
    while process.poll() is None and last_steps(blocks) == saved:
        assert time.monotonic() < until, "no block trains"
        time.sleep(0.02)
    time.sleep(rng.uniform(0.0, 1.0))
    before = {n: step for n, step in enumerate(last_steps(blocks)) if step is not None}
    said = [len(log(blocks, n)) for n in range(len(blocks))]
    if process.poll() is None and rng.random() < 0.5:
        kill("the command", [process.pid])
        process.wait()
        process = start("train-blocks", blocks.folder, *options)
    else:
        kill("a training", trainings(blocks)[:1])
    until = time.monotonic() + rng.uniform(0.0, 6.0)  # it may be killed while it begins again
    while process.poll() is None and time.monotonic() < until:
        time.sleep(0.02)
    if process.poll() is None:
        kill("the command", [process.pid])
        process.wait()
    kill("a training", trainings(blocks))  # they train on without the command
    for n, step in before.items():
        for resumed in re.findall(r"resuming after step (\d+)", log(blocks, n)[said[n] :]):
            assert int(resumed) >= step, f"block {n} resumes after {resumed}, and had saved {step}"
    return kills


def trainings(blocks: BlockFolder) -> list[int]:
    """Processes that train."""
    found = []
    for n in range(len(blocks)):
        with suppress(OSError, ValueError):
            found.append(int((blocks.run(n).folder / ".lock").read_text()))
    return [pid for pid in found if Path(f"/proc/{pid}").exists()]


def last_steps(blocks: BlockFolder) -> list[int | None]:
    """The last step that each block has saved."""
    return [blocks.run(n).last_step for n in range(len(blocks))]


def log(blocks: BlockFolder, number: int) -> str:
    path = blocks.folder / f"{blocks.name(number)}.log"
    return path.read_text() if path.exists() else ""


def done(blocks: BlockFolder) -> bool:
    return all((blocks.run(n).folder / "field.safetensors").exists() for n in range(len(blocks)))


def fields(blocks: BlockFolder) -> list[bytes]:
    return [(blocks.run(n).folder / "field.safetensors").read_bytes() for n in range(len(blocks))]


if __name__ == "__main__":
    main()
