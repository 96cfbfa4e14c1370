"""Processes that torchrun has started, as the peers of a training: by torch.distributed."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any, TypeVar

import torch
import torch.distributed as dist
import warp as wp
from warpnerf_kernels.base.tiles import TILE

from warpnerf.checks import InputError
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.parameters import Parameter
from warpnerf.training.peers import PeerLostError, Peers, Signals

PATIENCE = timedelta(seconds=45)
"""For a process that does not come to the end of its update: then it hangs."""
MEETING = timedelta(minutes=5)
"""For the others to start."""
SET_UP = timedelta(hours=24)
"""For one that sets up: it may estimate poses, or compile."""
SAVING = timedelta(minutes=10)
"""For the first one while it saves a checkpoint, or reports."""

T = TypeVar("T")


class Processes(Peers):
    """The processes of this training, by gloo between CPUs and by NCCL between CUDA devices."""

    def __init__(self) -> None:
        """Meet the others, which torchrun's variables name.

        Raises:
            InputError: They cannot be met.
        """
        try:
            self._store, self.rank, self.count = next(dist.rendezvous("env://", timeout=MEETING))
            dist.init_process_group(
                "gloo",
                store=dist.PrefixStore("gloo", self._store),
                rank=self.rank,
                world_size=self.count,
                timeout=SET_UP,
            )
            self._training = dist.new_group(timeout=PATIENCE)
            self._saving = dist.new_group(timeout=SAVING)
            self._devices = None
            if torch.cuda.is_available():
                self._devices = dist.new_group(backend="nccl", timeout=PATIENCE)
        except (RuntimeError, ValueError) as error:
            why = str(error).strip().partition("\n")[0][:200].rstrip(".")
            raise InputError(
                f"process {os.environ.get('RANK')} does not meet the others ({why}); start all "
                "of them by torchrun."
            ) from error

    def is_first_to_fail(self) -> bool:
        """Whether no process has called this before: of one error, one tells."""
        return int(self._store.add("failed", 1)) == 1

    def from_first(self, make: Callable[[], T]) -> T:
        """By a broadcast; the others wait for as long as it takes."""
        found = [make() if self.rank == 0 else None]
        with _lost():
            dist.broadcast_object_list(found)
        return found[0]  # type: ignore[return-value]

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
        with _lost():
            dist.all_reduce(torch.zeros(1), group=self._saving)

    def agree(self, signals: Signals) -> Signals:
        """The seconds of the first process; one that stops, or the first that saves, is enough."""
        first = self.rank == 0
        mine = (signals.seconds if first else 0.0, signals.stop, first and signals.save)
        all_of = torch.tensor([float(value) for value in mine], dtype=torch.float64)
        self._reduce(all_of, dist.ReduceOp.MAX)
        seconds, stop, save = all_of.tolist()
        return Signals(seconds=seconds, stop=bool(stop), save=bool(save))

    def add(self, gradients: Gradients, parameters: Sequence[Parameter]) -> None:
        """Sums of touched tiles and of weights; the order of summands depends on ranks alone."""
        for parameter in parameters:
            arrays = [gradients.arrays[name] for name in parameter.gradient]
            cuda = arrays[0].device.is_cuda
            if cuda:
                wp.synchronize_device(arrays[0].device)
            tensors = [wp.to_torch(array, requires_grad=False) for array in arrays]
            if len(tensors) == 2:
                self._add_tiles(*tensors)
            else:
                self._add_rows(tensors[0])
            if cuda:
                torch.cuda.synchronize()

    def _add_tiles(self, values: torch.Tensor, touched: torch.Tensor) -> None:
        """Values [n_entries, width] of tiles that any process has flagged, and the next ones."""
        self._reduce(touched, dist.ReduceOp.MAX)
        holds = touched.bool()
        holds[1:] |= touched[:-1].bool()
        flat = values.reshape(-1)
        tile = TILE * values.shape[1]
        n_whole = len(flat) // tile
        tiles, rest = flat[: n_whole * tile].view(n_whole, tile), flat[n_whole * tile :]
        chosen = holds[:n_whole].nonzero()[:, 0]
        sums = torch.cat([tiles[chosen].reshape(-1), rest])
        self._reduce(sums, dist.ReduceOp.SUM)
        tiles[chosen] = sums[: len(chosen) * tile].view(-1, tile)
        rest.copy_(sums[len(chosen) * tile :])

    def _add_rows(self, rows: torch.Tensor) -> None:
        """Rows of the threads, of which processes may have different numbers."""
        sums = rows.sum(dim=0)
        self._reduce(sums, dist.ReduceOp.SUM)
        rows.zero_()
        rows[0] = sums

    def _reduce(self, tensor: torch.Tensor, operation: Any) -> None:
        with _lost():
            dist.all_reduce(tensor, operation, self._devices if tensor.is_cuda else self._training)


@contextmanager
def _lost() -> Iterator[None]:
    """What torch raises where a process has ended, or does not come."""
    try:
        yield
    except RuntimeError as error:
        raise PeerLostError("another process of this training has ended, or hangs.") from error
