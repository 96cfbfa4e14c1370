"""Occupancy grid: which cells of a field's lattice hold nothing that could be seen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import types
from warpnerf_kernels.base.parts import Sampler
from warpnerf_kernels.base.types import FreeSpace
from warpnerf_kernels.sampling import occupancy
from warpnerf_kernels.sampling.steps import STEPS

from warpnerf.fields.lattice import Lattice
from warpnerf.fields.storage import Storage
from warpnerf.model.spaces import part_of
from warpnerf.runtime.parallel import NODES, Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeCells:
    """The occupancy grid: which cells hold nothing visible; distances to the nearest that does."""

    distance: wp.array
    """[MX * MY * MZ] uint8, cells to the nearest occupied one; 0 there."""
    size: tuple[int, int, int]
    """MX, MY, MZ."""
    border: float
    """That of the lattice; with a single cell, not used."""

    @staticmethod
    def none(workers: Workers) -> FreeCells:
        """All space is occupied."""
        return FreeCells(
            distance=wp.zeros(1, dtype=wp.uint8, device=workers.device),
            size=(1, 1, 1),
            border=0.0,
        )

    @staticmethod
    def of(
        storage: Storage,
        workers: Workers,
        march: Any,
        alpha_min: float,
        sampler: Sampler = STEPS,
        margin: int = 1,
    ) -> FreeCells:
        """Compute the occupancy grid of a field.

        Args:
            storage: What it is stored in.
            workers: Where to work.
            march: The sampler's parameters: opacity is judged over the longest step there can be.
            alpha_min: The least opacity that counts as visible, of what nodes bound.
            sampler: Where steps lie.
            margin: How many nodes around a cell count as well, along each axis.
        """
        lattice, size = storage.lattice, storage.lattice.cells
        highest = storage.highest_densities(workers, margin)
        n, cells = math.prod(size), wp.vec3i(*size)
        distance = wp.empty(n, dtype=wp.uint8, device=workers.device)
        span = 1 if workers.device.is_cuda else size[2]  # a core takes a row
        workers.launch(
            occupancy.mark_occupied_kernel(sampler, part_of(lattice.contraction, "float32")),
            n // span,
            span,
            lattice.box,
            storage.density,
            highest,
            cells,
            march,
            storage.kind.seen_share * alpha_min,
            distance,
            at_once=max(1, NODES // span),
        )
        return FreeCells._around(distance, size, lattice.border, workers)

    @staticmethod
    def _around(
        distance: wp.array, size: tuple[int, int, int], border: float, workers: Workers
    ) -> FreeCells:
        """From which cells are occupied, 0 there and the farthest distance elsewhere."""
        span = 1 if workers.device.is_cuda else size[2]  # a core takes a row
        n, spread = math.prod(size), wp.empty_like(distance)
        for axis in range(3):
            workers.launch(
                occupancy.spread_distance,
                n // span,
                *(span, distance, wp.vec3i(*size), axis, spread),
                at_once=max(1, NODES // span),
            )
            distance, spread = spread, distance
        return FreeCells(distance=distance, size=size, border=border)

    def cropped(self, lattice: Lattice, inside: np.ndarray, workers: Workers) -> FreeCells:
        """The same, and free is what is not inside; no array of this one changes.

        Args:
            lattice: That these cells belong to.
            inside: [MX, MY, MZ] bool, as of ``fields.nodes.cells_within``.
            workers: Where to work.
        """
        size = lattice.cells
        occupied = self.distance.numpy() == 0
        occupied = np.ones(size, bool) if self.size != size else occupied.reshape(size)
        occupied = occupied & inside
        distance = np.where(occupied, 0, int(occupancy.FAR) + 1).astype(np.uint8)
        there = wp.array(distance.ravel(), dtype=wp.uint8, device=workers.device)
        return FreeCells._around(there, size, lattice.border, workers)

    @cached_property
    def struct(self) -> FreeSpace:
        """Free space as kernels take it."""
        return free_struct(types, self.distance, self.size, self.border)

    def share(self) -> float:
        """The share of cells that are occupied, [0, 1]."""
        return float(np.mean(self.distance.numpy() == 0))

    def occupied_range(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lowest and highest corner of the occupied cells, each [3] as shares of the domain."""
        occupied = np.argwhere(self.distance.numpy().reshape(self.size) == 0)
        if not len(occupied):
            return None
        size = np.array(self.size)
        return occupied.min(0) / size, (occupied.max(0) + 1) / size


def free_struct(
    types: ModuleType, distance: wp.array, size: tuple[int, int, int], border: float
) -> Any:
    """A kernel's FreeSpace over a grid with this border, in the precision of ``types``."""
    free = types.FreeSpace()
    free.distance = distance
    free.size = wp.vec3i(*size)
    free.to_cells = types.vec3(*(0.5 * np.array(size) / (1.0 + border)))
    return free
