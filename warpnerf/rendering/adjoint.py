"""Launches that end in a gradient (backpropagation), and the records on its way."""

from __future__ import annotations

import ctypes
from typing import Any

import warp as wp
from warpnerf_kernels.base.simd import LANES
from warpnerf_kernels.cpu import schedule
from warpnerf_kernels.launch import assembly

from warpnerf.runtime.parallel import LaunchCache, Workers

RECORDS = 1 << 29
"""Bytes of records that gradients of samples may be in at a time, of all workers together; and 4 MB
more for each worker. Only what is used takes memory, and most samples
leave no record. Rays that might have more take turns, at the end of which workers wait for each
other; signals wait for a turn."""

MAX_STEPS_ONE_WORKER = 1 << 24
"""Steps, in whole packs, that one worker makes at a time: signals wait for that, up to a second."""


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
            vectors = variant.parts.encoding.vectors
            record = vectors.record_bytes or ctypes.sizeof(vectors.Record.ctype)
            samples = RECORDS * LANES // record
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
            chunk.most_work = count * (room - most_work) if count > 1 else MAX_STEPS_ONE_WORKER
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
    chunk.candidates, chunk.rays = _room(n_workers, n_rays), _room(n_workers, n_rays)
    return chunk


def _make_sink(variant: assembly.Variant, n_packs: int, n_workers: int) -> Any:
    """No records, with room for those of so many packs of each worker."""
    row = -(-n_workers // 16) * 16  # whole cache lines
    made = assembly.sink_type(variant)()
    made.records = _room(n_workers, n_packs, dtype=variant.parts.encoding.vectors.Record)
    made.n_records = _room(n_workers, row)
    made.recipients = _room(n_workers, n_workers, n_packs)
    made.n_recipients = _room(n_workers, row)
    return made
