"""scale_gradient against the paper's operation, the oracle, and in a whole rendering."""

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests import reference
from tests.support.expected import assert_close, oracle
from tests.support.torch_calls import gradient, problem, tensor
from warpnerf.checks import InputError
from warpnerf.torch import scale_gradient


class TheirScaler(torch.autograd.Function):
    """The paper's listing, word for word in effect."""

    @staticmethod
    def forward(ctx: Any, colors: Tensor, sigmas: Tensor, ray_dist: Tensor) -> Any:
        ctx.save_for_backward(ray_dist)
        return colors, sigmas, ray_dist

    @staticmethod
    def backward(ctx: Any, grad_colors: Tensor, grad_sigmas: Tensor, grad_dist: Tensor) -> Any:
        (ray_dist,) = ctx.saved_tensors
        scaling = torch.square(ray_dist).clamp(0, 1)
        return grad_colors * scaling, grad_sigmas * scaling, grad_dist


def samples(
    dtype: torch.dtype, device: str, last: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    rng = np.random.default_rng(13)
    tail = (1,) if last else ()
    colors, adj_colors = (tensor(rng.normal(size=(6, 9, 3)), device, dtype) for _ in range(2))
    sigmas, adj_sigmas = (tensor(rng.normal(size=(6, 9, *tail)), device, dtype) for _ in range(2))
    t = tensor(rng.uniform(0.0, 2.0, size=(6, 9, *tail)), device, dtype)
    t[0, 0] = 0.0
    return colors.requires_grad_(), sigmas.requires_grad_(), t, adj_colors, adj_sigmas


FLOATS = [torch.float16, torch.bfloat16, torch.float32, torch.float64]


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
def test_scale_gradient_is_the_papers_operation(dtype: torch.dtype, device: str) -> None:
    colors, sigmas, t, adj_colors, adj_sigmas = samples(dtype, device, last=True)
    out_colors, out_sigmas, out_t = scale_gradient(colors, sigmas, t)
    assert torch.equal(out_colors, colors) and torch.equal(out_sigmas, sigmas)
    assert torch.equal(out_t, t)
    ours = torch.autograd.grad([out_colors, out_sigmas], [colors, sigmas], [adj_colors, adj_sigmas])
    theirs = TheirScaler.apply(colors, sigmas, t)[:2]
    expected = torch.autograd.grad(theirs, [colors, sigmas], [adj_colors, adj_sigmas])
    for a, b in zip(ours, expected, strict=True):
        assert a.dtype == dtype and torch.equal(a, b)
        assert not a[0, 0].any() and float(b.abs().max()) > 0.1
    far = (t >= 1.0).expand_as(adj_colors)
    assert bool(far.any()) and torch.equal(ours[0][far], adj_colors[far])


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("scaling", ["none", "quadratic", "clamped"])
@pytest.mark.parametrize("per_ray", [False, True])
def test_scale_gradient_against_the_oracle(
    scaling: Any, last: bool, per_ray: bool, device: str
) -> None:
    colors, sigmas, t, adj_colors, adj_sigmas = samples(torch.float64, device, last)
    content: Any = 1.5
    if per_ray:
        content = torch.linspace(0.5, 3.0, 6, dtype=torch.float64, device=t.device)
        content = content.reshape(6, *(1,) * (t.dim() - 1))
    out = scale_gradient(colors, sigmas, t, content, scaling)
    ours = torch.autograd.grad(out[:2], [colors, sigmas], [adj_colors, adj_sigmas])
    flat = t.reshape(6, 9)
    expected = reference.distance_scale(flat, content.reshape(6) if per_ray else content, scaling)
    assert_close(ours[0].cpu(), (adj_colors * expected[..., None]).cpu(), 1e-14)
    assert_close(ours[1].reshape(6, 9).cpu(), (adj_sigmas.reshape(6, 9) * expected).cpu(), 1e-14)


@pytest.mark.parametrize("scaling", ["none", "quadratic", "clamped"])
def test_the_gradient_of_distances_passes_as_in_the_paper(scaling: Any, device: str) -> None:
    """Also where the names of the caller's tensors are used again, as documented."""
    colors, sigmas, distances, *adjoints = samples(torch.float64, device, last=True)
    adjoints.append(tensor(np.random.default_rng(15).normal(size=(6, 9, 1)), device))
    leaf = distances.requires_grad_()
    theirs = TheirScaler.apply(colors, sigmas, leaf)
    (expected,) = torch.autograd.grad(theirs, leaf, adjoints)
    colors, sigmas, distances = scale_gradient(colors, sigmas, distances, scaling=scaling)
    (ours,) = torch.autograd.grad([colors, sigmas, distances], leaf, adjoints)
    assert torch.equal(ours, expected) and float(expected.abs().max()) > 0.1
    assert torch.equal(distances, leaf)


def test_the_scale_itself_has_no_gradient(device: str) -> None:
    colors, sigmas, t, *_ = samples(torch.float64, device, last=True)
    out = scale_gradient(colors, sigmas, t.requires_grad_())
    total = out[0].sum() + out[1].sum()
    assert torch.autograd.grad(total, t, allow_unused=True) == (None,)


def test_scale_gradient_in_a_whole_render(device: str) -> None:
    """Put into the oracle's integration, it gives what render_rays' own adjoint gives."""
    p = problem(14, content_distance=np.array([1.7]))
    at = torch.tensor(p.raw, requires_grad=True)
    plain = oracle(p, at)
    n_steps = plain.t.shape[1]
    points = (
        torch.tensor(p.origins)[:, None] + plain.t[..., None] * torch.tensor(p.directions)[:, None]
    )
    u = reference.grid_coordinates(
        points, torch.tensor(p.box_min), torch.tensor(p.box_max), p.raw.shape, "none", 0.0
    )
    values = reference.trilinear(at, torch.where(plain.kept[..., None], u, 0.0))
    colors, sigmas, t = scale_gradient(
        torch.sigmoid(values[..., 1:]),
        reference.softplus(values[..., 0] + p.density_shift),
        plain.t,
        1.7,
    )
    dt = torch.full((n_steps,), p.steps.step, dtype=torch.float64)
    out = reference.integrate(sigmas, colors, t, dt, torch.tensor(p.background), plain.kept)
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    (expected,) = torch.autograd.grad([out.rgb, out.opacity, out.depth], at, adjoints)
    found = gradient(p, tensor(p.raw, device).requires_grad_(), "clamped")
    assert_close(found, expected, 1e-9)


def test_scale_gradient_refuses(device: str) -> None:
    colors, sigmas, t, *_ = samples(torch.float64, device, last=True)
    for arguments, message in [
        ((colors, sigmas, t[:, :4]), "one shape"),
        ((colors[:3], sigmas, t), "colors must be"),
        ((colors, sigmas, t, 0.0), "content_distance must be"),
        ((colors, sigmas, t, torch.tensor([-1.0])), "above 0 everywhere"),
        ((colors, sigmas, t, torch.tensor([1.0, 2.0])), "must broadcast over distances"),
        ((colors, sigmas, t, 1.0, "cubic"), "scaling must be one of"),
    ]:
        with pytest.raises(InputError, match=message):
            scale_gradient(*arguments)
    half: Any = Fraction(1, 2)
    assert torch.equal(scale_gradient(colors, sigmas, t, half)[0], colors)


def test_a_content_distance_that_requires_grad_is_refused(device: str) -> None:
    colors, sigmas, t, *_ = samples(torch.float64, device, last=True)
    content = torch.ones(1, dtype=torch.float64, device=t.device, requires_grad=True)
    with pytest.raises(InputError, match="content_distance requires grad, but"):
        scale_gradient(colors, sigmas, t, content)


def test_it_is_compiled_as_one_graph() -> None:
    def losing(colors: torch.Tensor, sigmas: torch.Tensor, distances: torch.Tensor) -> torch.Tensor:
        colors, sigmas, _ = scale_gradient(colors, sigmas, distances, 2.0)
        return colors.sum() + sigmas.sum()

    compiled = torch.compile(losing, backend="eager", fullgraph=True)
    grads = []
    for function in (losing, compiled):
        colors, sigmas = (torch.ones(shape, requires_grad=True) for shape in ((4, 3), (4,)))
        function(colors, sigmas, torch.linspace(0.5, 3.0, 4)).backward()
        grads.append((colors.grad, sigmas.grad))
    for plain, of_graph in zip(*grads, strict=True):
        assert torch.equal(plain, of_graph)
