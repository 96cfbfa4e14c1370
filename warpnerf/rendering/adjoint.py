"""Launches that hand gradients back to a grid: where these are kept, and the way they take."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import tiles, types
from warpnerf_kernels.base.simd import LANES
from warpnerf_kernels.base.types import real
from warpnerf_kernels.cpu import schedule
from warpnerf_kernels.launch import assembly

from warpnerf.model.interface import Model, n_weights
from warpnerf.runtime.parallel import LaunchCache, Workers

SAMPLES = 1 << 24
"""Steps, in whole packs, whose gradients may be in records at a time where nodes hold four numbers,
of all workers together: room for 540 MB, or up to 720 where values lie sample by sample, and 4 MB
more for each worker. Only what is used takes memory, and most samples leave no record. Where nodes
hold more, so do records, and there are as many fewer. Rays that might have more take turns, at the
end of which workers wait for each other; signals wait for a turn."""

ALONE = 1 << 24
"""Steps, in whole packs, that one worker makes at a time: signals wait for that, up to a second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradient of a loss with respect to what a model has learned; a kernel's Gradient."""

    values: wp.array
    """[n_nodes] vectors; zero in tiles that are not flagged, nor the one before them."""
    touched: wp.array
    """[n_tiles] uint8, 1 where a pair of nodes begins that got some; see base.tiles."""
    weights: wp.array
    """[n_workers, n_weights or more] of each worker's rays."""
    launches: LaunchCache = field(default_factory=LaunchCache)
    """The optimiser's launches that take it."""

    @staticmethod
    def zeros(model: Model, n_nodes: int, workers: Workers) -> Gradients:
        """No gradient yet."""
        device, node = workers.device, types.vector(model.n_floats)
        if device.is_cuda:
            values = wp.zeros(n_nodes, dtype=node, device=device)
        else:  # pages that take no memory until a gradient is added to them
            n = n_nodes * model.n_floats
            room = np.zeros(n + LANES, np.float32)
            begin = -room.ctypes.data // 4 % LANES  # of a cache line: nodes lie in as few as can be
            zeros = room[begin : begin + n].reshape(n_nodes, model.n_floats)
            values = wp.array(zeros, dtype=node, device=device, copy=False)
        row = -(-n_weights(model) // LANES) * LANES  # whole cache lines
        return Gradients(
            values=values,
            touched=wp.zeros(n_tiles(n_nodes), dtype=wp.uint8, device=device),
            weights=wp.zeros((workers.count, row), dtype=real, device=device),
        )

    @cached_property
    def struct(self) -> Any:
        """The gradient as kernels take it."""
        return gradient_struct(types, self.values, self.touched, self.weights)


def n_tiles(n_nodes: int) -> int:
    """Tiles of so many nodes."""
    return -(-n_nodes // tiles.TILE)


def gradient_struct(
    types: ModuleType, values: wp.array, touched: wp.array, weights: wp.array
) -> Any:
    """A kernel's Gradient, in the precision of the given ``warpnerf_kernels.base.types``."""
    gradient = types.gradient_type(values.dtype._length_)()
    gradient.values = values
    gradient.touched = touched
    gradient.weights = weights
    return gradient


class AdjointLaunch:
    """A kernel that ends in a gradient, for batches of rays.

    On the CPU packed kernels leave part of it in records, and deliver these once all rays are
    through. Plain ones add to it directly: atomically on CUDA, and on one thread of the CPU.
    """

    def __init__(
        self,
        kernel: wp.Kernel,
        variant: assembly.Variant,
        most_steps: int,
        n_rays: int,
        workers: Workers,
    ) -> None:
        """Allocate what is needed.

        Args:
            kernel: From ``render_train_kernel`` or ``render_backward_kernel``.
            variant: The one it was made for.
            most_steps: Of a ray; see ``Steps.most``.
            n_rays: In a batch, at most.
            workers: Where to work.
        """
        self._kernel = kernel
        self._workers = workers
        self._launches = LaunchCache()
        self.sink: Any = None
        """What the workers leave for each other; None: kernels are scalar."""
        if variant.packed:
            encoding = variant.parts.encoding
            samples = SAMPLES * 32 // (16 + 4 * encoding.n_floats)
            most_work = most_steps + LANES + schedule.RAY
            # Where rays are so long that two for each worker would not fit, fewer work.
            count = min(workers.count, max(1, samples // (2 * most_work)))
            if count < workers.count:
                self._workers = Workers("cpu", count)
            room = samples // count if count > 1 else 0
            self.sink = _make_sink(variant, room // LANES, count)
            chunk = _make_chunk(n_rays, count)
            chunk.barrier = self._workers.barrier
            # One worker leaves no records. Of several, each may get a ray more than its share.
            chunk.most_work = count * (room - most_work) if count > 1 else ALONE
            self.sink.chunk = chunk
        elif not workers.device.is_cuda:
            self._workers = Workers("cpu", 1)

    @property
    def workers(self) -> Workers:
        """Those that are launched: on the CPU scalar kernels have one."""
        return self._workers

    def run(self, n_rays: int, gradient: Any, *arguments: Any) -> None:
        """Add a batch's gradient.

        Args:
            n_rays: Rays of the batch, no more than there is room for.
            gradient: A kernel's Gradient, in the kernel's precision.
            arguments: The kernel's, without the first two and the last.
        """
        if self.sink is None:
            self._workers.launch_owned(self._kernel, n_rays, *arguments, gradient)
            return
        self.sink.gradient = gradient
        chunk = self.sink.chunk
        chunk.begin, chunk.end = 0, n_rays
        while chunk.begin < n_rays:
            self._workers.launch_owned(
                self._kernel, self._workers.count, *arguments, self.sink, cache=self._launches
            )
            chunk.begin = int(chunk.next.numpy()[0])


def _room(*shape: int, dtype: Any = wp.int32) -> wp.array:
    return wp.empty(shape, dtype=dtype, device="cpu")  # no memory until it is used


def _make_chunk(n_rays: int, n_workers: int) -> schedule.Chunk:
    """With room for batches of so many rays."""
    chunk = schedule.Chunk()
    chunk.work, chunk.cells, chunk.next = _room(n_rays), _room(n_rays), _room(1)
    chunk.work_before = _room(n_workers, schedule.ACROSS, dtype=wp.int64)
    chunk.rays_before = _room(n_workers, schedule.CELLS)
    chunk.drawn, chunk.rays = _room(n_workers, n_rays), _room(n_workers, n_rays)
    return chunk


def _make_sink(variant: assembly.Variant, n_packs: int, n_workers: int) -> Any:
    """No records, with room for those of so many packs of each worker."""
    row = -(-n_workers // 16) * 16  # whole cache lines
    made = assembly.sink_type(variant)()
    made.records = _room(n_workers, n_packs, dtype=variant.parts.encoding.vectors.Record)
    made.n_records = _room(n_workers, row)
    made.addressed = _room(n_workers, n_workers, n_packs)
    made.n_addressed = _room(n_workers, row)
    return made
