"""Which worker takes which rays, and in which order."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.types import vec3
from warpnerf_kernels.cpu import schedule

from tests import reference
from tests.kernels.test_scatter import most_steps, of, problem
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.problems import Problem, unbounded, unit
from tests.support.unwritten import leave_chunks_unwritten
from warpnerf.rendering import adjoint
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """CUDA takes rays as they come."""
    leave_chunks_unwritten(monkeypatch)


def indices_of(cell: Any) -> np.ndarray:
    """Of cells [...], along the three axes [..., 3]: their bits in turn, x's first."""
    bits = (np.asarray(cell)[..., None] >> np.arange(3 * schedule.BITS)[::-1]) & 1
    places = 2 ** np.arange(schedule.BITS)[::-1]
    return np.stack([(bits[..., axis::3] * places).sum(-1) for axis in range(3)], axis=-1)


def middles(p: Problem) -> np.ndarray:
    """Where rays have half of their steps behind them [n_rays, 3], in shares of the grid."""
    at = reference.sample_distances(
        p.steps.near, p.steps.far, p.steps.step, p.steps.growth, p.steps.n_linear, most_steps(p)
    )
    points = p.origins[:, None] + at.t.numpy()[:, None] * p.directions[:, None]
    box_min, box_max = torch.tensor(p.box_min), torch.tensor(p.box_max)
    u = reference.grid_coordinates(
        torch.tensor(points), box_min, box_max, p.raw.shape, p.contraction, p.border
    ).numpy() / (np.array(p.raw.shape[:3]) - 1)
    inside = ((u >= 0) & (u <= 1)).all(axis=2) & at.before_far.numpy()
    return np.array(
        [points[found][found.sum() // 2] for points, found in zip(u, inside, strict=True)]
    )


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_each_worker_has_the_rays_nearest_its_part_cell_by_cell(
    contraction: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = problem(4)
    if contraction != "none":
        steps = Steps(near=0.07, far=40.0, step=0.03, n_linear=60, growth=0.02)
        p = replace(unbounded(p, contraction, 0.2), steps=steps)
    met = of(1).forward(p).n_samples > 3
    p = replace(p, origins=p.origins[met], directions=p.directions[met])
    p = replace(
        p,
        background=p.background[:1],
        **{
            name: getattr(p, name)[met]
            for name in ("target", "adj_rgb", "adj_opacity", "adj_depth")
        },
    )
    if threads > 1:
        monkeypatch.setattr(adjoint, "RECORDS", 32 * (p.n_rays * most_steps(p) // 2))
    middle, off = middles(p), 0.06  # which of two steps is the middle one does not count
    chunks = chunks_of(lambda: of(threads).backward(p), monkeypatch)
    assert len(chunks) >= 2 if threads > 1 else len(chunks) == 1
    first = 0
    for chunk, cells in chunks:
        assert np.abs((indices_of(cells) + 0.5) / schedule.ACROSS - middle).max() < off + 1 / 32
        assert len(chunk) == threads
        rays = np.concatenate(chunk)
        assert sorted(rays) == list(range(first, first + len(rays)))
        first += len(rays)
        for share, following in itertools.pairwise(chunk):
            most, least = middle[share, 0].max(), middle[following, 0].min()
            assert most <= least + off + 1 / schedule.ACROSS
        for share in chunk:
            # Rays of a cell stay in order.
            assert np.array_equal(share, share[np.lexsort((share, cells[share]))])
    assert first == p.n_rays


Shares = tuple[list[np.ndarray], np.ndarray]
"""The rays of each worker, and the cells of all rays."""


def chunks_of(launch: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> list[Shares]:
    """The chunks of what is launched."""
    chunks = []
    launch_owned = Workers.launch_owned

    def spy(
        workers: Workers, kernel: wp.Kernel, items: Any, *arguments: Any, **packed: Any
    ) -> None:
        launch_owned(workers, kernel, items, *arguments, **packed)
        if "backward" not in kernel.key:
            return
        chunk = arguments[-1].chunk
        rays, following = chunk.rays.numpy(), int(chunk.next.numpy()[0])
        assert chunk.begin < following <= chunk.end
        shares = [row[: int((row >= 0).sum())].copy() for row in rays]
        rays.fill(-1)
        chunks.append((shares, chunk.cells.numpy().copy()))

    monkeypatch.setattr(Workers, "launch_owned", spy)
    launch()
    return chunks


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_rays_that_are_not_finite_are_someone_s(contraction: str) -> None:
    p = problem(9)
    if contraction != "none":
        p = unbounded(p, contraction, 0.2)
    p.directions[:30] = np.nan
    p.directions[30:60, 0] = np.inf
    p.origins[60:90, 0] = -np.inf
    plain = Kernels("float32", "cpu").backward(p)
    for threads in (1, 2):
        assert_close(of(threads).backward(p), plain, 1e-5)


@wp.kernel(enable_backward=False)
def cells_at(positions: wp.array(dtype=vec3), out_cell: wp.array(dtype=wp.int32)):
    i = wp.tid()
    out_cell[i] = schedule.cell_at(positions[i])


def test_cells_are_numbered_along_a_curve() -> None:
    """All of them, from just inside; what lies at their borders, beyond the grid, or nowhere."""
    cells = np.arange(schedule.CELLS)
    index = indices_of(cells)
    assert len(np.unique(index, axis=0)) == schedule.CELLS
    inside = [(index + share) / schedule.ACROSS for share in (1e-3, 0.5, 1 - 1e-3)]
    outside = [[1, 1, 1], [0, 1, 2], [np.inf, -np.inf, -0.2], [np.nan, 0.5, np.nan]]
    last, half = schedule.ACROSS - 1, schedule.ACROSS // 2
    expected = [[last, last, last], [0, last, last], [last, 0, 0], [0, half, 0]]
    positions = np.concatenate([*inside, outside]).astype(np.float32)
    out = wp.zeros(len(positions), dtype=wp.int32, device="cpu")
    given = wp.array(positions, dtype=vec3, device="cpu")
    wp.launch(cells_at, len(positions), inputs=[given, out], device="cpu")
    found = out.numpy()
    assert np.array_equal(found[: 3 * schedule.CELLS], np.tile(cells, 3))
    assert np.array_equal(indices_of(found[3 * schedule.CELLS :]), expected)


@wp.kernel(enable_backward=False)
def select_rays(worker: int, chunk: schedule.Chunk, out_n: wp.array(dtype=wp.int32)):
    out_n[0] = schedule.select_rays(worker, chunk)


@pytest.mark.parametrize("n_workers", [1, 2, 3, 7])
@pytest.mark.parametrize("largest", [20, 1 << 30])
def test_rays_are_shared_out_by_slab_and_work(largest: int, n_workers: int) -> None:
    """Against sorting: rays of more work than there is room for, and many in the same cell."""
    rng = np.random.default_rng(n_workers)
    n, begin, most_work = 200, 17, 900 * largest // 20
    work = rng.integers(1, largest, n)
    work[[begin, 150]] = 2 * most_work if largest == 20 else 2**31 - 1
    cell = rng.integers(0, schedule.CELLS, n)
    cell[::2] = rng.choice([0, 5, schedule.CELLS - 1], n // 2)
    slab = indices_of(cell)[:, 0]
    following, rays = np.zeros(1, np.int32), np.full((n_workers, n), -1, np.int32)
    count = wp.zeros(1, dtype=wp.int32, device="cpu")
    arrays = {
        "work": work.astype(np.int32),
        "cells": cell.astype(np.int32),
        "next": following,
        "work_before": np.full((n_workers, schedule.ACROSS), 99, np.int64),
        "rays_before": np.full((n_workers, schedule.CELLS), 99, np.int32),
        "candidates": np.zeros((n_workers, n), np.int32),
        "rays": rays,
    }
    chunk = schedule.Chunk()
    chunk.end, chunk.most_work = n, most_work
    for name, array in arrays.items():
        setattr(chunk, name, wp.array(array, device="cpu", copy=False))
    while begin < n:
        until = np.cumsum(work[begin:])
        end = begin + max(1, int((until <= most_work).sum()))
        chunk.begin = begin
        rays.fill(-1)
        by_slab = begin + np.argsort(slab[begin:end], kind="stable")
        until = np.cumsum(work[by_slab]) - work[by_slab]
        owner = np.full(n, -1)
        owner[by_slab] = until * n_workers // work[by_slab].sum()
        rows = [arrays[name] for name in ("work_before", "rays_before", "candidates", "rays")]
        for worker in reversed(range(n_workers)):
            others = [np.delete(array, worker, axis=0) for array in rows]
            wp.launch(select_rays, 1, inputs=[worker, chunk, count], device="cpu")
            for array, before in zip(rows, others, strict=True):
                assert np.array_equal(np.delete(array, worker, axis=0), before)
            own, n_own = np.flatnonzero(owner == worker), int(count.numpy()[0])
            assert np.array_equal(rays[worker, :n_own], own[np.argsort(cell[own], kind="stable")])
            assert (rays[worker, n_own:] == -1).all()
        assert following == end
        begin = end


@pytest.mark.parametrize("threads", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.1, 9.0])
def test_each_worker_has_as_much_work(
    distance: float, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras at one end of the box, whose rays often miss it, and one on the other side of it."""
    p = replace(problem(6), steps=Steps(near=0.0, far=20.0, step=0.04))
    rng = np.random.default_rng(6)
    middle = 0.5 * (p.box_min + p.box_max)
    p.origins[:] = p.box_max + 0.1
    p.directions[:] = unit(rng.normal(size=p.directions.shape))
    p.directions[::3] = unit(middle - p.origins[::3])
    p.origins[1::3] = middle - (distance, 0.5, 0.5)
    p.directions[1::3] = unit(middle - (0.3, 0, 0) - p.origins[1::3])
    steps = of(1).forward(p).n_samples
    assert 0.5 < (steps > 0).mean() < 0.9
    ((chunk, _),) = chunks_of(lambda: of(threads).backward(p), monkeypatch)
    work = np.array([steps[share].sum() for share in chunk])
    assert work.max() < 1.2 * work.mean()
