"""Storages whose entries a learned matrix decodes to the numbers of a sample."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import warp as wp
from warpnerf_kernels.base.types import real
from warpnerf_kernels.fields.decoder import columns_of, padded

from warpnerf.fields.gradients import zero_weights
from warpnerf.fields.storage import ReadAtNodes
from warpnerf.model.interface import Load, loader
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class Decoded(ReadAtNodes):
    """Entries, and a decoder; see fields.decoder of the kernels."""

    n_floats: int
    """Numbers of a sample."""
    n_decoded: int
    """How many of these are not padding."""
    by_sample: bool
    """Whether the head works on samples."""
    decoder: wp.array
    """[n_inputs * columns] row by row."""

    @property
    def n_columns(self) -> int:
        """Columns of the decoder."""
        return columns_of(self.n_floats)

    @property
    def n_transposed(self) -> int:
        """Numbers of the decoder as the vector form lays it out: transposed, inputs padded."""
        return self.n_decoded * padded(self.decoder.size // self.n_columns)

    @cached_property
    def struct(self) -> Any:
        """Its arrays as kernels take them."""
        struct = self.own_struct(loader("float32"))
        struct.transposed = wp.zeros((0, 0), dtype=real, device=self.decoder.device)
        return struct

    def struct_in(self, load: Load, workers: Workers) -> Any:
        """The same, and a transposed decoder of each worker."""
        struct = self.own_struct(load)
        struct.transposed = zero_weights(self.n_transposed, workers, load("base.types").real)
        return struct

    @abstractmethod
    def own_struct(self, load: Load) -> Any:
        """Its arrays as kernels take them, without the transposed decoder.

        Args:
            load: The kernels' modules, in the precision of the arrays.
        """
