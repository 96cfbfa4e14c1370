"""Field storage on a device: the one class that knows its arrays.

A storage owns what is learned of a field besides the weights of the head: which arrays these are,
how they are read, how dense the field can be in a cell, what becomes of them on another lattice,
how they are regularised, and what files hold of them. Everything else asks it. Those of the package
are in modules beside this one; ``fields.storages`` has them by name.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any, Protocol, Self

import numpy as np
import warp as wp
from warpnerf_kernels.base import types
from warpnerf_kernels.base.parts import Encoding
from warpnerf_kernels.base.types import Density, real, vector
from warpnerf_kernels.fields import dense, dense_bound
from warpnerf_kernels.launch.probe import probe

from warpnerf.config import Scaling
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.lattice import Lattice, grid_struct
from warpnerf.fields.parameters import Parameter
from warpnerf.model.interface import Load, Model, loader
from warpnerf.model.storage_kinds import StorageKind
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.memory import prefer_large_pages
from warpnerf.runtime.parallel import NODES, Workers
from warpnerf.scenes.cameras.camera import Camera


class Regulariser(Protocol):
    """Regularisation: adds to a gradient what depends on stored values alone."""

    def __call__(self, gradients: Gradients, update: int, fraction: float, n_steps: int) -> None:
        """Add it, where it is due.

        Args:
            gradients: Of some training steps; added to.
            update: Which one they are for, from 0 on.
            fraction: Of the training, that is done.
            n_steps: How many steps. Noise grows with the root of their number.
        """


@dataclass(frozen=True, kw_only=True)
class ArrayShape:
    """The shape of what a storage holds under some name."""

    shape: tuple[int, ...]
    """Of the tensor."""
    width: int | None
    """Of the vectors, its last dimension, that it is as a Warp array [n]; None: of numbers."""


@dataclass(frozen=True, kw_only=True)
class TrainedOn:
    """What regularisation may know of a training."""

    model: Model
    """What the stored values become."""
    optim: OptimConfig
    """Weights of regularisation."""
    voxels: int
    """Nodes of the final lattice, which the weights are meant for."""
    cameras: Sequence[Camera]
    """The training cameras."""
    distances: Sequence[float]
    """Content distance of each, scene units."""
    near: float
    """Distance before which rays have no samples, scene units."""
    scaling: Scaling
    """Of gradients, by distance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Storage(ABC):
    """Storage of a field: values over a lattice."""

    kind: StorageKind
    """How it is configured."""
    lattice: Lattice
    """The nodes that decide step length, free cells, growth and exports."""
    density_shift: float = 0.0
    """sigma = density_scale softplus(raw density + density_shift)."""
    density_scale: float = 1.0
    """1 / scene unit."""

    # --- How it comes to be -------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def first(
        cls, kind: StorageKind, model: Model, lattice: Lattice, seed: int, device: wp.Device
    ) -> Storage:
        """What is stored before the first update.

        Args:
            kind: How it is configured.
            model: What it is to hold.
            lattice: The first one.
            seed: Of what is random.
            device: Where it lies.
        """

    @classmethod
    @abstractmethod
    def shapes(
        cls, kind: StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, tuple[int, ...]]:
        """Shapes of ``tensors``; see ``first``."""

    @classmethod
    @abstractmethod
    def over(
        cls, kind: StorageKind, model: Model, lattice: Lattice, arrays: Mapping[str, wp.array]
    ) -> Self:
        """A storage of arrays that are there already, without density_shift and density_scale.

        Args:
            kind: How it is configured.
            model: What they hold.
            lattice: Of the field.
            arrays: By name, [n] each, as ``array_shapes`` says. In float32, but for ``struct_in``,
                which takes any precision.
        """

    @classmethod
    def array_shapes(
        cls, kind: StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, ArrayShape]:
        """Shapes of ``tensors``, and which of them are vectors: those with the rule nodes."""
        return {
            name: ArrayShape(
                shape=shape, width=shape[-1] if kind.rules.get(name) == "nodes" else None
            )
            for name, shape in cls.shapes(kind, model, lattice).items()
        }

    @classmethod
    def from_tensors(
        cls,
        kind: StorageKind,
        model: Model,
        lattice: Lattice,
        tensors: dict[str, np.ndarray],
        device: wp.Device,
    ) -> Self:
        """What ``tensors`` gave, without density_shift and density_scale.

        Raises:
            ValueError: Shapes or types do not fit.
        """
        require_shapes(tensors, cls.shapes(kind, model, lattice))
        arrays = {}
        for name, of in cls.array_shapes(kind, model, lattice).items():
            if of.width is None:
                arrays[name] = wp.array(tensors[name].ravel(), dtype=real, device=device)
            else:
                entries = tensors[name].reshape(-1, of.width)
                arrays[name] = allocate_nodes(len(entries), vector(of.width), device)
                arrays[name].assign(entries)
        return cls.over(kind, model, lattice, arrays)

    @abstractmethod
    def tensors(self) -> dict[str, np.ndarray]:
        """What files hold: an array for each of the kind's ``rules``, by its name."""

    @abstractmethod
    def copied_to(self, device: wp.Device) -> Storage:
        """The same with arrays of its own.

        Args:
            device: Where they lie.
        """

    def as_final(self) -> Storage:
        """The same as if its lattice were the last one of a training: all levels of a hash are
        read."""
        return replace(self, density_scale=1.0 / float(self.lattice.voxel_size.min()))

    # --- How it is read -----------------------------------------------------------------------

    @property
    @abstractmethod
    def encoding(self) -> Encoding:
        """The part that reads it, in float32."""

    @property
    @abstractmethod
    def struct(self) -> Any:
        """Its arrays as kernels take them: the encoding's ``Params``."""

    @abstractmethod
    def struct_in(self, load: Load, workers: Workers) -> Any:
        """The same in the precision of its arrays, with what each worker lays out again in a
        launch, by ``EncodingVectors.begin``.

        Args:
            load: The kernels' modules, in that precision.
            workers: Those that will be launched.
        """

    @cached_property
    def density(self) -> Density:
        """From raw to density, as kernels take it."""
        return density_struct(types, self.density_shift, self.density_scale)

    def node_densities(self, workers: Workers) -> wp.array:
        """The raw density at the nodes of the lattice, [X * Y * Z] vectors that begin with it.

        Args:
            workers: Where to work.
        """
        size = self.lattice.size
        values = allocate_nodes(math.prod(size), vector(1), workers.device)
        workers.launch(
            probe(self.encoding).read_densities,
            values.shape[0],
            *(self.struct, wp.vec3i(*size), 1.0 + self.lattice.border, values),
            at_once=NODES,
        )
        return values

    def raw_densities(self, workers: Workers) -> np.ndarray:
        """The same, [X, Y, Z] float32.

        Args:
            workers: Where to work.
        """
        values = self.node_densities(workers).numpy()
        return np.ascontiguousarray(values[:, 0]).reshape(self.lattice.size)

    def density_slabs(self, workers: Workers) -> Iterator[tuple[int, wp.array]]:
        """``node_densities`` of some planes of nodes along x at a time, where all take much memory.

        Args:
            workers: Where to work.

        Yields:
            Which plane is the first, and [n * Y * Z] vectors that begin with the raw density.
        """
        yield 0, self.node_densities(workers)

    def highest_densities(self, workers: Workers, margin: int) -> wp.array:
        """The highest raw density of the nodes of each cell of free space, and of those around.

        Args:
            workers: Where to work.
            margin: How many nodes around a cell count as well, along each axis.

        Returns:
            [MX * MY * MZ]
        """
        lattice, device, size = self.lattice, workers.device, self.lattice.cells
        span = 1 if device.is_cuda else size[2]  # a core takes a row

        def launch(kernel: wp.Kernel, n: int, *arguments: Any) -> None:
            workers.launch(kernel, n // span, span, *arguments, at_once=max(1, NODES // span))

        shape = [*lattice.size[:2], size[2]]
        highest = wp.empty(math.prod(shape), dtype=real, device=device)
        of_plane = shape[1] * shape[2]
        for first, values in self.density_slabs(workers):
            n = values.shape[0] // math.prod(lattice.size[1:])
            launch(
                dense_bound.find_highest_kernel(values.dtype._length_),
                n * of_plane,
                grid_struct(dense, values, (n, *lattice.size[1:]), lattice.border),
                size[2],
                margin,
                highest[first * of_plane : (first + n) * of_plane],
            )
        for axis in (1, 0):  # from nodes to cells
            shape[axis] = size[axis]
            joined = wp.empty(math.prod(shape), dtype=real, device=device)
            launch(
                dense_bound.join_highest,
                joined.size,
                highest,
                lattice.size[axis],
                size[axis],
                math.prod(shape[axis + 1 :]),
                margin,
                joined,
            )
            highest = joined
        return highest

    # --- How it is trained --------------------------------------------------------------------

    @classmethod
    def kernels(cls, kind: StorageKind, model: Model) -> list[wp.Kernel]:
        """What a training launches for it, which is compiled before its first step: of its
        densities, here; what else there is of its own is added.
        """
        part = kind.encoding(loader("float32"), model)
        return [probe(part).read_densities, dense_bound.find_highest_kernel(1)]

    @abstractmethod
    def parameters(self, model: Model, optim: OptimConfig) -> tuple[Parameter, ...]:
        """What of it is learned, in the order of the kind's ``rules``.

        Args:
            model: Rates of the numbers that it reads.
            optim: Rates of all models.
        """

    @abstractmethod
    def gradients(self, model: Model, workers: Workers) -> Gradients:
        """No gradient yet: of its encoding's ``Gradient``.

        Args:
            model: Whose head has weights, too.
            workers: Where they lie.
        """

    @abstractmethod
    def resized(self, workers: Workers, lattice: Lattice) -> Storage:
        """The same field on another lattice.

        Args:
            workers: Where to work.
            lattice: The new one, whose box lies within this one's.
        """

    @abstractmethod
    def resized_moments(
        self, parameter: str, moments: wp.array, other: Storage, workers: Workers
    ) -> wp.array:
        """What an optimiser keeps for each entry of a parameter, on another lattice.

        Args:
            parameter: Its name.
            moments: [n_entries], see optim.adam.
            other: From ``resized``.
            workers: Where to work.
        """

    def regulariser(self, training: TrainedOn, workers: Workers) -> Regulariser | None:
        """What is added to gradients besides those of rays; None: nothing.

        Args:
            training: What it may depend on.
            workers: Where to work.
        """
        return None

    def decays(self, training: TrainedOn, workers: Workers) -> dict[str, wp.array]:
        """How far updates lower raw densities besides; see ``fields.near_decay``.

        Args:
            training: What it may depend on.
            workers: Where to work.

        Returns:
            By parameter: [n_tiles] in learning rates; of its entries' first number.
        """
        return {}


SLAB = 1 << 22
"""Nodes whose densities are in memory at a time, about, in a look for free space."""


class ReadAtNodes(Storage):
    """A storage without a value at each node: its densities there are computed by parts."""

    @abstractmethod
    def densities_of_planes(self, workers: Workers, first: int, n: int) -> wp.array:
        """``node_densities`` of some planes of nodes along x.

        Args:
            workers: Where to work.
            first: The first plane.
            n: How many.
        """

    def node_densities(self, workers: Workers) -> wp.array:
        """Of all planes."""
        return self.densities_of_planes(workers, 0, self.lattice.size[0])

    def density_slabs(self, workers: Workers) -> Iterator[tuple[int, wp.array]]:
        """Of so many nodes at a time as SLAB says."""
        x, y, z = self.lattice.size
        n = max(1, SLAB // (y * z))
        for first in range(0, x, n):
            yield first, self.densities_of_planes(workers, first, min(n, x - first))

    @classmethod
    def kernels(cls, kind: StorageKind, model: Model) -> list[wp.Kernel]:
        """Without that which reads single nodes."""
        return [dense_bound.find_highest_kernel(1)]


def require_shapes(tensors: dict[str, np.ndarray], shapes: Mapping[str, tuple[int, ...]]) -> None:
    """Raise ValueError unless arrays of a file have these shapes, and are float32."""
    for name, shape in shapes.items():
        array = tensors[name]
        if array.shape != shape or array.dtype != np.float32:
            raise ValueError(f"{name} are {array.dtype} {array.shape}")


def allocate_nodes(n_nodes: int, dtype: Any, device: wp.Device) -> wp.array:
    """Values of nodes, not yet written: [n_nodes], on the CPU on large pages where there are any.

    Args:
        n_nodes: How many.
        dtype: What a node holds.
        device: Where it lies.
    """
    values = wp.empty(n_nodes, dtype=dtype, device=device)
    if device.is_cpu:
        prefer_large_pages(values.ptr, values.capacity)
    return values


def density_struct(types: ModuleType, shift: float, scale: float) -> Any:
    """A kernel's Density, in the precision of the given ``warpnerf_kernels.base.types``."""
    density = types.Density()
    density.shift = shift
    density.scale = scale
    return density
