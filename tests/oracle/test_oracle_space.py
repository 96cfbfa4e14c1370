"""The oracle's space: contraction, interpolation, steps, against independent accounts."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference import (
    contract,
    grid_coordinates,
    jacobian_determinant,
    jacobian_determinant_autograd,
    relative_error,
    sample_distances,
    trilinear,
)
from tests.support.reference_tensors import normal, uniform


def outside_points() -> Tensor:
    """Points at every scale from well inside to far outside [200, 3]."""
    direction = torch.nn.functional.normalize(normal(200, 3, seed=4), dim=-1)
    return direction * torch.logspace(-2, 3, 200, dtype=torch.float64)[:, None]


@pytest.mark.parametrize("norm", ["linf", "l2"])
@pytest.mark.parametrize("border", [0.2, 1.0])
def test_contraction_bounds_identity_and_continuity(norm: str, border: float) -> None:
    q = outside_points()
    n = q.abs().amax(-1) if norm == "linf" else (q**2).sum(-1).sqrt()
    c = contract(q, norm, border)
    assert torch.equal(c[n <= 1.0], q[n <= 1.0])
    length = c.abs().amax(-1) if norm == "linf" else (c**2).sum(-1).sqrt()
    outside = n > 1.0
    assert bool((length[outside] > 1.0).all()) and bool((length <= 1.0 + border).all())
    torch.testing.assert_close(length[outside], 1.0 + border - border / n[outside])
    at_edge = q / n[:, None]
    torch.testing.assert_close(
        contract(at_edge * (1.0 + 1e-9), norm, border), at_edge, rtol=0, atol=1e-8
    )


def test_contraction_known_numbers() -> None:
    q = torch.tensor([[2.0, -4.0, 0.0]], dtype=torch.float64)
    # n = 4, factor (1 + 1 - 1/4) / 4 = 0.4375
    torch.testing.assert_close(contract(q, "linf", 1.0), 0.4375 * q)
    q = torch.tensor([[3.0, 0.0, 4.0]], dtype=torch.float64)
    # n = 5, factor (1.2 - 0.2/5) / 5 = 0.232
    torch.testing.assert_close(contract(q, "l2", 0.2), 0.232 * q)
    assert torch.equal(contract(q, "none", 0.2), q)


@pytest.mark.parametrize("norm", ["none", "linf", "l2"])
@pytest.mark.parametrize("border", [0.2, 1.0])
def test_jacobian_determinant_formula(norm: str, border: float) -> None:
    q = outside_points().reshape(20, 10, 3)
    formula = jacobian_determinant(q, norm, border)
    measured = jacobian_determinant_autograd(q, norm, border)
    assert formula.shape == (20, 10)
    torch.testing.assert_close(formula, measured, rtol=1e-9, atol=0)
    if norm != "none":
        assert float(formula.min()) < 1e-6  # the far points do exercise the formula


def test_contraction_at_the_origin_has_a_gradient() -> None:
    for norm in ("linf", "l2"):
        jacobian = torch.func.jacrev(lambda q, norm=norm: contract(q, norm, 1.0))(
            torch.zeros(3, dtype=torch.float64)
        )
        torch.testing.assert_close(jacobian, torch.eye(3, dtype=torch.float64))


def test_grid_coordinates() -> None:
    box_min = torch.tensor([-1.0, 0.0, 2.0], dtype=torch.float64)
    box_max = torch.tensor([1.0, 4.0, 3.0], dtype=torch.float64)
    points = torch.stack([box_min, box_max, (box_min + box_max) / 2.0])
    last = torch.tensor([6.0, 3.0, 8.0], dtype=torch.float64)
    u = grid_coordinates(points, box_min, box_max, (7, 4, 9), "none", 1.0)
    torch.testing.assert_close(u, torch.stack([0.0 * last, last, last / 2.0]))
    # border 1: the inner box fills the middle half of the grid
    u = grid_coordinates(points, box_min, box_max, (7, 4, 9), "linf", 1.0)
    torch.testing.assert_close(u, torch.stack([last / 4.0, last * 3.0 / 4.0, last / 2.0]))
    far_away = torch.tensor([1e9, 2.0, 2.5], dtype=torch.float64)
    for norm in ("linf", "l2"):
        u = grid_coordinates(far_away, box_min, box_max, (7, 4, 9), norm, 0.2)
        torch.testing.assert_close(u, last * torch.tensor([1.0, 0.5, 0.5], dtype=torch.float64))


# interpolation


def test_trilinear_against_grid_sample() -> None:
    grid = normal(5, 4, 6, 3, seed=5).requires_grad_()
    last = torch.tensor([4.0, 3.0, 5.0], dtype=torch.float64)
    u = uniform(300, 3, seed=6) * last
    u[0], u[1] = 0.0, last  # the two extreme corners
    u[2:40] = u[2:40].round()  # and nodes

    value = trilinear(grid, u)
    # grid_sample reads [1, C, X, Y, Z] at (z, y, x) in [-1, 1]
    at = (2.0 * u / last - 1.0).flip(-1)[None, :, None, None, :]
    expected = torch.nn.functional.grid_sample(
        grid.permute(3, 0, 1, 2)[None], at, mode="bilinear", align_corners=True
    )
    expected = expected[0, :, :, 0, 0].T
    torch.testing.assert_close(value, expected)

    adjoint = normal(300, 3, seed=7)
    (gradient,) = torch.autograd.grad(value, grid, adjoint)
    (expected_gradient,) = torch.autograd.grad(expected, grid, adjoint)
    assert relative_error(gradient, expected_gradient) < 1e-12
    # transpose: trilinear is linear in the grid, so <A g, y> = <g, A^T y>
    assert math.isclose((value * adjoint).sum().item(), (gradient * grid).sum().item())


# distances along a ray


@pytest.mark.parametrize(("near", "n_linear"), [(0.0, 34), (0.37, 1), (6.0, 0)])
def test_growing_steps_follow_the_recursion(near: float, n_linear: int) -> None:
    step, growth, n_steps = 0.11, 0.03, 150
    edges = [near]
    for k in range(n_steps):
        edges.append(edges[-1] + (step if k < n_linear else growth * edges[-1]))
    expected = np.array(edges)
    assert edges[-1] > near + 2.0 * n_steps * step  # some steps do grow
    samples = sample_distances(near, math.inf, step, growth, n_linear, n_steps)
    np.testing.assert_allclose(samples.dt.numpy(), np.diff(expected), rtol=1e-9)
    np.testing.assert_allclose(samples.t.numpy(), (expected[1:] + expected[:-1]) / 2, rtol=1e-9)
    assert bool(samples.before_far.all())


def test_uniform_steps_offsets_and_far() -> None:
    offset = torch.tensor([0.0, 0.25], dtype=torch.float64)
    t, dt, before_far = sample_distances(1.0, 2.25, 0.5, 0.0, 0, 3, offset)
    expected = torch.tensor([[1.0, 1.5, 2.0], [1.125, 1.625, 2.125]], dtype=torch.float64)
    torch.testing.assert_close(t, expected)
    assert dt.tolist() == [0.5, 0.5, 0.5]
    assert bool(before_far.all())
    assert sample_distances(1.0, 2.0, 0.5, 0.0, 0, 3, offset).before_far.tolist() == [
        [True, True, False],  # t = far is out
        [True, True, False],
    ]
    t, dt, _ = sample_distances(1.0, 2.0, 0.5, 0.01, 2, 3, dtype=torch.float32)
    assert t.dtype == dt.dtype == torch.float32 and t.shape == (3,)
