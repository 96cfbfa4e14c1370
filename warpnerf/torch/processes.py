"""Processes that torchrun has started, as the peers of a training: by torch.distributed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from datetime import timedelta
from functools import partial
from mmap import PAGESIZE, mmap
from typing import Any, NamedTuple, TypeVar
from weakref import WeakValueDictionary

import numpy as np
import torch
import torch.distributed as dist
import warp as wp
from warpnerf_kernels.base.tiles import TILE
from warpnerf_kernels.optim.reduction import BLOCK, add_tiles

from warpnerf.checks import InputError
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.parameters import Parameter
from warpnerf.runtime.meeting import Meeting, meeting_bytes
from warpnerf.runtime.parallel import Workers
from warpnerf.runtime.shared_memory import opened, share
from warpnerf.training.peers import PeerLostError, Peers, Signals

PATIENCE = timedelta(seconds=45)
"""For a process that does not come to the end of its update: then it hangs."""
STARTING = timedelta(minutes=5)
"""For the others to start."""
SET_UP = timedelta(hours=24)
"""For one that sets up: it may estimate poses, or compile."""
SAVING = timedelta(minutes=10)
"""For the first one while it saves a checkpoint, or reports."""

T = TypeVar("T")


class Processes(Peers):
    """The processes of this training, by gloo between CPUs and by NCCL between CUDA devices.

    Where all can reach the same memory, on the CPU, they meet there, and gradients lie there, or
    go through that.
    """

    def __init__(self) -> None:
        """Meet the others, which torchrun's variables name.

        Raises:
            InputError: They cannot be met.
        """
        self._room: torch.Tensor | None = None
        self._rows: WeakValueDictionary[int, np.ndarray] = WeakValueDictionary()
        self._has_begun = False
        try:
            self._store, self.rank, self.count = next(dist.rendezvous("env://", timeout=STARTING))
            dist.init_process_group(
                "gloo",
                store=dist.PrefixStore("gloo", self._store),
                rank=self.rank,
                world_size=self.count,
                timeout=SET_UP,
            )
            self._training = dist.new_group(timeout=PATIENCE)
            self._saving = dist.new_group(timeout=SAVING)
            self._devices: dist.ProcessGroup | None = None
            # Who refuses its options ends at once, and others would still ask its store.
            dist.barrier(self._saving)
            self._meeting = self._meeting_place()
        except (RuntimeError, ValueError) as error:
            why = str(error).strip().partition("\n")[0][:200].rstrip(".")
            raise InputError(
                f"process {os.environ.get('RANK')} does not meet the others ({why}); start all "
                "of them by torchrun."
            ) from error

    def _meeting_place(self) -> Meeting | None:
        """In memory, where all can reach the same."""
        memory = self._shared(meeting_bytes(self.count))
        if memory is None:
            return None
        process_ids = [0] * self.count
        dist.all_gather_object(process_ids, os.getpid(), group=self._saving)
        return Meeting(memory, self.rank, process_ids)

    def is_first_to_fail(self) -> bool:
        """By a count in the store where they met."""
        try:
            return int(self._store.add("failed", 1)) == 1
        except RuntimeError:  # who keeps it has ended: the first process, or torchrun
            return False

    def from_first(self, make: Callable[[], T]) -> T:
        """By a broadcast; before updates begin, the others wait for as long as it takes."""
        found: list[Any] = [None, None]
        if self.rank == 0:
            try:
                found[0] = make()
            except InputError as error:
                found[1] = str(error)
        with _lost():
            dist.broadcast_object_list(found, group=self._training if self._has_begun else None)
        result, refused = found
        if refused is not None:
            raise InputError(refused)
        return result

    def require_same(self, what: Callable[[], dict[str, str]]) -> None:
        """All compare what all have, and so find the same."""
        found: list[Any] = [None] * self.count
        with _lost():
            dist.all_gather_object(found, what())
        for rank, other in enumerate(found):
            for name, value in found[0].items():
                if other[name] != value:
                    raise InputError(
                        f"process {rank} trains with another {name} than process 0; give all "
                        "processes of a training the same scene and options."
                    )

    def wait(self) -> None:
        """Until all are here, as after compiling or saving."""
        self._has_begun = False  # updates, of which the next one begins with ``agree``
        with _lost():
            dist.all_reduce(torch.zeros(1), group=self._saving)

    def agree(self, signals: Signals) -> Signals:
        """The seconds of the first process; one that stops, whose loss is not finite, or the first
        that saves, is enough."""
        self._has_begun = True
        first = self.rank == 0
        seconds, save = signals.seconds if first else 0.0, first and signals.save
        mine = (seconds, signals.stop, save, not signals.finite)
        most = self._largest([float(value) for value in mine])
        stop, saves, failed = (bool(number) for number in most[1:])
        return Signals(seconds=most[0], stop=stop, save=saves, finite=not failed)

    def _largest(self, numbers: list[float]) -> list[float]:
        """The largest of all processes, number by number."""
        if self._meeting is not None:
            with _lost():
                return list(self._meeting.exchange(numbers, _patience()).max(axis=0))
        of_all = torch.tensor(numbers, dtype=torch.float64)
        self._reduce(of_all, dist.ReduceOp.MAX)
        return [float(number) for number in of_all]

    @property
    def kernels(self) -> tuple[wp.Kernel, ...]:
        """The one that sums what lies in shared memory."""
        return (add_tiles,)

    def zeros(self, n_bytes: int) -> np.ndarray:
        """In shared memory, where all can reach it: a row for each process, of which all know."""
        size = -(-n_bytes // PAGESIZE) * PAGESIZE
        shared = self._shared(self.count * size)
        if shared is None:
            return super().zeros(n_bytes)
        rows = np.frombuffer(shared, np.uint8)  # lives as long as any part of it is in use
        own = rows[self.rank * size :][:n_bytes]
        self._rows[own.ctypes.data] = rows
        return own

    def add(self, accumulated: Sequence[tuple[Gradients, Parameter]], workers: Workers) -> None:
        """Sums of touched tiles and of weights; the order of summands depends on ranks alone.

        Where gradients do not lie in shared memory themselves, all flags come first, then all sums.
        No process writes a message before all have read the sums of the update before, as all
        ``agree`` in between.
        """
        device = accumulated[0][0].arrays["weights"].device
        if device.is_cuda:
            self._use(device)
            wp.synchronize_device(device)
        shared: list[tuple[wp.array, wp.array]] = []
        tiled: list[tuple[torch.Tensor, torch.Tensor]] = []
        rows: list[torch.Tensor] = []
        for gradients, parameter in accumulated:
            arrays = [gradients.arrays[name] for name in parameter.gradient]
            tensors = [wp.to_torch(array, requires_grad=False) for array in arrays]
            if all(array.ptr in self._rows for array in arrays):
                shared.append((arrays[0], arrays[1]))
            elif len(tensors) == 2:
                tiled.append((tensors[0], tensors[1]))
            else:
                rows.append(tensors[0])
        if tiled:
            self._add_flags([touched for _, touched in tiled])
        shares = [partial(self._add_shared, *of, workers) for of in shared]
        if tiled or rows:
            self._add_values([_tiles(*of) for of in tiled], rows, shares)
        else:
            self._in_shares(shares)
        if device.is_cuda:
            torch.cuda.synchronize(device.ordinal)

    def _use(self, device: wp.Device) -> None:
        """Exchange by NCCL, from this process's device; all processes have one then."""
        torch.cuda.set_device(device.ordinal)
        if self._devices is None:
            with _lost():
                self._devices = dist.new_group(backend="nccl", timeout=PATIENCE)

    def _add_flags(self, flags: list[torch.Tensor]) -> None:
        """Flags that any process has set."""
        everything = torch.cat(flags)
        self._reduce(everything, dist.ReduceOp.MAX)
        for own, of_all in zip(flags, everything.split([len(f) for f in flags]), strict=True):
            own.copy_(of_all)

    def _add_shared(self, values: wp.array, touched: wp.array, workers: Workers) -> None:
        """This process's share of the tiles of gradients in shared memory, for all processes."""
        of_all = [self._rows[array.ptr].reshape(self.count, -1) for array in (values, touched)]
        n_tiles, width = touched.shape[0], values.dtype._length_
        n_blocks = -(-n_tiles // BLOCK)
        workers.launch(
            add_tiles,
            -(-(n_blocks - self.rank) // self.count),
            self.rank,
            n_tiles,
            width,
            values.shape[0] * width,
            wp.array(of_all[0].view(np.float32), dtype=wp.float32, device="cpu", copy=False),
            wp.array(of_all[1], dtype=wp.uint8, device="cpu", copy=False),
        )

    def _add_values(
        self, tiled: list[Tiles], rows: list[torch.Tensor], shares: Sequence[Callable[[], None]]
    ) -> None:
        """Values of tiles that may hold any, and weights: rows of the threads, of which processes
        may have different numbers. Meanwhile, shares of what else there is are added."""
        pieces = [(len(t.chosen), t.tiles.shape[1]) for t in tiled]
        sizes = [n * width for n, width in pieces] + [len(t.rest) for t in tiled]
        sizes += [row.shape[1] for row in rows]
        room = self._room_for(sum(sizes), rows[0] if rows else tiled[0].rest)
        own, n = room[self.rank if len(room) > 1 else 0], len(tiled)
        parts = own.split(sizes)
        for t, piece, part, rest in zip(tiled, pieces, parts, parts[n:], strict=False):
            torch.index_select(t.tiles, 0, t.chosen, out=part.view(piece))
            rest.copy_(t.rest)
        for row, part in zip(rows, parts[2 * n :], strict=True):
            torch.sum(row, dim=0, out=part)
        self._sum(room, shares)
        parts = room[0].split(sizes)
        for t, piece, part, rest in zip(tiled, pieces, parts, parts[n:], strict=False):
            t.tiles.index_copy_(0, t.chosen, part.view(piece))
            t.rest.copy_(rest)
        for row, part in zip(rows, parts[2 * n :], strict=True):
            row.zero_()
            row[0] = part

    def _room_for(self, size: int, like: torch.Tensor) -> torch.Tensor:
        """[n, size] for messages, of which all have the same size: a row for each process where
        they share memory, else one."""
        if self._room is None or self._room.shape[1] < size:
            self._room, enough = None, size * 5 // 4
            shared = None if like.is_cuda else self._shared(4 * self.count * enough)
            if shared is None:
                self._room = like.new_empty((1, enough))
            else:
                self._room = torch.frombuffer(shared, dtype=like.dtype).view(self.count, enough)
        return self._room[:, :size]

    def _shared(self, n_bytes: int) -> mmap | None:
        """Memory that all processes have; None, in all of them, where one cannot reach it."""
        first = self.rank == 0
        with share(n_bytes) if first else nullcontext((None, None)) as (memory, place):
            places = [place]
            group = self._training if self._has_begun else self._saving
            with _lost():
                dist.broadcast_object_list(places, group=group)
            if not first:
                memory = opened(places[0], n_bytes)
            all_have = torch.tensor([memory is not None], dtype=torch.uint8)
            with _lost():
                dist.all_reduce(all_have, dist.ReduceOp.MIN, group)
        return memory if all_have else None

    def _sum(self, room: torch.Tensor, shares: Sequence[Callable[[], None]]) -> None:
        """The sum of all messages, into the first row; of rows, each process sums a share."""
        if len(room) == 1:
            self._reduce(room[0], dist.ReduceOp.SUM)
        else:
            shares = [partial(_add_rows, *room.tensor_split(self.count, dim=1)[self.rank]), *shares]
        if shares:
            self._in_shares(shares)

    def _in_shares(self, shares: Sequence[Callable[[], None]]) -> None:
        """Do this process's share of each, once all have written, and before any reads on."""
        self._meet()
        for add in shares:
            add()
        self._meet()

    def _meet(self) -> None:
        """Wait until all are here; what each has written before, all can read."""
        with _lost():
            if self._meeting is not None:
                self._meeting.wait(_patience())
            else:
                dist.barrier(self._training)

    def _reduce(self, tensor: torch.Tensor, operation: Any) -> None:
        with _lost():
            dist.all_reduce(tensor, operation, self._devices if tensor.is_cuda else self._training)


def _patience() -> float:
    """Seconds until a process that does not come to the end of its update counts as hung."""
    return PATIENCE.total_seconds()


class Tiles(NamedTuple):
    """The gradient of an array of entries, by tiles."""

    tiles: torch.Tensor
    """[n_tiles, numbers of a tile], those that are whole."""
    chosen: torch.Tensor
    """Which of them may hold any."""
    rest: torch.Tensor
    """What is no whole tile."""


def _add_rows(first: torch.Tensor, *others: torch.Tensor) -> None:
    for other in others:
        first += other


def _tiles(values: torch.Tensor, touched: torch.Tensor) -> Tiles:
    """Of values [n_entries, width]; a flag stands for the next tile, too."""
    flat, size = values.reshape(-1), TILE * values.shape[1]
    n_whole = len(flat) // size
    holds = touched.clone()
    holds[1:] |= touched[:-1]
    return Tiles(
        tiles=flat[: n_whole * size].view(n_whole, size),
        chosen=holds[:n_whole].nonzero()[:, 0],
        rest=flat[n_whole * size :],
    )


@contextmanager
def _lost() -> Iterator[None]:
    """What torch raises where a process has ended, or does not come."""
    try:
        yield
    except RuntimeError as error:
        raise PeerLostError("another process of this training has ended, or hangs.") from error
