"""A hash: tables of entries by level of resolution, and what decodes them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import warp as wp
from warpnerf_kernels.base.parts import Encoding
from warpnerf_kernels.base.types import vector
from warpnerf_kernels.fields import hashed
from warpnerf_kernels.fields.decoder import columns_of, padded
from warpnerf_kernels.optim import adam

from warpnerf.fields.decoded import Decoded
from warpnerf.fields.gradients import Gradients, zero_entries, zero_head_weights, zero_weights
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import Storage, allocate_nodes
from warpnerf.model.interface import Load, Model
from warpnerf.model.storage_kinds import Hash, StorageKind
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import NODES, Workers

LIMIT = 1e-4
"""Of the numbers of entries before the first update, to both sides of 0."""

ALIGNED = 16
"""Levels begin at multiples of so many entries, whole tiles and cache lines."""

ROW_ALIGNED = 4
"""Hashed rows begin at multiples of so many entries, so that most tiles belong to one of them."""


@dataclass(frozen=True, kw_only=True)
class LevelShape:
    """A level's lattice and entries."""

    edges: np.ndarray
    """Cells along the field's edges, [3], not whole numbers but along the longest."""
    size: tuple[int, int, int]
    """Nodes."""
    is_hashed: bool
    """Whether there are fewer entries than nodes."""
    begin: int
    """Of its entries."""
    end: int
    """One past the last."""


def level_shapes(kind: Hash, lattice: Lattice) -> list[LevelShape]:
    """Levels over the field of a lattice, coarsest first."""
    shapes: list[LevelShape] = []
    edges = lattice.box_max - lattice.box_min
    begin = 0
    for resolution in kind.resolutions:
        cells = resolution * edges / edges.max()
        x, y, z = (max(1, math.ceil(n - 1e-6)) + 1 for n in cells)
        is_hashed = x * y * z > kind.table
        # A row that begins at the table's end still has room.
        n = kind.table + z if is_hashed else x * y * z
        end = begin + n
        shapes.append(
            LevelShape(edges=cells, size=(x, y, z), is_hashed=is_hashed, begin=begin, end=end)
        )
        begin = -(-end // ALIGNED) * ALIGNED
    return shapes


@dataclass(frozen=True, kw_only=True, eq=False)
class Hashed(Decoded):
    """Tables of entries, and what decodes them; see fields.hashed of the kernels."""

    kind: Hash
    values: wp.array
    """[n_entries] vectors, level by level."""
    hidden: wp.array
    """[n_inputs * units] the hidden layer's matrix row by row; none without one."""

    @classmethod
    def first(
        cls, kind: StorageKind, model: Model, lattice: Lattice, seed: int, device: wp.Device
    ) -> Hashed:
        """Entries of next to nothing, and random matrices that keep the size of what they see."""
        assert isinstance(kind, Hash)
        rng, n_inputs = np.random.default_rng(seed), kind.levels * kind.features
        n_entries = level_shapes(kind, lattice)[-1].end
        n_rows, n_decoded = kind.hidden or n_inputs, 1 + model.n_features
        limit = math.sqrt(3.0 / n_rows)
        decoder = np.zeros((n_rows, columns_of(model.n_floats)), np.float32)
        decoder[:, :n_decoded] = rng.uniform(-limit, limit, (n_rows, n_decoded))
        values = rng.uniform(-LIMIT, LIMIT, (n_entries, kind.features)).astype(np.float32)
        tensors = {"values": values, "decoder": decoder}
        if kind.hidden:
            limit = math.sqrt(6.0 / n_inputs)  # half of the units are 0
            hidden = rng.uniform(-limit, limit, (n_inputs, kind.hidden))
            tensors["hidden"] = hidden.astype(np.float32)
        return cls.from_tensors(kind, model, lattice, tensors, device)

    @classmethod
    def shapes(
        cls, kind: StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, tuple[int, ...]]:
        """[n_entries, features] values, the hidden layer if there is one, and the decoder."""
        assert isinstance(kind, Hash)
        n_inputs = kind.levels * kind.features
        shapes: dict[str, tuple[int, ...]] = {
            "values": (level_shapes(kind, lattice)[-1].end, kind.features),
            "decoder": (kind.hidden or n_inputs, columns_of(model.n_floats)),
        }
        if kind.hidden:
            shapes["hidden"] = (n_inputs, kind.hidden)
        return shapes

    @classmethod
    def over(
        cls, kind: StorageKind, model: Model, lattice: Lattice, arrays: Mapping[str, wp.array]
    ) -> Self:
        """Of entries, the hidden layer if there is one, and the decoder."""
        assert isinstance(kind, Hash)
        decoder = arrays["decoder"]
        none = wp.empty(0, dtype=decoder.dtype, device=decoder.device)
        return cls(
            kind=kind,
            lattice=lattice,
            n_floats=model.n_floats,
            n_decoded=1 + model.n_features,
            by_sample=model.by_sample,
            values=arrays["values"],
            hidden=arrays.get("hidden", none),
            decoder=decoder,
        )

    def tensors(self) -> dict[str, np.ndarray]:
        """Entries, and matrices row by row."""
        units = self.kind.hidden
        hidden = {"hidden": self.hidden.numpy().reshape(-1, units)} if units else {}
        decoder = self.decoder.numpy().reshape(-1, self.n_columns)
        return {"values": self.values.numpy(), **hidden, "decoder": decoder}

    def copied_to(self, device: wp.Device) -> Hashed:
        """The same with arrays of its own."""
        values = allocate_nodes(self.values.shape[0], self.values.dtype, device)
        wp.copy(values, self.values)
        hidden, decoder = (wp.clone(m, device=device) for m in (self.hidden, self.decoder))
        return replace(self, values=values, hidden=hidden, decoder=decoder)

    @property
    def encoding(self) -> Encoding:
        """Entries of all levels, decoded."""
        kind = self.kind
        return hashed.hashed(
            *(kind.features, kind.levels, self.n_floats, self.n_decoded, self.by_sample),
            kind.hidden,
        )

    @property
    def n_transposed(self) -> int:
        """Numbers of the transposes of all matrices."""
        kind = self.kind
        return super().n_transposed + kind.hidden * padded(kind.levels * kind.features)

    @property
    def n_active(self) -> int:
        """How many levels are read: all on the final lattice, and on one whose voxels are wider
        those that are coarser than the finest by as much, at least."""
        wider = float(self.lattice.voxel_size.min()) * self.density_scale  # than the final ones
        finest = 1.01 * self.kind.finest / max(1.0, wider)
        return max(1, sum(n <= finest for n in self.kind.resolutions))

    def own_struct(self, load: Load) -> Any:
        """Entries and decoder as kernels take them, and levels."""
        module = load("fields.hashed")
        struct = module.hash_type(self.kind.features)()
        struct.values, struct.decoder = self.values, self.decoder
        struct.hidden = self.hidden
        levels = [self._level(load, shape) for shape in level_shapes(self.kind, self.lattice)]
        struct.levels = wp.array(levels, dtype=module.Level, device=self.decoder.device)
        struct.n_active, struct.width = self.n_active, self.kind.features
        struct.n_units, struct.n_decoded = self.kind.hidden, self.n_decoded
        return struct

    def _level(self, load: Load, shape: LevelShape) -> Any:
        level, middle = load("fields.hashed").Level(), 0.5 * shape.edges
        vec3 = load("base.types").vec3
        level.size, level.middle = wp.vec3i(*shape.size), vec3(*middle)
        level.to_nodes = vec3(*(middle / (1.0 + self.lattice.border)))
        level.begin = shape.begin
        level.mask = self.kind.table - ROW_ALIGNED if shape.is_hashed else 0
        return level

    @staticmethod
    def densities_kernel(kind: Hash) -> wp.Kernel:
        """That of its densities at nodes."""
        return hashed.node_densities_kernel(kind.features, kind.levels, kind.hidden)

    def densities_of_planes(self, workers: Workers, first: int, n: int) -> wp.array:
        """Those that are read there."""
        lattice, (_, y, z) = self.lattice, self.lattice.size
        values = allocate_nodes(n * y * z, vector(1), workers.device)
        workers.launch(
            self.densities_kernel(self.kind),
            n * y,
            *(self.struct, self.n_columns, wp.vec3i(*lattice.size), 1.0 + lattice.border),
            *(first * y, values),
            at_once=max(1, NODES // (8 * z)),
        )
        return values

    @classmethod
    def kernels(cls, kind: StorageKind, model: Model) -> list[wp.Kernel]:
        """Of its densities and of its optimiser."""
        assert isinstance(kind, Hash)
        return [
            *super().kernels(kind, model),
            cls.densities_kernel(kind),
            adam.adam_kernel(kind.features, decays=False),
        ]

    def parameters(self, model: Model, optim: OptimConfig) -> tuple[Parameter, ...]:
        """Entries: Adam where rays have been; matrices, which all rays share."""
        kind = self.kind
        matrices = {"hidden": self.hidden} if kind.hidden else {}
        return (
            Parameter(
                name="values",
                values=self.values,
                rule=kind.rules["values"],
                learning_rates=np.full(kind.features, kind.learning_rate),
                gradient=("values", "touched"),
                epsilon=kind.epsilon,
            ),
            *(
                Parameter(
                    name=name,
                    values=matrix,
                    rule=kind.rules[name],
                    learning_rates=np.array([kind.learning_rate_decoder]),
                    gradient=(name,),
                    epsilon=kind.epsilon,
                )
                for name, matrix in (matrices | {"decoder": self.decoder}).items()
            ),
        )

    def gradients(self, model: Model, workers: Workers) -> Gradients:
        """As large as its entries, with flags of tiles that hold any; of matrices, copies."""
        return Gradients.of(
            self.encoding.Gradient,
            zero_entries(self.values.shape[0], self.values.dtype, workers, large_pages=True)
            | {"hidden": zero_weights(self.hidden.size, workers)}
            | {"decoder": zero_weights(self.decoder.size, workers)}
            | zero_head_weights(model, workers),
        )

    def resized(self, workers: Workers, lattice: Lattice) -> Hashed:
        """The same entries, of which more are read where the lattice is finer.

        Raises:
            ValueError: The other's box is another one: entries are tied to theirs.
        """
        corners = ((self.lattice.box_min, lattice.box_min), (self.lattice.box_max, lattice.box_max))
        if not all(np.array_equal(ours, theirs) for ours, theirs in corners):
            raise ValueError("the box of a hash is fixed")
        return replace(self, lattice=lattice)

    def resized_moments(
        self, parameter: str, moments: wp.array, other: Storage, workers: Workers
    ) -> wp.array:
        """The same: entries do not depend on the lattice."""
        return moments
