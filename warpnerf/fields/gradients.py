"""Gradient accumulation: the gradient of a loss by what a field has learned, on its device."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import tiles, types
from warpnerf_kernels.base.simd import LANES
from warpnerf_kernels.base.types import real

from warpnerf.model.interface import Model, n_weights
from warpnerf.runtime.memory import prefer_large_pages, zero_bytes
from warpnerf.runtime.parallel import LaunchCache, Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """Gradients that batches have accumulated since the last update."""

    arrays: dict[str, wp.array]
    """Of the fields of the encoding's ``Gradient``, all zero at first. ``weights`` are those of the
    head, [n_workers, n_weights or more] of each worker's rays."""
    struct: Any
    """The same as kernels take it."""
    launches: LaunchCache = field(default_factory=LaunchCache)
    """The optimiser's launches that take it."""
    _entries: dict[tuple[str, str], Any] = field(default_factory=dict)

    @staticmethod
    def of(Gradient: type, arrays: dict[str, wp.array]) -> Gradients:
        """Those of an encoding's ``Gradient``."""
        struct = Gradient()
        for name, array in arrays.items():
            setattr(struct, name, array)
        return Gradients(arrays=arrays, struct=struct)

    @property
    def values(self) -> wp.array:
        """[n_entries] vectors; zero in tiles that are not flagged, nor the one before them."""
        return self.arrays["values"]

    @property
    def touched(self) -> wp.array:
        """[n_tiles] uint8, 1 where a pair of entries begins that got some; see base.tiles."""
        return self.arrays["touched"]

    @property
    def weights(self) -> wp.array:
        """[n_workers, n_weights or more] of the head, of each worker's rays."""
        return self.arrays["weights"]

    def entries(self, values: str, touched: str) -> Any:
        """An array of entries and its flags as kernels take them that know no other array.

        Args:
            values: Its name.
            touched: The name of the flags of its tiles.
        """
        names = values, touched
        if names not in self._entries:
            arrays = self.arrays[values], self.arrays[touched], self.arrays["weights"]
            self._entries[names] = gradient_struct(types, *arrays)
        return self._entries[names]


def zero_entries(
    n: int, dtype: Any, workers: Workers, large_pages: bool = False
) -> dict[str, wp.array]:
    """No gradient yet of an array of entries: ``values`` and ``touched``.

    Args:
        n: Entries.
        dtype: Vector type of an entry.
        workers: Where they lie.
        large_pages: Whether, on the CPU, pages of 2 MB suit it: where all of it gets some, from
            samples all over the place.
    """
    device = workers.device
    if device.is_cuda:
        values = wp.zeros(n, dtype=dtype, device=device)
        touched = wp.zeros(n_tiles(n), dtype=wp.uint8, device=device)
    else:  # pages that take no memory until a gradient is added to them
        width = dtype._length_
        n_bytes = 4 * (n * width + LANES)
        zeros_of = zero_bytes if large_pages else workers.zeros
        room = zeros_of(n_bytes).view(np.float32)
        if large_pages:
            prefer_large_pages(room.ctypes.data, room.nbytes)
        begin = -room.ctypes.data // 4 % LANES  # of a cache line: entries lie in as few as can be
        zeros = room[begin : begin + n * width].reshape(n, width)
        values = wp.array(zeros, dtype=dtype, device=device, copy=False)
        touched = wp.array(zeros_of(n_tiles(n)), dtype=wp.uint8, device=device, copy=False)
    return {"values": values, "touched": touched}


def zero_weights(n: int, workers: Workers, dtype: Any = real) -> wp.array:
    """No gradient yet of shared weights: a row for each worker, of whole cache lines."""
    row = -(-n // LANES) * LANES
    return wp.zeros((workers.count, row), dtype=dtype, device=workers.device)


def zero_head_weights(model: Model, workers: Workers) -> dict[str, wp.array]:
    """No gradient yet of a head's weights."""
    return {"weights": zero_weights(n_weights(model), workers)}


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
