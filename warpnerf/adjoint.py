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

SAMPLES = 1 << 19
"""Samples whose gradients may be in parcels at a time, of all workers together: 34 MB at most. Rays
that might have more take turns, so memory grows with neither rays nor samples."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradient of a loss with respect to a grid's values."""

    values: wp.array
    """[X * Y * Z] vec4; zero in tiles that are not flagged."""
    touched: wp.array
    """[n_tiles] uint8, 1 where a tile has a gradient; see warpnerf_kernels.tiles."""

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
        self._size = size
        self._workers = workers
        self._rays = max(1, n_rays)
        self._packed = variant.packed
        if self._packed:
            samples = max(most_steps, SAMPLES // workers.count)  # of each worker
            rays = samples // most_steps * workers.count
            self._rays = -(-self._rays // -(-self._rays // rays))  # alike from turn to turn
            self._parcels = _make_parcels(samples if workers.count > 1 else 0, workers.count)
        elif not workers.device.is_cuda:
            self._workers = Workers("cpu", 1)

    def scratch(self) -> list[wp.array]:
        """The arrays that it has allocated."""
        if not self._packed:
            return []
        made = self._parcels
        return [made.contents, made.next, made.first, made.end, made.used]

    def run(self, n_rays: int, gradient: Any, *arguments: Any) -> None:
        """Add a batch's gradient.

        Args:
            n_rays: Rays of the batch.
            gradient: A kernel's Gradient, in the kernel's precision.
            arguments: The kernel's, without the first two and the last.
        """
        if not self._packed:
            self._workers.launch_owned(self._kernel, n_rays, *arguments, gradient)
            return
        count = self._workers.count
        self._parcels.gradient = gradient
        for begin in range(0, n_rays, self._rays):
            end = min(begin + self._rays, n_rays)
            self._parcels.used.zero_()
            self._workers.launch_owned(self._kernel, end, *arguments, self._parcels, begin=begin)
            if count > 1:
                size = wp.vec3i(*self._size)
                self._workers.launch(parcels.deliver, count, size, self._parcels)


def _make_parcels(n_samples: int, n_workers: int) -> parcels.Parcels:
    """No parcels, with room for those of so many samples of each worker."""
    # A sample goes to two others at most, and each of these may have begun a block.
    line = -(-n_workers // 16) * 16  # a worker's row shares no cache line with another's
    n_blocks = n_workers + -(-2 * n_samples // parcels.BLOCK)

    def room(n: int, dtype: Any = wp.int32) -> wp.array:
        return wp.empty((n_workers, n), dtype=dtype, device="cpu")

    made = parcels.Parcels()
    made.contents = room(n_blocks * parcels.BLOCK, parcels.Parcel)  # no memory until it is used
    made.next = room(n_blocks)
    made.first = room(line)
    made.end = room(line)
    made.end.zero_()
    made.used = room(line)
    return made
