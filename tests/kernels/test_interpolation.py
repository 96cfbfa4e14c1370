"""Trilinear gather, its transpose, and resampling."""

import math
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from warpnerf_kernels.base.parts import INFINITELY_FAR
from warpnerf_kernels.base.tiles import TILE

from tests import reference
from tests.support import probe_kernels
from tests.support.expected import assert_close, directional_differences
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS


def problem(seed: int) -> tuple[Any, Any, Any]:
    """A grid [X, Y, Z, 4], points [n, 3] between its nodes, some on far faces, and adjoints."""
    rng = np.random.default_rng(seed)
    size = rng.integers(2, 7, size=3)
    u = rng.uniform(size=(40, 3)) * (size - 1)
    u[0], u[1], u[2, 0], u[3, 1], u[4, 2] = 0, size - 1, size[0] - 1, size[1] - 1, size[2] - 1
    return rng.normal(size=(*size, 4)), u, rng.normal(size=(40, 4))


def gather(kernels: Kernels, values: Any, u: Any) -> Any:
    types, n = kernels.types, len(u)
    out = kernels.zeros(n, types.vector(4))
    kernels.workers.launch(
        probe_kernels.of(kernels).gather_points,
        n,
        kernels.array(values.reshape(-1, 4), types.vector(4)),
        wp.vec3i(*values.shape[:3]),
        kernels.array(u, types.vec3),
        out,
    )
    return out.numpy()


def adj_gather(kernels: Kernels, shape: Any, u: Any, adj: Any) -> Any:
    types, n = kernels.types, len(u)
    gradient = kernels.gradient(math.prod(shape[:3]), 4)
    kernels.alone.launch(
        probe_kernels.of(kernels).scatter_points,
        n,
        wp.vec3i(*shape[:3]),
        kernels.array(u, types.vec3),
        kernels.array(adj, types.vector(4)),
        gradient,
    )
    return gradient.values.numpy().reshape(shape)


def test_gather_and_its_adjoint_against_the_oracle(kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        values, u, adj = problem(seed)
        grid = torch.tensor(values, requires_grad=True)
        expected = reference.trilinear(grid, torch.tensor(u))
        assert_close(gather(kernels64, values, u), expected.detach(), 1e-14)
        (gradient,) = torch.autograd.grad(expected, grid, torch.tensor(adj))
        assert_close(adj_gather(kernels64, values.shape, u, adj), gradient, 1e-14)


def test_adjoint_against_central_differences(kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        values, u, adj = problem(seed)
        directions = np.random.default_rng(seed).normal(size=(4, *values.shape))
        expected = directional_differences(
            lambda v, u=u, adj=adj: float((adj * gather(kernels64, v, u)).sum()),
            values,
            directions,
            h=1e-2,
        )
        found = np.tensordot(directions, adj_gather(kernels64, values.shape, u, adj), axes=4)
        assert_close(found, expected, 1e-9)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_transpose(precision: str, device: str) -> None:
    """<gather(x), y> == <x, adj_gather(y)>."""
    kernels = Kernels(precision, device)
    for seed in range(N_SEEDS):
        values, u, adj = problem(seed)
        forward = float((gather(kernels, values, u).astype(np.float64) * adj).sum())
        backward = float((values * adj_gather(kernels, values.shape, u, adj)).sum())
        scale = float(np.abs(values).max() * np.abs(adj).sum())
        assert abs(forward) > 1e-3 * scale / 40
        assert abs(forward - backward) <= (1e-15 if precision == "float64" else 1e-6) * scale


def test_gather_reproduces_linear_functions(kernels64: Kernels) -> None:
    """Each axis is the axis it says, and nodes sit at their indices."""
    index = np.stack(np.meshgrid(np.arange(4), np.arange(5), np.arange(3), indexing="ij"), -1)
    values = np.concatenate([index @ [[100.0], [10.0], [1.0]], index], axis=-1)
    u = np.random.default_rng(1).uniform(size=(50, 3)) * [3, 4, 2]
    found = gather(kernels64, values, u)
    np.testing.assert_allclose(found[:, 0], u @ [100.0, 10.0, 1.0], rtol=1e-13)
    np.testing.assert_allclose(found[:, 1:], u, rtol=1e-13, atol=1e-13)


def test_only_tiles_around_the_point_are_flagged(kernels64: Kernels) -> None:
    types, size = kernels64.types, (6, 5, 40)
    for seed in range(N_SEEDS):
        u = np.random.default_rng(seed).uniform(size=(1, 3)) * (np.array(size) - 1)
        gradient = kernels64.gradient(math.prod(size), 4)
        kernels64.alone.launch(
            probe_kernels.of(kernels64).scatter_points,
            1,
            wp.vec3i(*size),
            kernels64.array(u, types.vec3),
            kernels64.array(np.ones((1, 4)), types.vector(4)),
            gradient,
        )
        nodes = np.flatnonzero(gradient.values.numpy().any(axis=-1))
        assert len(nodes) == 8
        # A pair of nodes along z flags the tile that it begins in.
        assert np.array_equal(
            np.flatnonzero(gradient.touched.numpy()), np.unique(nodes[::2] // TILE)
        )


def test_activations_against_the_oracle(kernels64: Kernels) -> None:
    """softplus, sigmoid, their adjoints, and 1 - exp(-tau), over the whole range."""
    rng = np.random.default_rng(2)
    for seed in range(N_SEEDS):
        x = np.concatenate([rng.normal(size=30), rng.uniform(-40, 40, 30), [0.0, -700.0, 700.0]])
        adj = rng.normal(size=len(x))
        out = {
            name: kernels64.zeros(len(x))
            for name in ("softplus", "adj_softplus", "sigmoid", "adj_sigmoid", "opacity")
        }
        kernels64.workers.launch(
            probe_kernels.of(kernels64).activate,
            len(x),
            kernels64.array(x),
            kernels64.array(adj),
            *out.values(),
        )
        at = torch.tensor(x, requires_grad=True)
        softplus, sigmoid = reference.softplus(at), torch.sigmoid(at)
        weights = torch.tensor(adj)
        expected = {
            "softplus": softplus,
            "adj_softplus": torch.autograd.grad(softplus, at, weights)[0],
            "sigmoid": sigmoid,
            "adj_sigmoid": torch.autograd.grad(sigmoid, at, weights)[0],
            "opacity": -torch.expm1(-softplus),
        }
        for name, value in expected.items():
            np.testing.assert_allclose(
                out[name].numpy(), value.detach(), rtol=2e-11, atol=1e-15, err_msg=f"{name} {seed}"
            )

        # and differences of the kernel's own values
        h = 1e-4 * np.maximum(1.0, np.abs(x))
        shifted = []
        for sign in (1.0, -1.0):
            kernels64.workers.launch(
                probe_kernels.of(kernels64).activate,
                len(x),
                kernels64.array(x + sign * h),
                kernels64.array(adj),
                *out.values(),
            )
            shifted.append({name: out[name].numpy().copy() for name in ("softplus", "sigmoid")})
        for name in ("softplus", "sigmoid"):
            difference = adj * (shifted[0][name] - shifted[1][name]) / (2.0 * h)
            small = np.abs(x) < 20.0
            assert_close(difference[small], expected[f"adj_{name}"].detach()[small], 1e-7)


def test_contraction_against_the_oracle(kernels64: Kernels) -> None:
    """f and |det J| of both norms, from well inside to far outside; n by f(q)."""
    for name in ("none", "linf", "l2"):
        for seed in range(N_SEEDS):
            rng = np.random.default_rng(seed)
            q = rng.normal(size=(60, 3)) * np.logspace(-1, 3, 60)[:, None]
            border, box = float(rng.uniform(0.1, 1.0)), kernels64.types.Box()
            box.border = border
            out_c = kernels64.zeros(60, kernels64.types.vec3)
            out_det, out_boxes, out_beyond = (kernels64.zeros(60) for _ in range(3))
            kernels64.workers.launch(
                probe_kernels.contract_points_of(kernels64, name),
                60,
                kernels64.array(q, kernels64.types.vec3),
                box,
                out_c,
                out_det,
                out_boxes,
                out_beyond,
            )
            points = torch.tensor(q)
            n = np.linalg.norm(q, axis=1, ord={"linf": np.inf}.get(name))
            n = np.where((n > 1.0) & (name != "none"), n, 0.0)
            np.testing.assert_allclose(out_boxes.numpy(), n, rtol=1e-9)
            assert (out_beyond.numpy() == (0.0 if name == "none" else INFINITELY_FAR)).all()
            expected = reference.contract(points, name, border)
            np.testing.assert_allclose(out_c.numpy(), expected, rtol=1e-13)
            det = reference.jacobian_determinant_autograd(points, name, border)
            np.testing.assert_allclose(out_det.numpy(), det, rtol=1e-8)
