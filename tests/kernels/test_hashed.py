"""A hash in float64: what is read, and its transpose, compared with the oracle and differences."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.reference.hashed import raw_values
from tests.support.encodings import EncodingProblem
from tests.support.expected import assert_close
from warpnerf.fields.hashed import Hashed, LevelShape, level_shapes
from warpnerf.fields.lattice import Lattice
from warpnerf.model.interface import loader
from warpnerf.model.models import Deferred
from warpnerf.model.storage_kinds import Hash
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.space import Space

KINDS = [(4, 16, 16, 0), (2, 4, 4, 0), (8, 32, 28, 0), (2, 32, 17, 48)]
"""Numbers of an entry, of a sample, how many of these are decoded, and units of a hidden layer."""
KIND = Hash(levels=4, coarsest=3, finest=40, table=64)
EDGES = np.array([1.0, 1.5, 2.0])


def lattice_of(border: float, size: tuple[int, int, int] = (5, 6, 7)) -> Lattice:
    contraction = "linf" if border else "none"
    space = Space(box_min=-0.5 * EDGES, box_max=0.5 * EDGES, contraction=contraction, border=border)
    return Lattice.over(space, size)


class Numbers(EncodingProblem):
    """A random hash of four levels, of which one has an entry for each node."""

    entries = "values"

    def __init__(
        self,
        width: int,
        n_floats: int,
        n_decoded: int,
        hidden: int,
        border: float = 0.0,
        active: int = 4,
    ) -> None:
        rng = np.random.default_rng(width + n_decoded)
        self.kind = replace(KIND, features=width, hidden=hidden)
        self.active, self.shapes = active, level_shapes(self.kind, lattice_of(border))
        assert [shape.is_hashed for shape in self.shapes] == [False, True, True, True]
        arrays = {
            "values": rng.normal(size=(self.shapes[-1].end, width)),
            "decoder": rng.normal(size=(hidden or 4 * width, max(16, n_floats))),
        }
        if hidden:
            arrays["hidden"] = rng.normal(size=(4 * width, hidden))
        hashed = loader("float64")("fields.hashed").hashed
        part = hashed(width, 4, n_floats, n_decoded, hidden=hidden)
        super().__init__(part, arrays, n_floats, n_decoded, border)

    def level(self, shape: LevelShape) -> Any:
        vec3 = loader("float64")("base.types").vec3
        level, middle = loader("float64")("fields.hashed").Level(), 0.5 * shape.edges
        level.size, level.middle = wp.vec3i(*shape.size), vec3(*middle)
        level.to_nodes = vec3(*(middle / (1.0 + self.border)))
        level.begin, level.mask = shape.begin, 60 if shape.is_hashed else 0
        return level

    def params(self, arrays: dict[str, np.ndarray]) -> Any:
        params, width = self.part.Params(), self.kind.features
        params.values = wp.array(arrays["values"], dtype=wp.types.vector(width, wp.float64))
        params.decoder = wp.array(arrays["decoder"].ravel(), dtype=wp.float64)
        if self.kind.hidden:
            params.hidden = wp.array(arrays["hidden"].ravel(), dtype=wp.float64)
        params.n_units = self.kind.hidden
        levels = [self.level(shape) for shape in self.shapes]
        params.levels = wp.array(levels, dtype=loader("float64")("fields.hashed").Level)
        params.n_active, params.width, params.n_decoded = self.active, width, self.n_decoded
        return params

    def oracle(self, given: dict[str, torch.Tensor]) -> torch.Tensor:
        read = self.shapes[: self.active]
        tables = [given["values"][shape.begin : shape.end] for shape in read]
        matrices = [given[name] for name in ("hidden", "decoder") if name in given]
        matrices[0] = matrices[0][: len(read) * self.kind.features]
        cells = [tuple(n * EDGES / EDGES.max()) for n in self.kind.resolutions][: len(read)]
        shares = 0.5 * (torch.tensor(self.points) / (1.0 + self.border) + 1.0)
        return raw_values(tables, cells, self.kind.table, matrices, shares)


@pytest.mark.parametrize("border", [0.0, 0.3])
@pytest.mark.parametrize("kind", KINDS)
def test_against_the_oracle(kind: tuple[int, int, int, int], border: float) -> None:
    Numbers(*kind, border=border).require_oracle()


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[3]])
def test_levels_that_are_not_active_count_as_0(kind: tuple[int, int, int, int]) -> None:
    numbers = Numbers(*kind, active=2)
    numbers.require_oracle()
    assert not numbers.touched[numbers.shapes[2].begin // 4 :].any()


@pytest.mark.parametrize("kind", KINDS)
def test_against_central_differences(kind: tuple[int, int, int, int]) -> None:
    Numbers(*kind).require_differences()


def test_flags_are_those_of_pairs() -> None:
    Numbers(*KINDS[0]).require_flags_of_pairs(most=16)


def test_levels_lie_one_behind_the_other() -> None:
    """A hashed row that begins last still ends before the next level begins."""
    kind = Hash(levels=5, coarsest=4, finest=64, table=1 << 10)
    shapes = level_shapes(kind, lattice_of(0.0))
    assert kind.resolutions == (4, 8, 16, 32, 64)
    assert [shape.is_hashed for shape in shapes] == [False, False, True, True, True]
    for shape, later in pairwise(shapes):
        last = (
            kind.table - 4
            if shape.is_hashed
            else (shape.size[0] * shape.size[1] - 1) * shape.size[2]
        )
        assert shape.begin + last + shape.size[2] <= shape.end <= later.begin
        assert later.begin % 16 == 0


def test_levels_are_read_as_the_lattice_grows() -> None:
    kind, workers = Hash(levels=5, coarsest=4, finest=64, table=1 << 10), Workers("cpu", 1)
    coarse, fine = (
        lattice_of(0.0, tuple(n + 1 for n in size)) for size in ((5, 7, 10), (20, 30, 40))
    )
    first = Hashed.first(kind, Deferred(), coarse, 0, workers.device)
    object.__setattr__(first, "density_scale", 1.0 / float(fine.voxel_size.min()))
    assert first.n_active == 3
    grown = first.resized(workers, fine)
    assert grown.n_active == 5 and grown.values is first.values
    moved = Lattice.over(
        Space(box_min=-0.4 * EDGES, box_max=0.5 * EDGES, contraction="none"), fine.size
    )
    with pytest.raises(ValueError, match="the box of a hash is fixed"):
        first.resized(workers, moved)


@pytest.mark.parametrize(("border", "hidden"), [(0.0, 0), (0.3, 0), (0.3, 32)])
def test_densities_at_nodes_are_what_is_read_there(border: float, hidden: int) -> None:
    kind, workers = replace(KIND, hidden=hidden), Workers("cpu", 2)
    stored = Hashed.first(kind, Deferred(), lattice_of(border), 0, workers.device)
    rng = np.random.default_rng(3)
    values = rng.normal(size=stored.values.numpy().shape).astype(np.float32)
    stored.values.assign(values)
    object.__setattr__(stored, "density_scale", 1.0 / float(stored.lattice.voxel_size.min()))
    shapes = level_shapes(kind, stored.lattice)
    tables = [torch.tensor(values[s.begin : s.end].astype(np.float64)) for s in shapes]
    cells = [tuple(n * EDGES / EDGES.max()) for n in kind.resolutions]
    stored_matrices = [x for name, x in stored.tensors().items() if name != "values"]
    matrices = [torch.tensor(x.astype(np.float64)) for x in stored_matrices]
    axes = [np.linspace(0.0, 1.0, n) for n in stored.lattice.size]
    shares = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    expected = raw_values(tables, cells, kind.table, matrices, torch.tensor(shares))[:, 0].numpy()
    assert_close(stored.raw_densities(workers).ravel(), expected, 2e-5)
