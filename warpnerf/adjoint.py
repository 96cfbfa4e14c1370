"""Launches that hand gradients back to a grid: where these are kept, and the way they take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels import parcels, render, tiles, types
from warpnerf_kernels.types import vec4

from warpnerf.parallel import Workers

SAMPLES = 1 << 21
"""Samples whose gradients may be in parcels at a time, of all workers together: room for 67 MB with
two workers, for 134 MB with more, of which only what is used takes memory: a few MB. Rays that
might have more samples take turns, so memory grows with neither rays nor samples."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradient of a loss with respect to a grid's values, all of them; a kernel's Gradient."""

    values: wp.array
    """[X * Y * Z] vec4; zero in tiles that are not flagged, nor the one before them."""
    touched: wp.array
    """[n_tiles] uint8, 1 where a pair of nodes begins that got some; see warpnerf_kernels.tiles."""

    @staticmethod
    def zeros(size: tuple[int, int, int], workers: Workers) -> Gradients:
        """No gradient yet."""
        n_nodes = math.prod(size)
        if workers.device.is_cuda:
            values = wp.zeros(n_nodes, dtype=vec4, device=workers.device)
        else:  # pages that take no memory until a gradient is added to them
            zeros = np.zeros((n_nodes, 4), np.float32)
            values = wp.array(zeros, dtype=vec4, device=workers.device, copy=False)
        return Gradients(
            values=values,
            touched=wp.zeros(n_tiles(size), dtype=wp.uint8, device=workers.device),
        )

    def struct(self) -> types.Gradient:
        """The gradient as kernels take it."""
        return gradient_struct(types, self.values, self.touched)


def n_tiles(size: tuple[int, int, int]) -> int:
    """Tiles of a grid of X x Y x Z nodes."""
    return -(-math.prod(size) // tiles.TILE)


def gradient_struct(types: ModuleType, values: wp.array, touched: wp.array) -> Any:
    """A kernel's Gradient, in the precision of the given ``warpnerf_kernels.types``."""
    gradient = types.Gradient()
    gradient.values = values
    gradient.touched = touched
    return gradient


class AdjointLaunch:
    """One of render.py's kernels that end in a gradient, for batches of rays.

    On the CPU packed kernels leave part of it in parcels, which are delivered after. Plain ones add
    to it directly: atomically on CUDA, and on one thread of the CPU.
    """

    def __init__(
        self,
        kernel: wp.Kernel,
        variant: render.Variant,
        size: tuple[int, int, int],
        most_steps: int,
        n_rays: int,
        workers: Workers,
    ) -> None:
        """Allocate what is needed.

        Args:
            kernel: From ``render_train_kernel`` or ``render_backward_kernel``.
            variant: The one it was made for.
            size: Of the grid, X, Y, Z.
            most_steps: Of a ray; see ``Steps.most``.
            n_rays: In a batch, at most.
            workers: Where to work.
        """
        self._kernel = kernel
        self._contraction = variant.contraction
        self._size = size
        self._workers = workers
        self.rays_a_turn = max(1, n_rays)
        """As many go into one launch."""
        self.parcels: parcels.Parcels | None = None
        """What the workers leave for each other; None: kernels are plain."""
        if variant.packed:
            # Where rays are so long that those of one for each worker would not fit, fewer work.
            count = min(workers.count, max(1, SAMPLES // most_steps))
            if count < workers.count:
                self._workers = Workers("cpu", count)
            if count > 1:
                turns = math.ceil(n_rays / (SAMPLES // count // most_steps * count))
                self.rays_a_turn = math.ceil(n_rays / max(1, turns)) or 1  # all turns alike
            self.parcels = _make_parcels(SAMPLES // count if count > 1 else 0, count)
            self._middles = wp.empty(n_rays, dtype=wp.uint16, device="cpu")
            self.order = wp.array(np.arange(n_rays), dtype=wp.int32, device="cpu")
            """[n_rays] which ray is whose: all of the first worker's, all of the second's, ..."""
            self.parcels.order = self.order
        elif not workers.device.is_cuda:
            self._workers = Workers("cpu", 1)

    def run(self, n_rays: int, gradient: Any, *arguments: Any) -> None:
        """Add a batch's gradient.

        Args:
            n_rays: Rays of the batch.
            gradient: A kernel's Gradient, in the kernel's precision.
            arguments: The kernel's, without the first two and the last.
        """
        if self.parcels is None:
            self._workers.launch_owned(self._kernel, n_rays, *arguments, gradient)
            return
        count = self._workers.count
        self.parcels.gradient = gradient
        if count > 1:
            grid, _, march, origins, directions = arguments[:5]
            self._workers.launch(
                parcels.find_middles_kernel(self._contraction),
                n_rays,
                grid,
                march,
                origins,
                directions,
                self._middles,
            )
        for begin in range(0, n_rays, self.rays_a_turn):
            end = min(begin + self.rays_a_turn, n_rays)
            if count > 1:
                self._share_out(begin, end)
            self.parcels.used.zero_()
            self.parcels.end.zero_()  # in case that the last turn was interrupted
            self._workers.launch_owned(self._kernel, end, *arguments, self.parcels, begin=begin)
            if count > 1:
                size = wp.vec3i(*self._size)
                self._workers.launch(parcels.deliver_parcels, count, size, self.parcels)

    def _share_out(self, begin: int, end: int) -> None:
        """Give each worker the rays whose middles lie nearest its part; their order stays."""
        n = end - begin
        along_x = np.argsort(self._middles.numpy()[begin:end], kind="stable")
        worker = np.empty(n, np.uint16)
        worker[along_x] = (np.arange(1, n + 1) * self._workers.count - 1) // n  # as launches do
        self.order.numpy()[begin:end] = begin + np.argsort(worker, kind="stable")


def _make_parcels(n_samples: int, n_workers: int) -> parcels.Parcels:
    """No parcels, with room for those of so many samples of each worker."""
    row = -(-n_workers // 16) * 16  # whole cache lines, which no two workers share
    # A sample goes to two others at most, and each of these may have begun a block.
    n_blocks = n_workers + -(-min(2, n_workers - 1) * n_samples // parcels.BLOCK)

    def room(n: int, dtype: Any = wp.int32) -> wp.array:
        return wp.empty((n_workers, n), dtype=dtype, device="cpu")

    made = parcels.Parcels()
    made.contents = room(n_blocks * parcels.BLOCK, parcels.Parcel)  # no memory until it is used
    made.next = room(n_blocks)
    made.first_block = room(row)
    made.end = room(row)
    made.end.zero_()
    made.used = room(row)
    return made
