"""A storage: a grid of latent numbers, a row of them along z, and a matrix that decodes their sum.

Three arrays of its own, each with an optimiser's rule; a growth rule, a regulariser, and what files
hold of it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar, Self

import numpy as np
import warp as wp

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.gradients import Gradients, zero_entries, zero_head_weights, zero_weights
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import Regulariser, Storage, TrainedOn
from warpnerf.fields.storages import register
from warpnerf.model import storage_kinds
from warpnerf.model.interface import Load, Model, loader
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import Update, register_rule

WIDTH = 4
"""Numbers of a node, and of a sample: density and three features."""


@cache
def encoding(load: Load) -> Any:
    dense, types, tiles = load("fields.dense"), load("base.types"), load("base.tiles")
    real, vec3, Raw = types.real, types.vec3, types.vector(WIDTH)
    read_dense, adj_read_dense, place_dense = dense.read, dense.adj_read, dense.place
    tile_of, Grid = tiles.tile_of, dense.grid_type(WIDTH)

    @wp.struct
    class Columns:
        grid: Grid
        row: wp.array(dtype=Raw)  # [Z] along z
        matrix: wp.array(dtype=real)  # [9] of the three features, row by row

    @wp.struct
    class Gradient:
        values: wp.array(dtype=Raw)  # [X * Y * Z] of the grid
        touched: wp.array(dtype=wp.uint8)
        row: wp.array(dtype=Raw)  # [Z]
        row_touched: wp.array(dtype=wp.uint8)
        matrix: wp.array2d(dtype=real)  # [n_workers, 9 or more]
        weights: wp.array2d(dtype=real)

    @wp.func
    def height(params: Columns, position: vec3) -> real:
        """In the row, in entries."""
        share = place_dense(params.grid, position)[2]
        return wp.clamp(share, real(0.0), real(1.0)) * real(params.row.shape[0] - 1)

    @wp.func
    def latent(params: Columns, position: vec3):
        h = height(params, position)
        k = wp.min(int(h), params.row.shape[0] - 2)
        up = h - real(k)
        along = (real(1.0) - up) * params.row[k] + up * params.row[k + 1]
        return read_dense(params.grid, position) + along

    @wp.func
    def read(params: Columns, position: vec3):
        x = latent(params, position)
        out = Raw()
        out[0] = x[0]
        for i in range(3):
            for j in range(3):
                out[1 + i] += params.matrix[3 * i + j] * x[1 + j]
        return out

    @wp.func
    def adj_read(params: Columns, position: vec3, adj_raw: Raw, gradient: Gradient):
        x = latent(params, position)
        adj = Raw()
        adj[0] = adj_raw[0]
        for i in range(3):
            for j in range(3):
                adj[1 + j] += params.matrix[3 * i + j] * adj_raw[1 + i]
                wp.atomic_add(gradient.matrix, 0, 3 * i + j, adj_raw[1 + i] * x[1 + j])
        adj_read_dense(params.grid, position, adj, gradient)
        h = height(params, position)
        k = wp.min(int(h), params.row.shape[0] - 2)
        up = h - real(k)
        gradient.row_touched[tile_of(k)] = wp.uint8(1)
        wp.atomic_add(gradient.row, k, (real(1.0) - up) * adj)
        wp.atomic_add(gradient.row, k + 1, up * adj)

    @wp.func
    def place(params: Columns, position: vec3) -> vec3:
        return place_dense(params.grid, position)

    return load("base.parts").Encoding(
        n_floats=WIDTH,
        Params=Columns,
        Gradient=Gradient,
        read=read,
        adj_read=adj_read,
        place=place,
    )


@storage_kinds.register
@dataclass(frozen=True, kw_only=True)
class Columns(storage_kinds.StorageKind):
    """How it is configured."""

    name: ClassVar[str] = "columns"
    decay: float = 1e-3
    """Of the row, towards 0."""

    @property
    def rules(self) -> Mapping[str, str]:
        return {"values": "nodes", "row": "nodes", "matrix": "descent"}

    def encoding(self, load: Load, model: Model) -> Any:
        assert model.n_floats == WIDTH
        return encoding(load)

    def training_bytes(self, model: Model, size: tuple[int, int, int]) -> int:
        return storage_kinds.DENSE.training_bytes(model, size)


@register_rule("descent")
class Descent:
    """A rule of an optimiser: a step along the gradient, which keeps how many there were."""

    state_names: ClassVar[tuple[str, ...]] = ("steps",)

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        return {"steps": wp.zeros(1, dtype=wp.float32, device=workers.device)}

    @staticmethod
    def resized(
        name: str, state: dict[str, wp.array], storage: Storage, other: Storage, workers: Workers
    ) -> dict[str, wp.array]:
        return state

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: Update,
        workers: Workers,
    ) -> None:
        gradient = gradients.arrays[parameter.gradient[0]]
        total = gradient.numpy().sum(axis=0)[: parameter.values.size]
        rate = update.factor * parameter.learning_rates[0]
        parameter.values.assign(parameter.values.numpy() - np.float32(rate) * total)
        gradient.zero_()
        state["steps"].assign(state["steps"].numpy() + 1.0)


@wp.kernel
def decay_row(
    first: int,
    row: wp.array(dtype=wp.types.vector(WIDTH, wp.float32)),
    factor: wp.float32,
    gradient: wp.array(dtype=wp.types.vector(WIDTH, wp.float32)),
):
    n = first + wp.tid()
    if wp.length_sq(gradient[n]) > 0.0:
        gradient[n] += factor * row[n]


@register(Columns)
@dataclass(frozen=True, kw_only=True, eq=False)
class ColumnStorage(Storage):
    """On its device."""

    grid: DenseGrid
    row: wp.array
    """[Z] vectors."""
    matrix: wp.array
    """[9]"""

    @classmethod
    def first(
        cls,
        kind: storage_kinds.StorageKind,
        model: Model,
        lattice: Lattice,
        seed: int,
        device: wp.Device,
    ) -> "ColumnStorage":
        numbers = np.eye(3) + 0.1 * np.random.default_rng(seed).normal(size=(3, 3))
        tensors = {
            "values": np.zeros((*lattice.size, WIDTH), np.float32),
            "row": np.zeros((lattice.size[2], WIDTH), np.float32),
            "matrix": numbers.ravel().astype(np.float32),
        }
        return cls.from_tensors(kind, model, lattice, tensors, device)

    @classmethod
    def shapes(
        cls, kind: storage_kinds.StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, tuple[int, ...]]:
        return {
            "values": (*lattice.size, WIDTH),
            "row": (lattice.size[2], WIDTH),
            "matrix": (9,),
        }

    @classmethod
    def over(
        cls,
        kind: storage_kinds.StorageKind,
        model: Model,
        lattice: Lattice,
        arrays: Mapping[str, wp.array],
    ) -> Self:
        grid = DenseGrid.over(storage_kinds.DENSE, model, lattice, arrays)
        row, matrix = arrays["row"], arrays["matrix"]
        return cls(kind=kind, lattice=lattice, grid=grid, row=row, matrix=matrix)

    def tensors(self) -> dict[str, np.ndarray]:
        return {
            **self.grid.tensors(),
            "row": self.row.numpy(),
            "matrix": self.matrix.numpy(),
        }

    def copied_to(self, device: wp.Device) -> "ColumnStorage":
        row, matrix = (wp.clone(array, device=device) for array in (self.row, self.matrix))
        return replace(self, grid=self.grid.copied_to(device), row=row, matrix=matrix)

    @property
    def encoding(self) -> Any:
        return encoding(loader("float32"))

    @cached_property
    def struct(self) -> Any:
        return self.struct_in(loader("float32"), Workers("cpu", 1))

    def struct_in(self, load: Load, workers: Workers) -> Any:
        struct = encoding(load).Params()
        struct.grid = self.grid.struct_in(load, workers)
        struct.row, struct.matrix = self.row, self.matrix
        return struct

    def parameters(self, model: Model, optim: OptimConfig) -> tuple[Parameter, ...]:
        of_grid = self.grid.parameters(model, optim)
        row = replace(of_grid[0], name="row", values=self.row, gradient=("row", "row_touched"))
        matrix = Parameter(
            name="matrix",
            values=self.matrix,
            rule="descent",
            learning_rates=np.array([0.5]),
            gradient=("matrix",),
        )
        return *of_grid, row, matrix

    def gradients(self, model: Model, workers: Workers) -> Gradients:
        row = zero_entries(self.row.shape[0], self.row.dtype, workers)
        return Gradients.of(
            self.encoding.Gradient,
            zero_entries(self.grid.values.shape[0], self.grid.values.dtype, workers)
            | {"row": row["values"], "row_touched": row["touched"]}
            | {"matrix": zero_weights(self.matrix.size, workers)}
            | zero_head_weights(model, workers),
        )

    def resized(self, workers: Workers, lattice: Lattice) -> "ColumnStorage":
        row = self.row.numpy()[self._nearest(lattice)]
        return replace(
            self,
            lattice=lattice,
            grid=self.grid.resized(workers, lattice),
            row=wp.array(row, dtype=self.row.dtype, device=workers.device),
        )

    def resized_moments(
        self, parameter: str, moments: wp.array, other: Storage, workers: Workers
    ) -> wp.array:
        if parameter == "values":
            return self.grid.resized_moments(parameter, moments, other, workers)
        kept = moments.numpy()[self._nearest(other.lattice)]
        return wp.array(kept, dtype=moments.dtype, device=workers.device)

    def _nearest(self, other: Lattice) -> np.ndarray:
        """Of our row, the entry nearest to each of another lattice's."""
        z = np.linspace(other.box_min[2], other.box_max[2], other.size[2])
        low, high = self.lattice.box_min[2], self.lattice.box_max[2]
        return np.round((z - low) / (high - low) * (self.lattice.size[2] - 1)).astype(int)

    def regulariser(self, training: TrainedOn, workers: Workers) -> Regulariser:
        kind, row = self.kind, self.row
        assert isinstance(kind, Columns)

        def decay(gradients: Gradients, update: int, fraction: float, n_steps: int) -> None:
            gradient = gradients.arrays["row"]
            workers.launch(decay_row, row.shape[0], row, kind.decay * n_steps, gradient)

        return decay
