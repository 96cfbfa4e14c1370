"""The host's grid: its place in the world, growing it, and free cells."""

import math
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.types import vector

from tests import reference
from warpnerf.checks import InputError
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import cells_within, points_of
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.training_memory import require_memory
from warpnerf.model.models import Deferred, Rgb
from warpnerf.model.storage_kinds import DENSE
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.space import grid_size

MARCH = Steps(near=0.0, far=10.0, step=0.05).struct()
BOX_MIN, BOX_MAX = np.array([-1.0, 0.5, 2.0]), np.array([1.4, 2.0, 4.5])


@pytest.fixture(scope="module")
def workers(device: str) -> Workers:
    return Workers(device, 2)


def grid_of(values: Any, workers: Workers, **changes: Any) -> DenseGrid:
    size = values.shape[:3]
    array = wp.array(
        np.ascontiguousarray(values.reshape(-1, 4), np.float32),
        dtype=vector(4),
        device=workers.device,
    )
    return DenseGrid(values=array, lattice=lattice_of(size, **changes))


def lattice_of(size: Any, **changes: Any) -> Lattice:
    """In the box."""
    return Lattice(**{"size": size, "box_min": BOX_MIN, "box_max": BOX_MAX, **changes})


def numbers(grid: DenseGrid) -> Any:
    return grid.values.numpy().reshape(*grid.lattice.size, 4)


def nodes(size: Any, box_min: Any, box_max: Any) -> Any:
    """World positions of nodes [X, Y, Z, 3]."""
    index = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1)
    return box_min + index * (box_max - box_min) / (np.array(size) - 1)


@pytest.mark.parametrize("size", [(9, 7, 12), (4, 3, 2), (5, 4, 6)])
def test_resized_reads_the_field_at_the_new_nodes(size: Any, workers: Workers) -> None:
    values = np.random.default_rng(0).normal(size=(5, 4, 6, 4))
    grid = grid_of(values, workers).resized(workers, lattice_of(size))
    assert grid.lattice.size == size and np.array_equal(grid.lattice.box_max, BOX_MAX)
    points = torch.tensor(nodes(size, BOX_MIN, BOX_MAX))
    last = torch.tensor(values.shape[:3]) - 1
    u = reference.grid_coordinates(
        points, torch.tensor(BOX_MIN), torch.tensor(BOX_MAX), values.shape, "none", 0.0
    ).clamp(min=torch.zeros(3), max=last)
    expected = reference.trilinear(torch.tensor(values), u)
    np.testing.assert_allclose(numbers(grid), expected, atol=2e-6)
    if size == values.shape[:3]:
        np.testing.assert_allclose(numbers(grid), values, atol=2e-6)


def test_resized_into_a_part_of_the_box(workers: Workers) -> None:
    """A linear field stays itself."""
    slope = np.array([[1.0, 0.0, 2.0, -1.0], [0.5, 1.0, 0.0, 1.0], [-1.0, 2.0, 1.0, 0.0]])
    values = nodes((5, 6, 7), BOX_MIN, BOX_MAX) @ slope
    box = BOX_MIN + np.array([0.3, 0.1, 0.7]), BOX_MAX - np.array([0.2, 0.4, 0.1])
    grid = grid_of(values, workers).resized(
        workers, lattice_of((8, 4, 9), box_min=box[0], box_max=box[1])
    )
    assert np.array_equal(grid.lattice.box_min, box[0])
    np.testing.assert_allclose(numbers(grid), nodes((8, 4, 9), *box) @ slope, atol=3e-6)
    np.testing.assert_allclose(grid.lattice.voxel_size, (box[1] - box[0]) / [7, 3, 8])


def test_voxel_size_counts_the_shell(workers: Workers) -> None:
    lattice = lattice_of((5, 4, 6), contraction="linf", border=0.5)
    np.testing.assert_allclose(lattice.voxel_size, 1.5 * (BOX_MAX - BOX_MIN) / [4, 3, 5])


def test_grid_size_makes_cubes() -> None:
    for extent, voxels in [((1.0, 2.0, 3.0), 160**3), ((2.4, 1.5, 2.5), 5000)]:
        size = np.array(grid_size(np.array(extent), voxels))
        voxel = np.array(extent) / (size - 1)
        assert voxel.max() / voxel.min() < 1.1
        assert 0.8 < math.prod(size) / voxels < 1.6
    assert grid_size(np.array([1.0, 1.0, 1e-9]), 8)[2] == 2


def test_a_grid_larger_than_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("warpnerf.fields.training_memory.usable_memory", lambda: 48 * 10**3)
    cpu = wp.get_device("cpu")
    require_memory(DENSE, Rgb(), (10, 10, 10), cpu)
    require_memory(DENSE, Deferred(specular=4), (5, 10, 10), cpu)
    for size, model in (((10, 10, 11), Rgb()), ((5, 10, 11), Deferred(specular=4))):
        with pytest.raises(InputError, match=r"grid\.voxels: .* a grid of .* use fewer voxels"):
            require_memory(DENSE, model, size, cpu)
    with pytest.raises(InputError, match=r"grid\.voxels must give fewer than \d+ nodes"):
        require_memory(DENSE, Rgb(), (20000, 20000, 20000), cpu)


@pytest.mark.parametrize(("besides", "larger"), [(3.0, "grid.voxels"), (7.0, "rays_per_step")])
def test_what_fits_alone_may_be_too_large_together(
    besides: float, larger: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    gib = 2**30
    monkeypatch.setattr("warpnerf.fields.training_memory.usable_memory", lambda: 8 * gib)
    monkeypatch.setattr(type(DENSE), "training_bytes", lambda *_: 6 * gib)
    each = max(6.0, besides)
    says = rf"^{larger}: of the {6.0 + besides} GiB .* {each} GiB, but this machine has 8\.0 GiB"
    with pytest.raises(InputError, match=says):
        require_memory(DENSE, Rgb(), (9, 9, 9), wp.get_device("cpu"), int(besides * gib))


def test_free_cells_of_a_grid(workers: Workers) -> None:
    """Occupied around what is dense, and elsewhere the distance to it, in cells."""
    values = np.full((33, 21, 25, 4), -9.0)
    values[4:6, 10, 12] = 4.0
    free = FreeCells.of(grid_of(values, workers), workers, MARCH, alpha_min=1e-3)
    assert free.size == (16, 10, 12)
    distance = free.distance.numpy().reshape(free.size)
    occupied = np.argwhere(distance == 0)
    assert occupied.min(0).tolist() == [1, 4, 5] and occupied.max(0).tolist() == [3, 5, 6]
    cells = np.indices(free.size).reshape(3, -1).T
    expected = np.abs(cells[:, None] - occupied[None]).max(-1).min(-1)
    assert np.array_equal(distance.ravel(), np.minimum(expected, 9))
    assert math.isclose(free.share(), len(occupied) / 1920)
    low, high = free.occupied_range() or pytest.fail("nothing occupied")
    np.testing.assert_allclose(low, [1 / 16, 4 / 10, 5 / 12])
    np.testing.assert_allclose(high, [4 / 16, 6 / 10, 7 / 12])


def test_free_cells_at_the_limits(workers: Workers) -> None:
    empty = grid_of(np.full((9, 9, 9, 4), -20.0), workers)
    free = FreeCells.of(empty, workers, MARCH, alpha_min=1e-3)
    assert free.share() == 0.0 and free.occupied_range() is None
    assert (free.distance.numpy() == 9).all()
    assert FreeCells.none(workers).share() == 1.0


def test_a_crop_in_contracted_space_takes_cells_by_their_corners() -> None:
    lattice = lattice_of((21, 17, 19), contraction="linf", border=0.75)
    middle, half = 0.5 * (BOX_MIN + BOX_MAX), 0.5 * (BOX_MAX - BOX_MIN)
    low, high = middle - 2.5 * half, middle + half * [1.6, 2.5, 2.5]
    inside = cells_within(lattice, low, high)
    last = np.array(lattice.size) - 1
    cells = np.argwhere(inside)
    for corner in np.ndindex(2, 2, 2):
        points = points_of(lattice, (cells + corner) * last / np.array(inside.shape))
        assert (points >= low - 1e-4).all() and (points <= high + 1e-4).all()
    assert inside.any() and not inside[-1].any() and not inside[0].any()
    box = cells_within(lattice, BOX_MIN, BOX_MAX)
    assert box.sum() < inside.sum() < inside.size
