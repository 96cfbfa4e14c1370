"""Nodes of 8 to 64 numbers: reading and its transpose, total variation, Adam, other grids."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.tiles import NODES_PER_THREAD, TILE
from warpnerf_kernels.optim.total_variation import TV_BLOCK

from tests import reference
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from warpnerf.fields.gradients import gradient_struct, n_tiles
from warpnerf.fields.lattice import grid_struct
from warpnerf.optim_config import OptimConfig
from warpnerf.training.optim import Update, adam_struct

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-4
CONFIG = OptimConfig(beta1=BETA1, beta2=BETA2, epsilon=EPSILON)
each_width = pytest.mark.parametrize("n_floats", [8, 64])
SIZE = (4, 5, 7)
N_NODES = 140


@pytest.fixture(scope="module")
def kernels32(device: str) -> Kernels:
    return Kernels("float32", device)


def gradient_of(kernels: Kernels, values: Any, flags: Any = 1) -> Any:
    """A kernel's Gradient that holds [n_nodes, n_floats]."""
    n, n_floats = values.shape
    touched = np.broadcast_to(np.asarray(flags, np.uint8), n_tiles(n))
    return gradient_struct(
        kernels.types,
        kernels.array(values, kernels.types.vector(n_floats)),
        wp.array(np.ascontiguousarray(touched), dtype=wp.uint8, device=kernels.device),
        kernels.zeros((1, 0)),
    )


@each_width
def test_reading_and_its_transpose(n_floats: int, kernels64: Kernels) -> None:
    """Against the oracle, and <A x, y> = <x, A^T y>."""
    rng = np.random.default_rng(n_floats)
    values = rng.normal(size=(*SIZE, n_floats))
    points, out = rng.uniform(-1.0, 1.0, size=(50, 3)), rng.normal(size=(50, n_floats))
    node, vec3 = kernels64.types.vector(n_floats), kernels64.types.vec3
    flat = kernels64.array(values.reshape(-1, n_floats), node)
    grid = grid_struct(kernels64.module("fields.dense"), flat, SIZE, 0.0)
    probe = kernels64.module("launch.probe").probe(kernels64.module("fields.dense").dense(n_floats))
    at, found = kernels64.array(points, vec3), kernels64.zeros(50, node)
    kernels64.workers.launch(probe.read_forward, 50, grid, at, found)
    u = torch.tensor((points + 1.0) / 2.0 * (np.array(SIZE) - 1))
    assert_close(found.numpy(), reference.trilinear(torch.tensor(values), u), 1e-13)
    gradient = gradient_of(kernels64, np.zeros((N_NODES, n_floats)), 0)
    kernels64.alone.launch(probe.read_backward, 50, grid, at, kernels64.array(out, node), gradient)
    back = gradient.values.numpy()
    forward, backward = np.vdot(found.numpy(), out), np.vdot(values, back)
    assert abs(forward - backward) < 1e-12 * np.abs(found.numpy() * out).sum()
    expected = torch.zeros(values.shape, dtype=torch.float64, requires_grad=True)
    (transposed,) = torch.autograd.grad(
        reference.trilinear(expected, u), expected, torch.tensor(out)
    )
    assert_close(back.reshape(values.shape), transposed, 1e-13)


@each_width
def test_total_variation(n_floats: int, kernels32: Kernels, kernels64: Kernels) -> None:
    """Where a node has gradient in any number, all of it gets more."""
    rng = np.random.default_rng(n_floats)
    values, weight = rng.normal(size=(*SIZE, n_floats)), rng.uniform(0.5, 2.0, size=n_floats)
    raw = torch.tensor(values, requires_grad=True)
    reference.total_variation(raw, torch.tensor(weight)).backward()
    assert raw.grad is not None
    already = np.zeros((N_NODES, n_floats))
    touched = rng.uniform(size=N_NODES) < 0.6
    for node in np.flatnonzero(touched):
        already[node, rng.integers(n_floats)] = rng.normal()
    for kernels, tolerance in ((kernels64, 1e-12), (kernels32, 1e-6)):
        node = kernels.types.vector(n_floats)
        kernel = kernels.module("optim.total_variation").total_variation_backward_kernel(n_floats)
        for span in (TILE, NODES_PER_THREAD):
            gradient = gradient_of(kernels, already)
            kernels.workers.launch(
                kernel,
                -(-N_NODES // span),
                span,
                kernels.array(values.reshape(-1, n_floats), node),
                wp.vec3i(*SIZE),
                node(*weight),
                kernels.array(np.ones(-(-N_NODES // TV_BLOCK))),
                gradient,
            )
            after = gradient.values.numpy()
            assert not after[~touched].any()
            added = (after - already.astype(after.dtype))[touched]
            assert_close(added, raw.grad.numpy().reshape(-1, n_floats)[touched], tolerance)


def decoded(moments: Any) -> tuple[Any, Any]:
    """Mean and square [...] of moments [...], as kernels/README.md has them."""
    mean = (moments & np.uint32(0xFFFF0000)).view(np.float32)
    square = ((moments & np.uint32(0xFFFF)) << np.uint32(15)).view(np.float32)
    return mean.astype(float), square.astype(float)


@pytest.fixture(scope="module", params=[8, 64])
def adam(request: pytest.FixtureRequest, kernels32: Kernels) -> SimpleNamespace:
    module = kernels32.module("optim.adam")
    n_floats = request.param
    return SimpleNamespace(
        n_floats=n_floats,
        kernel=module.adam_kernel(n_floats, decays=False),
        Moments=module.moments_type(n_floats),
        Node=kernels32.types.vector(n_floats),
        rates=np.random.default_rng(0).uniform(0.02, 0.3, size=n_floats),
    )


def updated(
    kernels: Kernels,
    adam: SimpleNamespace,
    number: int,
    adj: Any,
    values: Any,
    moments: Any,
    flags: Any = 1,
    span: int = NODES_PER_THREAD,
    n_nodes: int | None = None,
) -> tuple[Any, Any, Any]:
    """What is left of the gradient, and new values and moments, all [n_nodes, n_floats]."""
    gradient = gradient_of(kernels, adj, flags)
    arrays = (
        kernels.array(values, adam.Node),
        wp.array(moments, dtype=adam.Moments, device=kernels.device),
    )
    kernels.workers.launch(
        adam.kernel,
        -(-(n_nodes or len(values)) // span),
        span,
        number,
        adam.Node(*adam.rates),
        kernels.array([]),
        adam_struct(Update(number, 1.0, CONFIG)),
        gradient,
        *(array[:n_nodes] for array in arrays),
    )
    return gradient.values.numpy(), arrays[0].numpy(), arrays[1].numpy()


def test_adam_against_the_oracle(adam: SimpleNamespace, kernels32: Kernels) -> None:
    shape = (30, adam.n_floats)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        values, moments = rng.normal(size=shape).astype(np.float32), np.zeros(shape, np.uint32)
        for number in range(1, 4):
            adj = rng.normal(size=shape) * 10.0 ** rng.uniform(-7, 0, size=shape)
            adj[rng.uniform(size=shape) < 0.3] = 0.0
            adj[:3], adj[:, 2] = 0.0, 0.0  # whole nodes as well, and a number of each
            adj = adj.astype(np.float32)
            before = values, moments
            after, values, moments = updated(kernels32, adam, number, adj, *before)
            assert not after.any()
            tensors = [torch.tensor(a.astype(float)) for a in (before[0], *decoded(before[1]), adj)]
            value, mean, square = reference.adam(
                *tensors, number, torch.tensor(adam.rates), BETA1, BETA2, EPSILON
            )
            still = adj == 0.0
            for new, old in zip((values, moments), before, strict=True):
                assert np.array_equal(new[still], old[still])
            change = np.abs(value.numpy() - before[0])
            assert (np.abs(values - value.numpy()) <= 4e-6 * change + 3e-7).all()
            for new, exact, bit in zip(
                decoded(moments), (mean, square), (2.0**-7, 2.0**-8), strict=True
            ):
                assert (np.abs(new - exact.numpy()) <= bit * np.abs(exact.numpy())).all()


def test_adam_ends_with_the_last_node(adam: SimpleNamespace, kernels32: Kernels) -> None:
    rng = np.random.default_rng(5)
    adj, values = rng.normal(size=(2, 32, adam.n_floats)).astype(np.float32)
    moments = np.zeros(adj.shape, np.uint32)
    expected = updated(kernels32, adam, 1, adj, values, moments)[1:]
    for n in (29, 30, 31):  # in tiles of four
        found = updated(kernels32, adam, 1, adj, values, moments, n_nodes=n)[1:]
        for new, exact, old in zip(found, expected, (values, moments), strict=True):
            assert np.array_equal(new[:n], exact[:n])
            assert np.array_equal(new[n:], old[n:])


def test_adam_passes_over_tiles_without_a_flag(adam: SimpleNamespace, kernels32: Kernels) -> None:
    rng = np.random.default_rng(4)
    adj, values = rng.normal(size=(2, 100, adam.n_floats)).astype(np.float32)
    moments = np.zeros(adj.shape, np.uint32)
    flags = np.arange(100 // TILE) % 5 == 2
    flagged = np.repeat(flags | np.roll(flags, 1), TILE)  # a flag stands for the next tile, too
    counted = np.where(flagged[:, None], adj, 0.0)
    expected = updated(kernels32, adam, 1, counted, values, moments)
    for span in (TILE, 48):
        found = updated(kernels32, adam, 1, adj, values, moments, flags, span)
        for new, exact in zip(found[1:], expected[1:], strict=True):
            assert np.array_equal(new, exact)
        assert not found[0][flagged].any()
        assert np.array_equal(found[0][~flagged], adj[~flagged])


def test_values_and_moments_on_another_grid(kernels32: Kernels) -> None:
    """Read trilinearly, moments rounded to the nearest."""
    n_floats, other = 16, (6, 4, 9)
    rng = np.random.default_rng(2)
    module, node = kernels32.module("optim.adam"), kernels32.types.vector(n_floats)
    values = rng.normal(size=(N_NODES, n_floats))
    mean = rng.normal(size=(N_NODES, n_floats)).astype(np.float32)
    square = rng.uniform(size=(N_NODES, n_floats)).astype(np.float32)
    moments = (mean.view(np.uint32) & np.uint32(0xFFFF0000)) | (
        square.view(np.uint32) >> np.uint32(15)
    )
    scale = (np.array(SIZE) - 1) / (np.array(other) - 1)
    n_other = int(np.prod(other))
    u = torch.tensor(np.stack(np.indices(other), axis=-1) * scale)
    Moments = module.moments_type(n_floats)
    for kernel, array, dtype in (
        (kernels32.module("fields.dense").resample_kernel(n_floats), values, node),
        (module.resample_moments_kernel(n_floats), moments, Moments),
    ):
        given = (
            kernels32.array(array, dtype)
            if dtype is node
            else wp.array(array, dtype=dtype, device=kernels32.device)
        )
        out = wp.zeros(n_other, dtype=dtype, device=kernels32.device)
        kernels32.workers.launch(
            kernel,
            n_other,
            given,
            wp.vec3i(*SIZE),
            kernels32.types.vec3(*scale),
            kernels32.types.vec3(0.0, 0.0, 0.0),
            wp.vec3i(*other),
            out,
        )
        found = out.numpy()
        if dtype is node:
            pairs = [(found, values, 1e-6)]
        else:
            bits = (0.502 * 2.0**-7, 0.502 * 2.0**-8)
            pairs = list(zip(decoded(found), decoded(moments), bits, strict=True))
        for new, old, share in pairs:
            exact = reference.trilinear(torch.tensor(old).reshape(*SIZE, n_floats), u).numpy()
            error = np.abs(new.reshape(exact.shape) - exact)
            assert (error <= share * np.abs(exact) + 1e-5).all()


def test_weights_that_rays_share_against_the_oracle(kernels32: Kernels) -> None:
    """From the sum over workers; what has no gradient keeps its value and moments."""
    module, n, workers = kernels32.module("optim.adam"), 37, 3
    for seed in range(5):
        rng = np.random.default_rng(seed)
        state = [rng.normal(size=n), 0.1 * rng.normal(size=n), rng.uniform(0.01, 1.0, size=n)]
        state = [a.astype(np.float32) for a in state]
        for number in (1, 2, 5):
            adj = np.zeros((workers, 48), np.float32)  # rows are longer than what is used of them
            adj[:, :n] = rng.normal(size=(workers, n))
            adj[:, :5] = 0.0
            adj[0, 5], adj[1:, 5] = 0.0, [1.0, -1.0]  # a sum of 0
            arrays = [kernels32.array(a) for a in state]
            gradient = kernels32.array(adj)
            kernels32.workers.launch(
                module.adam_weights,
                n,
                0.05,
                adam_struct(Update(number, 1.0, CONFIG)),
                gradient,
                *arrays,
            )
            assert not gradient.numpy().any()
            total = torch.tensor(adj[:, :n].astype(float).sum(axis=0))
            expected = reference.adam(
                *(torch.tensor(a.astype(float)) for a in state),
                total,
                number,
                0.05,
                BETA1,
                BETA2,
                EPSILON,
            )
            found = [array.numpy().copy() for array in arrays]
            for new, old, exact in zip(found, state, expected, strict=True):
                assert np.array_equal(new[:6], old[:6])
                assert (np.abs(new - exact.numpy()) <= 2e-6 * (1.0 + np.abs(exact.numpy()))).all()
                assert (new[6:] != old[6:]).all()
            state = found
