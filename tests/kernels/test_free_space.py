"""Free space: the distances, what counts as occupied, and that skipping it is exact."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from tests.support.expected import assert_close, oracle, oracle_gradient
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS, Problem, in_frustum, make_problem, unbounded
from warpnerf.model.spaces import part_of
from warpnerf.rendering.steps import Steps

FAR = 8


def chessboard(occupied: Any) -> Any:
    """Cells from each cell to the nearest occupied one, the largest component; at most FAR + 1."""
    where = np.argwhere(occupied)
    if len(where) == occupied.size:
        return np.zeros(occupied.shape, np.uint8)
    cells = np.indices(occupied.shape).reshape(3, -1).T
    if not len(where):
        return np.full(occupied.shape, FAR + 1, np.uint8)
    distance = np.abs(cells[:, None] - where[None]).max(-1).min(-1)
    return np.minimum(distance, FAR + 1).reshape(occupied.shape).astype(np.uint8)


def spread(kernels: Kernels, occupied: Any, span: int = 1) -> Any:
    distance = wp.array(
        np.where(occupied, 0, FAR + 1).astype(np.uint8).ravel(),
        dtype=wp.uint8,
        device=kernels.device,
    )
    for axis in range(3):
        out = wp.empty_like(distance)
        kernels.workers.launch(
            kernels.module("sampling.occupancy").spread_distance,
            occupied.size // span,
            span,
            distance,
            wp.vec3i(*occupied.shape),
            axis,
            out,
        )
        distance = out
    return distance.numpy().reshape(occupied.shape)


def random_mask(seed: int, largest: int = 14) -> Any:
    """A few occupied cells in a block of random size."""
    rng = np.random.default_rng(500 + seed)
    shape = rng.integers(1, largest, size=3)
    return rng.uniform(size=shape) < rng.choice([0.002, 0.01, 0.1, 0.5])


def test_distance_is_the_chessboard_distance(kernels64: Kernels) -> None:
    largest = 0
    for seed in range(3 * N_SEEDS):
        occupied = random_mask(seed, 20)
        expected = chessboard(occupied)
        largest = max(largest, int(expected[expected <= FAR].max(initial=0)))
        for span in (1, occupied.shape[2]):
            assert np.array_equal(spread(kernels64, occupied, span), expected)
    assert largest == FAR  # far ones occurred


def with_free_space(p: Problem, seed: int) -> Problem:
    occupied = random_mask(seed)
    return replace(p, free=chessboard(occupied))


@pytest.mark.parametrize("jitter", [False, True])
@pytest.mark.parametrize("contraction", ["none", "linf", "l2", "ndc"])
def test_skipping_visits_what_a_test_of_each_sample_keeps(
    contraction: str, jitter: bool, kernels64: Kernels
) -> None:
    """Distances above 1 let the kernel leap; the oracle looks the mask up at every sample."""
    leaps = visited = 0
    for seed in range(N_SEEDS):
        p = make_problem(seed, n_rays=16, density_scale=0.2)
        p = replace(p, steps=replace(p.steps, step=0.031))
        if contraction == "ndc":
            p = in_frustum(p, seed)
            p = replace(p, steps=replace(p.steps, step=0.017))
        elif contraction != "none":
            border = float(np.random.default_rng(seed).uniform(0.1, 1.0))
            p = unbounded(p, contraction, border)
            p = replace(p, steps=Steps(near=0.02, far=50.0, step=0.05, n_linear=30, growth=0.05))
        p = with_free_space(p, seed)
        if jitter:
            offsets = np.random.default_rng(seed).uniform(size=p.n_rays)
            p = replace(p, offsets=offsets)
        theirs = oracle(p, torch.tensor(p.raw))
        ours = kernels64.forward(p)
        assert np.array_equal(ours.n_samples, theirs.kept.sum(1).numpy())
        np.testing.assert_allclose(ours.depth, theirs.depth, rtol=1e-10, atol=1e-13)
        np.testing.assert_allclose(ours.rgb, theirs.rgb, rtol=1e-10)
        # and the same distances cut to 1, which never leap over more than a cell
        short = kernels64.forward(replace(p, free=np.minimum(p.free, 1)))
        assert np.array_equal(short.rgb, ours.rgb) and np.array_equal(short.depth, ours.depth)
        leaps += int((p.free > 2).sum())
        visited += int(ours.n_samples.sum())
        if ours.n_samples.sum() > 50:
            assert_close(kernels64.backward(p), oracle_gradient(p), 1e-9)
    assert leaps > 1000 and visited > 1000


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_skipping_in_float32_changes_no_bit(contraction: str, kernels32: Kernels) -> None:
    """Against the same free space told one cell at a time, over many more samples."""
    for seed in range(N_SEEDS // 2):
        p = make_problem(seed, n_rays=400, density_scale=0.2)
        p = replace(p, steps=replace(p.steps, step=0.017))
        if contraction != "none":
            p = unbounded(p, contraction, 0.2)
            p = replace(p, steps=Steps(near=0.02, far=50.0, step=0.02, n_linear=60, growth=0.02))
        p = with_free_space(p, seed)
        leaping = kernels32.forward(p)
        short = kernels32.forward(replace(p, free=np.minimum(p.free, 1)))
        assert np.array_equal(short.n_samples, leaping.n_samples)
        assert np.array_equal(short.rgb, leaping.rgb)


def mark(
    kernels: Kernels, p: Problem, cells: Any, steps: Steps, alpha_min: float, margin: int = 1
) -> Any:
    """By threads for a cell each, and for a row each."""
    by_cell, by_row = (
        marked_by(kernels, p, tuple(map(int, cells)), steps, alpha_min, margin, span)
        for span in (1, int(cells[2]))
    )
    assert np.array_equal(by_cell, by_row)
    return by_row


def marked_by(
    kernels: Kernels,
    p: Problem,
    cells: tuple[int, int, int],
    steps: Steps,
    alpha_min: float,
    margin: int,
    span: int,
) -> Any:
    occupancy, bound = kernels.module("sampling.occupancy"), kernels.module("fields.dense_bound")
    grid = kernels.grid(p)

    def launch(kernel: wp.Kernel, shape: tuple[int, ...], *arguments: Any) -> Any:
        out = kernels.zeros(int(np.prod(shape)))
        kernels.workers.launch(kernel, out.size // span, span, *arguments, out)
        return out

    x, y, _ = p.raw.shape[:3]
    of_columns = bound.find_highest_kernel(p.raw.shape[3])
    highest = launch(of_columns, (x, y, cells[2]), grid, cells[2], margin)
    join = bound.join_highest
    highest = launch(join, (x, *cells[1:]), highest, y, cells[1], cells[2], margin)
    highest = launch(join, cells, highest, x, cells[0], cells[1] * cells[2], margin)
    out = wp.zeros(highest.size, dtype=wp.uint8, device=kernels.device)
    kernels.workers.launch(
        occupancy.mark_occupied_kernel(
            kernels.module("sampling.steps").STEPS, part_of(p.contraction, kernels.precision)
        ),
        highest.size // span,
        span,
        kernels.box(p),
        kernels.density(p),
        highest,
        wp.vec3i(*cells),
        steps.struct(kernels.module("sampling.steps")),
        alpha_min,
        out,
    )
    return out.numpy().reshape(cells)


@pytest.mark.parametrize("margin", [0, 1, 2])
def test_marked_cells(margin: int, kernels64: Kernels) -> None:
    """A cell is free if and only if no node in it or so many next to it could be seen."""
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        size, cells = rng.integers(3, 12, size=3), rng.integers(1, 7, size=3)
        raw = np.full((*size, 4), -12.0)
        raw[tuple(rng.integers(0, size))] = 3.0
        p = make_problem(seed, raw=raw, density_scale=2.0)
        marked = mark(kernels64, p, cells, replace(p.steps, step=0.1), 1e-3, margin)
        assert set(np.unique(marked)) <= {0, FAR + 1}
        node = np.argwhere(raw[..., 0] > 0)[0]
        for cell in np.ndindex(*cells):
            low = np.array(cell) * (size - 1) / cells
            high = (np.array(cell) + 1) * (size - 1) / cells
            near = (np.floor(low) - margin <= node) & (node <= np.ceil(high) + margin)
            assert (marked[cell] == 0) == near.all()


def test_what_is_not_a_number_is_not_free(kernels64: Kernels) -> None:
    raw = np.full((5, 5, 5, 4), -12.0)
    steps = Steps(near=0.0, far=9.0, step=0.1)
    raw[2, 2, 2, 0] = np.nan
    marked = mark(kernels64, make_problem(0, raw=raw), (4, 4, 4), steps, 1e-3)
    assert (marked[1:3, 1:3, 1:3] == 0).all()
    raw[2, 2, 2, 0] = -12.0
    marked = mark(kernels64, make_problem(0, raw=raw), (4, 4, 4), steps, 1e-3)
    assert (marked > 0).all()


def test_threshold_is_of_alpha(kernels64: Kernels) -> None:
    shift, factor, step = 0.3, 2.0, 0.1
    raw = np.full((3, 3, 3, 4), -1.0)
    p = make_problem(0, raw=raw, density_shift=shift, density_scale=factor)
    alpha = 1.0 - np.exp(-factor * np.log1p(np.exp(-1.0 + shift)) * step)
    steps = replace(p.steps, step=step)
    assert (mark(kernels64, p, (2, 2, 2), steps, alpha * (1.0 - 1e-6)) == 0).all()
    assert (mark(kernels64, p, (2, 2, 2), steps, alpha * (1.0 + 1e-6)) == FAR + 1).all()


@pytest.mark.parametrize("margin", [0, 1])
def test_what_free_space_hides_is_below_the_threshold(margin: int, kernels64: Kernels) -> None:
    """A render with marked cells differs by at most n_steps times alpha_min."""
    for seed in range(5):
        p = make_problem(seed, size=(17, 16, 18), n_rays=50)
        raw = p.raw - [9.0, 0.0, 0.0, 0.0]
        raw[tuple(np.random.default_rng(seed).integers(4, 12, size=(3, 9)))] += 12.0
        p = replace(p, raw=raw)
        alpha_min = 0.01
        marked = mark(kernels64, p, (8, 7, 8), p.steps, alpha_min, margin) == 0
        assert 0 < marked.sum() < marked.size
        skipped = kernels64.forward(replace(p, free=spread(kernels64, marked)))
        full = kernels64.forward(p)
        hidden = full.n_samples - skipped.n_samples
        assert hidden.sum() > 0
        assert (np.abs(full.opacity - skipped.opacity) <= hidden * alpha_min).all()


@pytest.mark.parametrize(("contraction", "border"), [("linf", 0.2), ("l2", 0.8)])
def test_alpha_is_judged_over_the_longer_steps_of_folded_space(
    contraction: str, border: float, kernels64: Kernels
) -> None:
    """Of a thin medium all around, what is hidden is below the threshold even where steps grow."""
    hidden, visible_outside = 0, 0
    for seed in range(N_SEEDS):
        p = unbounded(make_problem(seed, size=(25, 26, 24), n_rays=60), contraction, border)
        p = replace(p, steps=Steps(near=0.0, far=60.0, step=0.05, n_linear=80, growth=0.06))
        p = replace(p, raw=p.raw - [7.0, 0.0, 0.0, 0.0])
        alpha_min = 1e-3
        marked = mark(kernels64, p, (12, 12, 12), p.steps, alpha_min) == 0
        plain = mark(kernels64, p, (12, 12, 12), replace(p.steps, growth=0.0), alpha_min) == 0
        assert marked[plain].all() and not plain[marked].all()
        skipped = kernels64.forward(replace(p, free=spread(kernels64, marked)))
        full = kernels64.forward(p)
        assert (
            np.abs(full.opacity - skipped.opacity)
            <= (full.n_samples - skipped.n_samples) * alpha_min
        ).all()
        hidden += int((full.n_samples - skipped.n_samples).sum())
        visible_outside += int((marked & ~plain).sum())
    assert hidden > 0 and visible_outside > 0
