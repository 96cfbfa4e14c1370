"""The update of the grid against the oracle, and how it keeps moments in 16 bits."""

from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.tiles import NODES_PER_THREAD, TILE

from tests import reference
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS
from warpnerf.optim_config import OptimConfig
from warpnerf.training.optim import Update, adam_struct

RATES = np.array([0.2, 0.1, 0.05, 0.02, 0.3, 0.01, 0.15, 0.07])
"""Of the first numbers of a node."""
BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-4
MEAN_BIT, SQUARE_BIT = 2.0**-7, 2.0**-8
"""What the last bit of a moment may be worth, of the moment."""


each_n_floats = pytest.mark.parametrize("n_floats", [4, 8])


@pytest.fixture(scope="module")
def kernels(device: str) -> Kernels:
    return Kernels("float32", device)


def decoded(moments: Any) -> tuple[Any, Any]:
    """Mean and square [...] of moments [...]: a bfloat16, and one without a sign."""
    mean = (moments & np.uint32(0xFFFF0000)).view(np.float32)
    square = ((moments & np.uint32(0xFFFF)) << np.uint32(15)).view(np.float32)
    return mean.astype(float), square.astype(float)


def encoded(mean: Any, square: Any) -> Any:
    """Moments of numbers, the rest of whose bits is dropped."""
    bits = [np.asarray(a, np.float32).view(np.uint32) for a in (mean, square)]
    return (bits[0] & np.uint32(0xFFFF0000)) | (bits[1] >> np.uint32(15))


def step(
    kernels: Kernels,
    number: int,
    adj: Any,
    values: Any,
    moments: Any,
    span: int = NODES_PER_THREAD,
    flags: Any = None,
    betas: tuple[float, float] = (BETA1, BETA2),
    n_nodes: int | None = None,
    decay: Any = (),
) -> tuple[Any, Any, Any]:
    """What is left of the gradient, and the new values and moments, all [n_nodes, n_floats]."""
    n_floats, adam = adj.shape[1], kernels.module("optim.adam")
    node, moments_type = kernels.types.vector(n_floats), adam.moments_type(n_floats)
    gradient = kernels.gradient(*adj.shape, flag=1)
    gradient.values.assign(adj)
    if flags is not None:
        gradient.touched.assign(np.asarray(flags, np.uint8))
    arrays = (
        kernels.array(values, node),
        wp.array(moments, dtype=moments_type, device=kernels.device),
    )
    kernels.workers.launch(
        adam.adam_kernel(n_floats, decays=len(decay) > 0),
        -(-(n_nodes or len(values)) // span),
        span,
        number,
        node(*RATES[:n_floats]),
        kernels.array(decay),
        adam_struct(
            Update(number, 1.0, OptimConfig(beta1=betas[0], beta2=betas[1], epsilon=EPSILON))
        ),
        gradient,
        *(array[:n_nodes] for array in arrays),
    )
    values, moments = (a.numpy() for a in arrays)
    return gradient.values.numpy(), values, moments


@each_n_floats
def test_against_the_oracle_skipping_exact_zeros(n_floats: int, kernels: Kernels) -> None:
    shape = (30, n_floats)
    for seed in range(N_SEEDS):
        rng = np.random.default_rng(seed)
        values = rng.normal(size=shape).astype(np.float32)
        moments = np.zeros(shape, np.uint32)
        for number in range(1, 6):
            adj = rng.normal(size=shape) * 10.0 ** rng.uniform(-7, 0, size=shape)
            adj[rng.uniform(size=shape) < 0.3] = 0.0
            adj[:3] = 0.0  # whole nodes as well
            adj = adj.astype(np.float32)
            before = values, moments
            after, values, moments = step(kernels, number, adj, *before)
            assert not after.any()
            tensors = [torch.tensor(a.astype(float)) for a in (before[0], *decoded(before[1]), adj)]
            value, mean, square = reference.adam(
                *tensors, number, torch.tensor(RATES[:n_floats]), BETA1, BETA2, EPSILON
            )
            still = adj == 0.0
            assert still.any() and not still.all()
            for new, old in zip((values, moments), before, strict=True):
                assert np.array_equal(new[still], old[still])
                assert (new[~still] != old[~still]).mean() > 0.9
            change = np.abs(value.numpy() - before[0])
            assert (np.abs(values - value.numpy()) <= 4e-6 * change + 3e-7).all()
            found = decoded(moments)
            for new, exact, bit in zip(found, (mean, square), (MEAN_BIT, SQUARE_BIT), strict=True):
                assert (np.abs(new - exact.numpy()) <= bit * np.abs(exact.numpy())).all()


@each_n_floats
def test_nothing_behind_the_last_node_is_touched(n_floats: int, kernels: Kernels) -> None:
    rng = np.random.default_rng(5)
    for n in (29, 30, 31):  # in tiles of four
        adj, values = rng.normal(size=(2, 32, n_floats)).astype(np.float32)
        moments = encoded(rng.normal(size=(32, n_floats)), rng.uniform(size=(32, n_floats)))
        expected = step(kernels, 1, adj, values, moments)[1:]
        found = step(kernels, 1, adj, values, moments, n_nodes=n)[1:]
        for new, exact, old in zip(found, expected, (values, moments), strict=True):
            assert np.array_equal(new[:n], exact[:n])
            assert np.array_equal(new[n:], old[n:])


def test_gradients_of_minus_zero_move_nothing(kernels: Kernels) -> None:
    values = np.random.default_rng(6).normal(size=(8, 4)).astype(np.float32)
    moments = encoded(np.ones((8, 4)), np.ones((8, 4)))
    after, *found = step(kernels, 1, np.full((8, 4), -0.0, np.float32), values, moments)
    assert not after.any()
    for new, old in zip(found, (values, moments), strict=True):
        assert np.array_equal(new, old)


@pytest.mark.parametrize("alike", [False, True])
def test_moments_are_right_on_average(alike: bool, kernels: Kernels) -> None:
    """A step moves them by less than half of their last bit; and if all gradients are alike?"""
    n, steps, beta = 500, 600, 0.999
    rng = np.random.default_rng(0)
    moments = encoded(np.full((n, 4), 1.0), np.full((n, 4), 4.0))
    for number in range(1, steps + 1):
        adj = np.full((n, 4), -0.75) if alike else rng.normal(-0.75, 0.01, size=(n, 4))
        moments = step(kernels, number, adj, np.zeros((n, 4)), moments, betas=(beta, beta))[2]
    mean, square = decoded(moments)
    left = beta**steps
    np.testing.assert_allclose(mean.mean(axis=0), -0.75 + 1.75 * left, atol=0.03)
    np.testing.assert_allclose(square.mean(axis=0), 0.5626 + (4.0 - 0.5626) * left, atol=0.03)
    if not alike:  # and no two entries are rounded alike
        np.testing.assert_allclose(mean.mean(), -0.75 + 1.75 * left, atol=0.002)
        np.testing.assert_allclose(square.mean(), 0.5626 + (4.0 - 0.5626) * left, atol=0.003)
        assert abs(np.corrcoef(mean.T)[0, 1:]).max() < 0.2
        assert abs(np.corrcoef(mean.ravel(), square.ravel())[0, 1]) < 0.1


def test_many_steps_end_where_full_precision_does(kernels: Kernels) -> None:
    """Of a valley with noise: each entry seeks a minimum of its own."""
    rng = np.random.default_rng(1)
    goal, n = rng.normal(size=(200, 4)), 200
    values, moments = np.zeros((n, 4)), np.zeros((n, 4), np.uint32)
    exact = [torch.zeros((n, 4), dtype=torch.float64) for _ in range(3)]
    for number in range(1, 41):
        noise = rng.normal(size=(n, 4))
        values, moments = step(kernels, number, values - goal + noise, values, moments)[1:]
        exact = list(
            reference.adam(
                *exact,
                exact[0] - torch.tensor(goal - noise),
                number,
                torch.tensor(RATES[:4]),
                BETA1,
                BETA2,
                EPSILON,
            )
        )
    off = np.abs(values - exact[0].numpy())
    assert (off.mean(axis=0) < 0.05 * RATES[:4]).all() and off.mean() > 1e-5  # moments do matter


@each_n_floats
def test_tiles_that_are_not_flagged_are_passed_over(n_floats: int, kernels: Kernels) -> None:
    rng = np.random.default_rng(4)
    adj, values = rng.normal(size=(2, 100, n_floats)).astype(np.float32)
    moments = encoded(rng.normal(size=(100, n_floats)), rng.uniform(size=(100, n_floats)))
    for every in (5, 10):  # eight tiles after a flagged one hold another, or none
        flags = np.arange(100 // TILE) % every == 2
        # The first node of the next tile may have been added to as well.
        flagged = np.repeat(flags | np.roll(flags, 1), TILE)
        counted = np.where(flagged[:, None], adj, 0.0)
        expected = step(kernels, 1, counted, values, moments)
        for span in (1, TILE, 48, 100):
            found = step(kernels, 1, adj, values, moments, span, flags)
            for new, exact in zip(found[1:], expected[1:], strict=True):
                assert np.array_equal(new, exact)
            assert not found[0][flagged].any()
            assert np.array_equal(found[0][~flagged], adj[~flagged])


@each_n_floats
def test_a_decay_lowers_first_numbers_that_have_a_gradient(n_floats: int, kernels: Kernels) -> None:
    """Each tile's by its own, in learning rates; all else is as it was without."""
    rng = np.random.default_rng(7)
    n, spans = 30, (1, TILE, 48)  # in tiles of four
    adj, values = rng.normal(size=(2, n, n_floats)).astype(np.float32)
    adj[rng.uniform(size=adj.shape) < 0.3] = 0.0
    moments = encoded(rng.normal(size=(n, n_floats)), rng.uniform(size=(n, n_floats)))
    decay = rng.uniform(0.1, 1.0, size=-(-n // TILE))
    without = step(kernels, 3, adj, values, moments)
    expected = without[1].astype(np.float64)
    moves = adj[:, 0] != 0.0
    expected[:, 0] -= RATES[0] * np.repeat(decay, TILE)[:n] * moves
    for span in spans:
        after, found, kept = step(kernels, 3, adj, values, moments, span, decay=decay)
        np.testing.assert_allclose(found, expected, atol=1e-6)
        assert np.array_equal(found[~moves], without[1][~moves]) and not moves.all()
        assert np.array_equal(found[:, 1:], without[1][:, 1:])
        assert np.array_equal(kept, without[2]) and not after.any()


@pytest.mark.parametrize("other_size", [(9, 7, 12), (4, 3, 2)])
@each_n_floats
def test_moments_on_another_grid(
    n_floats: int, other_size: tuple[int, int, int], kernels: Kernels
) -> None:
    """Read trilinearly, and rounded to the nearest; outside of the grid, off its nearest face."""
    rng = np.random.default_rng(2)
    size, adam = (5, 4, 6), kernels.module("optim.adam")
    moments_type = adam.moments_type(n_floats)
    spread = 10.0 ** rng.uniform(-12, 3, size=(2, *size, 1))
    mean, square = spread * rng.normal(size=(2, *size, n_floats))
    moments = encoded(mean, np.abs(square))
    scale, offset = (np.array(size) - 1.2) / (np.array(other_size) - 1), np.array([0.3, -0.1, 0.1])
    n_other = int(np.prod(other_size))
    out = wp.zeros(n_other, dtype=moments_type, device=kernels.device)
    kernels.workers.launch(
        adam.resample_moments_kernel(n_floats),
        n_other,
        wp.array(moments.reshape(-1, n_floats), dtype=moments_type, device=kernels.device),
        wp.vec3i(*size),
        kernels.types.vec3(*scale),
        kernels.types.vec3(*offset),
        wp.vec3i(*other_size),
        out,
    )
    u = np.stack(np.indices(other_size), axis=-1) * scale + offset
    assert (u.max((0, 1, 2)) > np.array(size) - 1).any() and u.min() < 0
    u = torch.tensor(np.clip(u, 0, np.array(size) - 1))
    found = decoded(out.numpy().reshape(*other_size, n_floats))
    for new, old, bit in zip(found, decoded(moments), (MEAN_BIT, SQUARE_BIT), strict=True):
        exact = reference.trilinear(torch.tensor(old), u).numpy()
        most = reference.trilinear(torch.tensor(np.abs(old)), u).numpy()
        assert (np.abs(new - exact) <= 0.501 * bit * np.abs(exact) + 1e-5 * most).all()
