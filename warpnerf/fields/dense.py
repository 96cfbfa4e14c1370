"""Dense voxel grid: a value at each node of the lattice, trilinear interpolation in between."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, Self

import numpy as np
import warp as wp
from warpnerf_kernels.base.parts import Encoding
from warpnerf_kernels.base.types import vec3, vector
from warpnerf_kernels.fields import dense, dense_bound
from warpnerf_kernels.optim import adam, total_variation

from warpnerf.fields.gradients import Gradients, zero_entries, zero_head_weights
from warpnerf.fields.lattice import Lattice, grid_struct
from warpnerf.fields.near_decay import near_decay
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import (
    Regulariser,
    Storage,
    TrainedOn,
    allocate_nodes,
)
from warpnerf.fields.total_variation import TotalVariation, tv_weights
from warpnerf.model.interface import Load, Model
from warpnerf.model.storage_kinds import DENSE, StorageKind
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class DenseGrid(Storage):
    """A dense voxel grid [X, Y, Z] of raw values, z fastest, nodes on the box's faces."""

    kind: StorageKind = DENSE
    values: wp.array
    """[X * Y * Z] vectors: raw density, raw features, padding to a power of two."""

    @classmethod
    def first(
        cls, kind: StorageKind, model: Model, lattice: Lattice, seed: int, device: wp.Device
    ) -> DenseGrid:
        """All raw values 0."""
        values = allocate_nodes(math.prod(lattice.size), vector(model.n_floats), device)
        values.zero_()
        return cls(lattice=lattice, values=values)

    @classmethod
    def shapes(
        cls, kind: StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, tuple[int, ...]]:
        """[X, Y, Z, n_floats] values."""
        return {"values": (*lattice.size, model.n_floats)}

    @classmethod
    def over(
        cls, kind: StorageKind, model: Model, lattice: Lattice, arrays: Mapping[str, wp.array]
    ) -> Self:
        """Of values."""
        return cls(lattice=lattice, values=arrays["values"])

    def tensors(self) -> dict[str, np.ndarray]:
        """Its values, [X, Y, Z, n_floats]."""
        return {"values": self.values.numpy().reshape(*self.lattice.size, self.n_floats)}

    def copied_to(self, device: wp.Device) -> DenseGrid:
        """The same with values of its own."""
        values = allocate_nodes(self.values.shape[0], self.values.dtype, device)
        wp.copy(values, self.values)
        return replace(self, values=values)

    @property
    def n_floats(self) -> int:
        """Numbers of a node."""
        return int(self.values.dtype._length_)

    @property
    def encoding(self) -> Encoding:
        """Trilinear interpolation."""
        return dense.dense(self.n_floats)

    @cached_property
    def struct(self) -> Any:
        """The grid as kernels take it."""
        return self._struct(dense)

    def struct_in(self, load: Load, workers: Workers) -> Any:
        """The same: workers lay nothing out."""
        return self._struct(load("fields.dense"))

    def _struct(self, module: ModuleType) -> Any:
        return grid_struct(module, self.values, self.lattice.size, self.lattice.border)

    def node_densities(self, workers: Workers) -> wp.array:
        """Its values."""
        return self.values

    @classmethod
    def kernels(cls, kind: StorageKind, model: Model) -> list[wp.Kernel]:
        """Of its regulariser and optimiser, of growth, and of its highest densities."""
        n_floats = model.n_floats
        return [
            total_variation.total_variation_backward_kernel(n_floats),
            adam.adam_kernel(n_floats, decays=False),
            adam.resample_moments_kernel(n_floats),
            dense_bound.find_highest_kernel(n_floats),
            dense.resample_kernel(n_floats),
        ]

    def parameters(self, model: Model, optim: OptimConfig) -> tuple[Parameter, ...]:
        """Its values: Adam where rays have been."""
        return (
            Parameter(
                name="values",
                values=self.values,
                rule="nodes",
                learning_rates=model.learning_rates(optim),
                gradient=("values", "touched"),
            ),
        )

    def gradients(self, model: Model, workers: Workers) -> Gradients:
        """As large as its values, with flags of tiles that hold any."""
        entries = zero_entries(self.values.shape[0], self.values.dtype, workers)
        return Gradients.of(self.encoding.Gradient, entries | zero_head_weights(model, workers))

    def resized(self, workers: Workers, lattice: Lattice) -> DenseGrid:
        """Trilinearly read off this one."""
        values = allocate_nodes(math.prod(lattice.size), self.values.dtype, workers.device)
        grid = replace(self, values=values, lattice=lattice)
        self._resample(dense.resample_kernel(self.n_floats), self.values, grid, values, workers)
        return grid

    def resized_moments(
        self, parameter: str, moments: wp.array, other: Storage, workers: Workers
    ) -> wp.array:
        """Trilinearly read off this one's nodes."""
        n = math.prod(other.lattice.size)
        out = wp.empty(n, dtype=moments.dtype, device=workers.device)
        kernel = adam.resample_moments_kernel(self.n_floats)
        self._resample(kernel, moments, other, out, workers)
        return out

    def _resample(
        self, kernel: wp.Kernel, source: wp.array, other: Storage, out: wp.array, workers: Workers
    ) -> None:
        """Read an array over this grid's nodes at another's.

        Args:
            kernel: ``dense.resample_kernel``, or one like it.
            source: [n_nodes]
            other: The other grid.
            out: [other n_nodes] written.
            workers: Where to work.
        """
        ours, theirs = self.lattice, other.lattice
        old = (np.array(ours.size) - 1) / (ours.box_max - ours.box_min)
        new = (theirs.box_max - theirs.box_min) / (np.array(theirs.size) - 1)
        scale, offset = vec3(*(old * new)), vec3(*(old * (theirs.box_min - ours.box_min)))
        workers.launch(
            kernel,
            out.shape[0],
            *(source, wp.vec3i(*ours.size), scale, offset),
            *(wp.vec3i(*theirs.size), out),
        )

    def regulariser(self, training: TrainedOn, workers: Workers) -> Regulariser | None:
        """Total variation, where it has a weight."""
        weights = training.model.variation(training.optim)
        if not np.any(weights):
            return None
        return TotalVariation(
            values=self.values,
            size=self.lattice.size,
            weights=weights,
            strength=tv_weights(
                self.lattice,
                training.cameras,
                training.distances,
                training.near,
                training.scaling,
                workers,
            ),
            n_asked=training.voxels,
            every=training.optim.tv_every,
            until=training.optim.tv_until,
            workers=workers,
        )

    def decays(self, training: TrainedOn, workers: Workers) -> dict[str, wp.array]:
        """Near cameras, where that has a strength."""
        strength = training.optim.near_decay
        if strength == 0.0:
            return {}
        where = training.cameras, training.distances, training.near
        return {"values": near_decay(self.lattice, *where, strength, workers)}
