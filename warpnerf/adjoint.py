"""Launches that hand gradients back to a grid: where these are kept, and the way they take."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels import order, parcels, render, tiles, types
from warpnerf_kernels.types import vec4
from warpnerf_kernels.vectors import LANES

from warpnerf.parallel import Packed, Workers

SAMPLES = 1 << 21
"""Steps, in whole packs, whose gradients may be in parcels at a time, of all workers together: room
for 68 MB, and half a megabyte more for each worker, of which what is used takes memory. Rays that
might have more take turns, so parcels grow with neither rays nor samples."""

ALONE = 1 << 24
"""Steps, in whole packs, that one worker makes at a time: signals wait for that, up to a second."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradient of a loss with respect to a grid's values, all of them; a kernel's Gradient."""

    values: wp.array
    """[X * Y * Z] vec4; zero in tiles that are not flagged, nor the one before them."""
    touched: wp.array
    """[n_tiles] uint8, 1 where a pair of nodes begins that got some; see warpnerf_kernels.tiles."""
    packed: Packed = field(default_factory=Packed)
    """The optimiser's launches that take it."""

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

    @cached_property
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

    On the CPU packed kernels leave part of it in parcels, and deliver these once all rays are
    through. Plain ones add to it directly: atomically on CUDA, and on one thread of the CPU.
    """

    def __init__(
        self,
        kernel: wp.Kernel,
        variant: render.Variant,
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
        self._packed = Packed()
        self.parcels: parcels.Parcels | None = None
        """What the workers leave for each other; None: kernels are plain."""
        if variant.packed:
            most_work = most_steps + LANES + order.RAY
            # Where rays are so long that two for each worker would not fit, fewer work.
            count = min(workers.count, max(1, SAMPLES // (2 * most_work)))
            if count < workers.count:
                self._workers = Workers("cpu", count)
            room = SAMPLES // count if count > 1 else 0
            self.parcels = _make_parcels(room // LANES, count)
            turn = _make_turn(n_rays, count)
            turn.meeting = self._workers.meeting
            # One worker leaves no parcels. Of several, each may get a ray more than its share.
            turn.most_work = count * (room - most_work) if count > 1 else ALONE
            self.parcels.turn = turn
        elif not workers.device.is_cuda:
            self._workers = Workers("cpu", 1)

    def run(self, n_rays: int, gradient: Any, *arguments: Any) -> None:
        """Add a batch's gradient.

        Args:
            n_rays: Rays of the batch, no more than there is room for.
            gradient: A kernel's Gradient, in the kernel's precision.
            arguments: The kernel's, without the first two and the last: a grid, its free space,
                how to march, origins, directions, and what else it takes.
        """
        if self.parcels is None:
            self._workers.launch_owned(self._kernel, n_rays, *arguments, gradient)
            return
        self.parcels.gradient = gradient
        turn = self.parcels.turn
        turn.begin, turn.end = 0, n_rays
        while turn.begin < n_rays:
            self._workers.launch_owned(
                self._kernel, self._workers.count, *arguments, self.parcels, packed=self._packed
            )
            turn.begin = int(turn.next.numpy()[0])


def _room(*shape: int, dtype: Any = wp.int32) -> wp.array:
    return wp.empty(shape, dtype=dtype, device="cpu")  # no memory until it is used


def _make_turn(n_rays: int, n_workers: int) -> order.Turn:
    """With room for batches of so many rays."""
    turn = order.Turn()
    turn.work, turn.cells, turn.next = _room(n_rays), _room(n_rays), _room(1)
    turn.work_before = _room(n_workers, order.ACROSS, dtype=wp.int64)
    turn.rays_before = _room(n_workers, order.CELLS)
    turn.drawn, turn.rays = _room(n_workers, n_rays), _room(n_workers, n_rays)
    return turn


def _make_parcels(n_packs: int, n_workers: int) -> parcels.Parcels:
    """No parcels, with room for those of so many packs of each worker."""
    row = -(-n_workers // 16) * 16  # whole cache lines
    made = parcels.Parcels()
    made.contents = _room(n_workers, n_packs, dtype=parcels.Parcel)
    made.n_contents = _room(n_workers, row)
    made.addressed = _room(n_workers, n_workers, n_packs)
    made.n_addressed = _room(n_workers, row)
    return made
