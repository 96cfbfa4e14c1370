"""Total variation and its adjoint."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.tiles import NODES_PER_THREAD, TILE
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from tests import reference
from tests.support.expected import assert_close, directional_differences
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS

each_n_floats = pytest.mark.parametrize("n_floats", [4, 16])


def problem(seed: int, n_floats: int = 4) -> tuple[Any, Any]:
    """A grid with differences on both sides of 1, and weights that differ by channel."""
    rng = np.random.default_rng(seed)
    size = rng.integers(2, (6, 6, 15), size=3)
    return rng.normal(size=(*size, n_floats)), rng.uniform(0.5, 2.0, size=n_floats)


def variation(kernels: Kernels, values: Any, weight: Any) -> float:
    n, n_floats = values[..., 0].size, values.shape[3]
    node = kernels.types.vector(n_floats)
    out = kernels.zeros(n)
    kernels.workers.launch(
        kernels.module("optim.total_variation").total_variation_forward_kernel(n_floats),
        n,
        kernels.array(values.reshape(n, n_floats), node),
        wp.vec3i(*values.shape[:3]),
        node(*weight),
        out,
    )
    return float(out.numpy().sum())


def adj_variation(
    kernels: Kernels,
    values: Any,
    weight: Any,
    already: Any,
    span: int = NODES_PER_THREAD,
    flags: Any = None,
    strength: Any = None,
) -> Any:
    """A gradient [n_nodes, n_floats], with that of total variation added."""
    n, n_floats = values[..., 0].size, values.shape[3]
    node = kernels.types.vector(n_floats)
    gradient = kernels.gradient(*already.shape, flag=1)
    gradient.values.assign(already)
    if flags is not None:
        gradient.touched.assign(np.asarray(flags, np.uint8))
    if strength is None:
        strength = np.ones(-(-n // TV_BLOCK))
    kernels.workers.launch(
        kernels.module("optim.total_variation").total_variation_backward_kernel(n_floats),
        -(-n // span),
        span,
        kernels.array(values.reshape(n, n_floats), node),
        wp.vec3i(*values.shape[:3]),
        node(*weight),
        kernels.array(strength),
        gradient,
    )
    return gradient.values.numpy()


@each_n_floats
def test_value_and_adjoint_against_the_oracle(n_floats: int, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        values, weight = problem(seed, n_floats)
        raw = torch.tensor(values, requires_grad=True)
        expected = reference.total_variation(raw, torch.tensor(weight))
        assert_close(variation(kernels64, values, weight), expected.item(), 1e-13)
        (gradient,) = torch.autograd.grad(expected, raw)
        steps = np.concatenate([np.abs(np.diff(values, axis=a)).ravel() for a in range(3)])
        assert (steps < 1.0).any() and (steps > 1.0).any()
        already = np.random.default_rng(seed).normal(size=(values[..., 0].size, n_floats))
        added = adj_variation(kernels64, values, weight, already) - already
        assert_close(added.reshape(values.shape), gradient, 1e-12)


@each_n_floats
def test_adjoint_against_central_differences(n_floats: int, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        values, weight = problem(seed, n_floats)
        directions = np.random.default_rng(seed).normal(size=(5, *values.shape))
        # A small h: the slope of huber has a kink at 1, which few pairs may cross.
        expected = directional_differences(
            lambda v, weight=weight: variation(kernels64, v, weight), values, directions, h=1e-6
        )
        ones = np.ones((values[..., 0].size, n_floats))
        added = (adj_variation(kernels64, values, weight, ones) - ones).reshape(values.shape)
        assert_close(np.tensordot(directions, added, axes=4), expected, 1e-7)


@each_n_floats
def test_only_nodes_with_a_gradient_are_touched(n_floats: int, kernels64: Kernels) -> None:
    """A node counts as touched when there is a gradient in any channel."""
    for seed in range(N_SEEDS):
        values, weight = problem(seed, n_floats)
        n = values[..., 0].size
        rng = np.random.default_rng(seed)
        already = np.zeros((n, n_floats))
        touched = rng.uniform(size=n) < 0.5
        touched[0] = True
        for node in np.flatnonzero(touched):
            already[node, rng.integers(n_floats)] = rng.normal()
        full = adj_variation(kernels64, values, weight, np.ones((n, n_floats))) - 1.0
        after = adj_variation(kernels64, values, weight, already)
        assert not after[~touched].any()
        assert_close((after - already)[touched], full[touched], 1e-12)


@each_n_floats
def test_each_run_of_nodes_has_its_strength(
    n_floats: int, kernels64: Kernels, kernels32: Kernels
) -> None:
    """In whole tiles and node by node; a pair across two runs pulls each node by its own."""
    rng = np.random.default_rng(7)
    values, weight = rng.normal(size=(5, 6, 21, n_floats)), rng.uniform(0.5, 2.0, size=n_floats)
    n = values[..., 0].size
    ones, strength = np.ones((n, n_floats)), rng.uniform(0.1, 1.0, size=-(-n // TV_BLOCK))
    raw = torch.tensor(values, requires_grad=True)
    reference.total_variation(raw, torch.tensor(weight)).backward()
    assert raw.grad is not None
    expected = raw.grad.numpy().reshape(n, n_floats) * np.repeat(strength, TV_BLOCK)[:n, None]
    for kernels, tolerance in ((kernels64, 1e-12), (kernels32, 1e-6)):
        for span in (1, TILE, NODES_PER_THREAD):
            after = adj_variation(kernels, values, weight, ones, span, strength=strength)
            assert_close(after - 1.0, expected, tolerance)


def test_float32_against_float64(kernels64: Kernels, device: str) -> None:
    for seed in range(N_SEEDS):
        values, weight = problem(seed)
        ones = np.ones((values[..., 0].size, 4))
        in_float32 = adj_variation(Kernels("float32", device), values, weight, ones)
        assert_close(in_float32, adj_variation(kernels64, values, weight, ones), 1e-6)


@each_n_floats
def test_tiles_that_are_not_flagged_are_passed_over(n_floats: int, kernels64: Kernels) -> None:
    rng = np.random.default_rng(3)
    values, weight = rng.normal(size=(4, 5, 7, n_floats)), np.ones(n_floats)
    ones = np.ones((140, n_floats))
    full = adj_variation(kernels64, values, weight, ones)
    flags = np.arange(140 // TILE) % 4 == 0
    # The first node of the next tile may have been added to as well.
    flagged = np.repeat(flags | np.roll(flags, 1), TILE)[:140]
    for span in (1, TILE, 48):
        after = adj_variation(kernels64, values, weight, ones, span, flags)
        assert np.array_equal(after[flagged], full[flagged])
        assert (after[~flagged] == 1.0).all()


def test_a_flat_grid_has_none(kernels64: Kernels) -> None:
    flat = np.full((3, 4, 5, 4), 0.7)
    assert variation(kernels64, flat, np.ones(4)) == 0.0
    ones = np.ones((60, 4))
    assert np.array_equal(adj_variation(kernels64, flat, np.ones(4), ones), ones)
