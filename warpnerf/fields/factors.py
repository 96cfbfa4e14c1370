"""Factors: planes and lines of vectors over the axes of the lattice, and their decoder."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import warp as wp
from warpnerf_kernels.base.parts import Encoding
from warpnerf_kernels.base.types import real, vector
from warpnerf_kernels.fields import factors
from warpnerf_kernels.optim import adam
from warpnerf_kernels.optim.factor_terms import line_terms, plane_terms_kernel

from warpnerf.fields.decoded import Decoded
from warpnerf.fields.factor_terms import FactorTerms
from warpnerf.fields.gradients import Gradients, zero_entries, zero_head_weights, zero_weights
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import Regulariser, Storage, TrainedOn, allocate_nodes
from warpnerf.model.interface import Load, Model
from warpnerf.model.storage_kinds import StorageKind, Vm
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import NODES, Workers

AXES = ((0, 1), (0, 2), (1, 2))
"""Of the planes; that of each one's line is the third, and lines are z, y, x."""

DEVIATION = 0.1
"""Of the numbers of planes and lines before the first update."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Factors(Decoded):
    """Three planes, three lines, and the matrix that decodes their products; see fields.factors of
    the kernels."""

    kind: Vm
    planes: wp.array
    """[X Y + X Z + Y Z] vectors: the planes xy, xz and yz, second axis fastest."""
    lines: wp.array
    """[(Z + Y + X) * width] the lines z, y and x."""

    @classmethod
    def first(
        cls, kind: StorageKind, model: Model, lattice: Lattice, seed: int, device: wp.Device
    ) -> Factors:
        """Small random numbers, of which density is the plain sum of its own products."""
        assert isinstance(kind, Vm)
        rng, width = np.random.default_rng(seed), kind.width
        tensors = {
            name: rng.normal(0.0, DEVIATION, (n, width)).astype(np.float32)
            for name, n in (("planes", _n_entries(lattice)), ("lines", sum(lattice.size)))
        }
        decoder = np.zeros((3, width, factors.columns_of(model.n_floats)), np.float32)
        limit = 1.0 / math.sqrt(width)
        decoder[..., 1 : 1 + model.n_features] = rng.uniform(
            -limit, limit, (3, width, model.n_features)
        )
        decoder[:, : kind.density, 0] = 1.0
        tensors["decoder"] = decoder.reshape(3 * width, -1)
        return cls.from_tensors(kind, model, lattice, tensors, device)

    @classmethod
    def shapes(
        cls, kind: StorageKind, model: Model, lattice: Lattice
    ) -> dict[str, tuple[int, ...]]:
        """[X Y + X Z + Y Z, width] planes, [Z + Y + X, width] lines, and the decoder."""
        assert isinstance(kind, Vm)
        return {
            "planes": (_n_entries(lattice), kind.width),
            "lines": (sum(lattice.size), kind.width),
            "decoder": (3 * kind.width, factors.columns_of(model.n_floats)),
        }

    @classmethod
    def over(
        cls, kind: StorageKind, model: Model, lattice: Lattice, arrays: Mapping[str, wp.array]
    ) -> Self:
        """Of planes, lines and decoder."""
        assert isinstance(kind, Vm)
        return cls(
            kind=kind,
            lattice=lattice,
            n_floats=model.n_floats,
            n_decoded=1 + model.n_features,
            by_sample=model.by_sample,
            **arrays,
        )

    def tensors(self) -> dict[str, np.ndarray]:
        """Planes and lines, entry by entry, and the decoder, row by row."""
        width = self.kind.width
        return {
            "planes": self.planes.numpy(),
            "lines": self.lines.numpy().reshape(-1, width),
            "decoder": self.decoder.numpy().reshape(3 * width, -1),
        }

    def copied_to(self, device: wp.Device) -> Factors:
        """The same with arrays of its own."""
        planes = allocate_nodes(self.planes.shape[0], self.planes.dtype, device)
        wp.copy(planes, self.planes)
        lines, decoder = (wp.clone(array, device=device) for array in (self.lines, self.decoder))
        return replace(self, planes=planes, lines=lines, decoder=decoder)

    @property
    def encoding(self) -> Encoding:
        """Products of planes and lines, decoded."""
        return factors.factors(self.kind.width, self.n_floats, self.n_decoded, self.by_sample)

    def own_struct(self, load: Load) -> Any:
        """Planes, lines and decoder as kernels take them."""
        lattice, middle = self.lattice, 0.5 * (np.array(self.lattice.size) - 1)
        struct = load("fields.factors").factors_type(self.kind.width)()
        struct.planes, struct.lines, struct.decoder = self.planes, self.lines, self.decoder
        vec3 = load("base.types").vec3
        struct.size = wp.vec3i(*lattice.size)
        struct.to_nodes = vec3(*(middle / (1.0 + lattice.border)))
        struct.middle = vec3(*middle)
        struct.width, struct.n_decoded = self.kind.width, self.n_decoded
        return struct

    def densities_of_planes(self, workers: Workers, first: int, n: int) -> wp.array:
        """Sums of products of entries, as nodes lie on those of planes and lines."""
        _, y, z = self.lattice.size
        values = allocate_nodes(n * y * z, vector(1), workers.device)
        workers.launch(
            factors.node_densities_kernel(self.kind.width),
            n * y,
            *(self.struct, self.n_columns, first * y, values),
            at_once=max(1, NODES // z),
        )
        return values

    @classmethod
    def kernels(cls, kind: StorageKind, model: Model) -> list[wp.Kernel]:
        """Of its densities, of growth, and of its optimiser."""
        assert isinstance(kind, Vm)
        return [
            *super().kernels(kind, model),
            factors.node_densities_kernel(kind.width),
            *(factors.resample_kernel(dtype) for dtype in (vector(kind.width), real)),
            adam.resample_moments_along_kernel(kind.width),
            adam.adam_kernel(kind.width, decays=False),
            plane_terms_kernel(kind.width),
            line_terms,
        ]

    def parameters(self, model: Model, optim: OptimConfig) -> tuple[Parameter, ...]:
        """Planes: Adam where rays have been; lines and decoder, which all rays share."""
        rates = {"planes": np.full(self.kind.width, self.kind.learning_rate)}
        rates["lines"] = np.array([self.kind.learning_rate])
        rates["decoder"] = np.array([self.kind.learning_rate_decoder])
        flags = {"planes": ("touched",)}
        return tuple(
            Parameter(
                name=name,
                values=getattr(self, name),
                rule=rule,
                learning_rates=rates[name],
                gradient=(name, *flags.get(name, ())),
            )
            for name, rule in self.kind.rules.items()
        )

    def gradients(self, model: Model, workers: Workers) -> Gradients:
        """As large as its planes, with flags of tiles that hold any; of the rest, copies."""
        planes = zero_entries(self.planes.shape[0], self.planes.dtype, workers)
        return Gradients.of(
            self.encoding.Gradient,
            {"planes": planes["values"], "touched": planes["touched"]}
            | {"lines": zero_weights(self.lines.size, workers)}
            | {"decoder": zero_weights(self.decoder.size, workers)}
            | zero_head_weights(model, workers),
        )

    def resized(self, workers: Workers, lattice: Lattice) -> Factors:
        """Planes and lines read at the other's nodes: the same field but for what lies between."""
        planes = allocate_nodes(_n_entries(lattice), self.planes.dtype, workers.device)
        lines = wp.empty(sum(lattice.size) * self.kind.width, dtype=real, device=workers.device)
        other = replace(self, lattice=lattice, planes=planes, lines=lines)
        kernel = factors.resample_kernel(self.planes.dtype)
        self._resample_planes(kernel, self.planes, other, planes, workers)
        self._resample_lines(self.lines, other, lines, workers)
        return other

    def resized_moments(
        self, parameter: str, moments: wp.array, other: Storage, workers: Workers
    ) -> wp.array:
        """Read off at the other's nodes, as planes and lines are."""
        assert isinstance(other, Factors)
        out = wp.empty(getattr(other, parameter).shape, dtype=moments.dtype, device=workers.device)
        if parameter == "lines":
            self._resample_lines(moments, other, out, workers)
        else:
            kernel = adam.resample_moments_along_kernel(self.kind.width)
            self._resample_planes(kernel, moments, other, out, workers)
        return out

    def _resample_planes(
        self, kernel: wp.Kernel, source: wp.array, other: Factors, out: wp.array, workers: Workers
    ) -> None:
        """Read an array over the planes at another's nodes, along one axis after the other.

        Args:
            kernel: ``factors.resample_kernel``, or one like it.
            source: [n_entries]
            other: The other storage.
            out: [other n_entries] written.
            workers: Where to work.
        """
        ours, theirs = self.lattice.size, other.lattice.size
        begin = out_begin = 0
        for a, b in AXES:
            end, out_end = begin + ours[a] * ours[b], out_begin + theirs[a] * theirs[b]
            half = wp.empty(theirs[a] * ours[b], dtype=source.dtype, device=workers.device)
            self._resample(kernel, source[begin:end], other, a, ours[b], half, workers)
            self._resample(kernel, half, other, b, 1, out[out_begin:out_end], workers)
            begin, out_begin = end, out_end

    def _resample_lines(
        self, source: wp.array, other: Factors, out: wp.array, workers: Workers
    ) -> None:
        """The same of an array over the lines."""
        width, begin, out_begin = self.kind.width, 0, 0
        for axis in (2, 1, 0):
            end = begin + self.lattice.size[axis] * width
            out_end = out_begin + other.lattice.size[axis] * width
            kernel, there = factors.resample_kernel(real), out[out_begin:out_end]
            self._resample(kernel, source[begin:end], other, axis, width, there, workers)
            begin, out_begin = end, out_end

    def _resample(
        self,
        kernel: wp.Kernel,
        source: wp.array,
        other: Factors,
        axis: int,
        inner: int,
        out: wp.array,
        workers: Workers,
    ) -> None:
        """Read an array at another's nodes along an axis, where neighbours lie `inner` apart."""
        ours, theirs = self.lattice, other.lattice
        old = (ours.size[axis] - 1) / (ours.box_max - ours.box_min)[axis]
        new = (theirs.box_max - theirs.box_min)[axis] / (theirs.size[axis] - 1)
        offset = old * (theirs.box_min - ours.box_min)[axis]
        workers.launch(
            kernel,
            out.shape[0],
            *(source, ours.size[axis], inner, float(old * new), float(offset)),
            *(theirs.size[axis], out),
        )

    def regulariser(self, training: TrainedOn, workers: Workers) -> Regulariser | None:
        """Total variation of planes, and sparsity, where they have a weight."""
        kind, optim = self.kind, training.optim
        variation = np.full(kind.width, optim.tv_rgb)
        variation[: kind.density] = optim.tv_density
        if not np.any(variation) and kind.sparsity == 0.0:
            return None
        return FactorTerms(
            planes=self.planes,
            lines=self.lines,
            size=self.lattice.size,
            variation=variation,
            n_sparse=kind.density,
            sparsity=kind.sparsity,
            n_asked=training.voxels,
            every=optim.tv_every,
            until=optim.tv_until,
            workers=workers,
        )


def _n_entries(lattice: Lattice) -> int:
    """Of the three planes."""
    return sum(lattice.size[a] * lattice.size[b] for a, b in AXES)
