"""One scene in several processes, against as many threads in one process.

    python benchmarks/processes.py --scene fox_q

Both sides train the scene alike, so that their grids grow at the same updates; blocks of updates
take turns, and each block of one side is paired with the same block of the other. Prints how fast
the processes are against the threads, by updates done, with 95 % intervals over blocks, and how
much of the grid an update touches. `--exchange messages` copies touched tiles into shared memory
and their sums back, `tiles` sends them by gloo, as where processes share no memory, `dense` all of
the gradient. Where other programs keep the
cores busy, only the processor time of an exchange tells anything, that of one process. Writes
benchmarks/results/processes_cpu.json.
"""

from __future__ import annotations

import multiprocessing
import os
import socket
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
import warp as wp
from measuring import machine, median_interval, options, show, write_record
from training import path_of
from warpnerf_kernels.base.tiles import TILE

import warpnerf as wn
from warpnerf.config import TrainConfig
from warpnerf.presets import PRESETS
from warpnerf.runtime.memory import zero_bytes
from warpnerf.runtime.parallel import Workers
from warpnerf.torch.processes import Processes
from warpnerf.training.peers import Peers, Signals
from warpnerf.training.trainer import Trainer


class Touched(Processes):
    """Counts what is exchanged."""

    exchanged_bytes = 0

    def _add_flags(self, flags: list[torch.Tensor]) -> None:
        self.exchanged_bytes += sum(touched.nbytes for touched in flags)
        super()._add_flags(flags)

    def _sum(self, room: torch.Tensor, shares: Sequence[Callable[[], None]]) -> None:
        self.exchanged_bytes += room[0].nbytes
        super()._sum(room, shares)

    def _add_shared(self, values: wp.array, touched: wp.array, workers: Workers) -> None:
        n_tiles = np.count_nonzero(touched.numpy().view(bool))
        self.exchanged_bytes += n_tiles * TILE * 4 * values.dtype._length_
        super()._add_shared(values, touched, workers)


class Messages(Touched):
    """Copies touched tiles into shared memory, and sums back."""

    def zeros(self, n_bytes: int) -> np.ndarray:
        return zero_bytes(n_bytes)


class Tiles(Messages):
    """Shares no memory: all goes by gloo."""

    def _shared(self, n_bytes: int) -> None:
        return None  # nor do they meet there


class Dense(Tiles):
    """Adds the gradients of all nodes, touched or not."""

    def _add_flags(self, flags: list[torch.Tensor]) -> None:
        for touched in flags:
            touched.fill_(1)


EXCHANGES = {"shared": Touched, "messages": Messages, "tiles": Tiles, "dense": Dense}


class Side:
    """A trainer, and the seconds that its processes take to exchange gradients."""

    def __init__(self, scene: wn.Scene, config: TrainConfig, peers: Peers) -> None:
        self.peers, self.exchanged, self.processor = peers, 0.0, 0.0
        add = peers.add

        def timed(*arguments: Any) -> None:
            began, used = time.perf_counter(), time.process_time()
            add(*arguments)
            self.exchanged += time.perf_counter() - began
            self.processor += time.process_time() - used

        peers.add = timed  # type: ignore[method-assign]
        self.trainer = Trainer(scene, config, peers=peers)

    def updates(self, count: int) -> dict[str, float]:
        """Seconds of some updates, and what was exchanged meanwhile."""
        began, self.exchanged, self.processor = time.perf_counter(), 0.0, 0.0
        bytes_before = getattr(self.peers, "exchanged_bytes", 0)
        for _ in range(count):
            if self.trainer.fraction >= 1.0:
                break
            self.peers.agree(Signals(seconds=0.0, stop=False, save=False))
            self.trainer.update()
        seconds = time.perf_counter() - began
        return {
            "seconds": seconds,
            "exchanged": self.exchanged,
            "processor": self.processor,
            "bytes": getattr(self.peers, "exchanged_bytes", 0) - bytes_before,
            "step": self.trainer.steps_done,
        }


def one_of_several(
    pipe: Connection, variables: dict[str, str], exchange: str, scene: str, config: TrainConfig
) -> None:
    """Trains when it is told to, in a process of its own."""
    os.environ |= variables
    torch.set_num_threads(1)
    side = Side(wn.load_scene(scene), config, EXCHANGES[exchange]())
    pipe.send({})
    while (count := pipe.recv()) is not None:
        pipe.send(side.updates(count))


class Several:
    """Processes of one thread each."""

    def __init__(self, n: int, exchange: str, scene: str, config: TrainConfig) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = str(free.getsockname()[1])
        context = multiprocessing.get_context("spawn")
        self._pipes = []
        for rank in range(n):
            ours, theirs = context.Pipe()
            variables = {"RANK": str(rank), "WORLD_SIZE": str(n), "MASTER_PORT": port}
            variables |= {"MASTER_ADDR": "127.0.0.1", "OMP_NUM_THREADS": "1"}
            arguments = (theirs, variables, exchange, scene, config)
            context.Process(target=one_of_several, args=arguments, daemon=True).start()
            self._pipes.append(ours)
        for pipe in self._pipes:
            pipe.recv()

    def updates(self, count: int) -> dict[str, float]:
        """As ``Side.updates``, of the slowest."""
        for pipe in self._pipes:
            pipe.send(count)
        return max((pipe.recv() for pipe in self._pipes), key=lambda found: found["seconds"])

    def close(self) -> None:
        """End them."""
        for pipe in self._pipes:
            pipe.send(None)


def main(words: Sequence[str] | None = None) -> dict[str, Any]:
    parser = options(__doc__)
    parser.add_argument("--scene", default="builtin:room")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--exchange", choices=EXCHANGES, default="shared")
    parser.add_argument("--steps", type=int, default=3000, help="of the training")
    parser.add_argument("--voxels", type=int, help="default: the preset's")
    parser.add_argument("--block", type=int, default=10, help="updates")
    args = parser.parse_args(words)
    n, fast = args.processes, PRESETS["fast"]
    config = TrainConfig(**{**vars(fast), "steps": args.steps, "time_limit": None})
    if args.voxels is not None:
        grid = {**vars(fast.grid), "voxels": args.voxels}
        config = TrainConfig(**{**vars(config), "grid": type(fast.grid)(**grid)})
    each = TrainConfig(**{**vars(config), "threads": 1})
    several = Several(n, args.exchange, path_of(args.scene), each)
    together = TrainConfig(**{**vars(config), "threads": n})
    alone = Side(wn.load_scene(path_of(args.scene)), together, Peers())
    for side in (alone, several):
        side.updates(1)  # compiles
    blocks: list[dict[str, float]] = []
    while alone.trainer.steps_done < args.steps:
        sides = (several, alone) if len(blocks) % 2 else (alone, several)
        found = {side: side.updates(args.block) for side in sides}
        one, more = found[alone], found[several]
        assert one["step"] == more["step"]
        blocks.append(
            {
                "step": one["step"],
                "threads_ms": 1e3 * one["seconds"] / args.block,
                "processes_ms": 1e3 * more["seconds"] / args.block,
                "exchange_ms": 1e3 * more["exchanged"] / args.block,
                "exchange_processor_ms": 1e3 * more["processor"] / args.block,
                "exchange_mb": 1e-6 * more["bytes"] / args.block,
            }
        )
        if len(blocks) % 10 == 0:
            print_row(blocks[-10:])
    several.close()
    ratio = np.array([b["threads_ms"] / b["processes_ms"] for b in blocks])
    record = {
        "benchmark": "processes",
        "machine": machine("cpu", n),
        "scene": args.scene,
        "exchange": args.exchange,
        "steps": args.steps,
        "blocks": blocks,
        "speed": median_interval(ratio),
        "speed_of_all": sum(b["threads_ms"] for b in blocks)
        / sum(b["processes_ms"] for b in blocks),
    }
    print(f"speed of {n} processes against {n} threads: {show(record['speed'], 2)}, ", end="")
    print(f"over the whole training {record['speed_of_all']:.2f}")
    print(f"record: {write_record(record, args.output, 'processes', 'cpu')}")
    return record


def print_row(blocks: list[dict[str, float]]) -> None:
    """Medians of some blocks."""
    names = ("threads_ms", "processes_ms", "exchange_ms", "exchange_processor_ms", "exchange_mb")
    figures = [float(np.median([b[name] for b in blocks])) for name in names]
    print(
        f"step {blocks[-1]['step']:5.0f}  threads {figures[0]:7.1f} ms  processes "
        f"{figures[1]:7.1f} ms an update, of which exchange {figures[2]:6.1f} ms "
        f"({figures[3]:.1f} of processor, {figures[4]:.0f} MB)  "
        f"speed {np.median([b['threads_ms'] / b['processes_ms'] for b in blocks]):.2f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
