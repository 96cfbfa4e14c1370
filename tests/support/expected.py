"""What kernels must return: problems put to the oracle, differences, and how close is close."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tests import reference
from tests.support.problems import Float64, Problem
from warpnerf.rendering.steps import Steps

RGB = reference.RgbHead()


def oracle(
    p: Problem,
    raw: torch.Tensor,
    scaling: str = "none",
    jacobian: str = "none",
    head: reference.Head = RGB,
) -> reference.Rendering:
    """The same problem in the reference, raw a tensor that may want a gradient."""
    n_steps, frustum = 1, None
    if p.frustum is not None:
        n_steps = int(4.0 * np.linalg.norm(p.box_max - p.box_min) / p.steps.step)
        frustum = reference.Frustum(
            torch.tensor(p.frustum.origin),
            torch.tensor(p.frustum.axes),
            p.frustum.near,
            p.frustum.depth,
        )
    while p.frustum is None and last_edge(p.steps, n_steps) < min(p.steps.far, 50.0):
        n_steps += 1
    offsets, content = torch.tensor(p.offsets), torch.tensor(p.content_distance)
    return reference.render(
        raw,
        torch.tensor(p.origins),
        torch.tensor(p.directions),
        box_min=torch.tensor(p.box_min),
        box_max=torch.tensor(p.box_max),
        near=p.steps.near,
        far=p.steps.far,
        step=p.steps.step,
        n_steps=n_steps,
        growth=p.steps.growth,
        n_linear=p.steps.n_linear,
        offset=offsets.expand(p.n_rays),
        norm="none" if frustum else p.contraction,
        frustum=frustum,
        border=p.border,
        density_shift=p.density_shift,
        density_scale=p.density_scale,
        background=torch.tensor(p.background).expand(p.n_rays, 3),
        mask=torch.tensor(p.free == 0),
        transmittance_min=p.steps.transmittance_min,
        scaling=scaling,
        content_distance=content.expand(p.n_rays),
        jacobian=jacobian,
        head=head,
    )


def last_edge(steps: Steps, k: int) -> float:
    """Where step k begins."""
    if steps.growth == 0.0 or k <= steps.n_linear:
        return steps.near + k * steps.step
    linear = steps.near + steps.n_linear * steps.step
    return float(linear * (1.0 + steps.growth) ** (k - steps.n_linear))


def oracle_gradient(p: Problem, scaling: str = "none", jacobian: str = "none") -> Float64:
    """What Kernels.backward must return."""
    raw = torch.tensor(p.raw, requires_grad=True)
    out = oracle(p, raw, scaling, jacobian)
    adjoints = [torch.tensor(a) for a in (p.adj_rgb, p.adj_opacity, p.adj_depth)]
    (gradient,) = torch.autograd.grad([out.rgb, out.opacity, out.depth], raw, adjoints)
    return gradient.numpy()


def oracle_train(
    p: Problem, scaling: str = "none", jacobian: str = "none"
) -> tuple[Float64, Float64]:
    """What Kernels.train must return."""
    raw = torch.tensor(p.raw, requires_grad=True)
    out = oracle(p, raw, scaling, jacobian)
    target = torch.tensor(p.target)
    (gradient,) = torch.autograd.grad(reference.photometric_loss(out.rgb, target), raw)
    return ((out.rgb - target) ** 2).sum(-1).detach().numpy(), gradient.numpy()


def directional_differences(
    f: Callable[[Float64], float], x: Float64, directions: Float64, h: float = 1e-4
) -> Float64:
    """Central differences of f at x along directions [n, *x.shape], to order h^4: [n]."""

    def difference(d: Float64, h: float) -> float:
        return (f(x + h * d) - f(x - h * d)) / (2.0 * h)

    return np.array([(4.0 * difference(d, h) - difference(d, 2.0 * h)) / 3.0 for d in directions])


def assert_close(value: Any, expected: Any, tolerance: float) -> None:
    """Elementwise error over the largest entry, and the angle; the expected must say something."""
    value, expected = np.asarray(value, np.float64), np.asarray(expected, np.float64)
    assert value.shape == expected.shape
    largest = np.abs(expected).max()
    assert largest > 1e-6, "the reference is next to zero: a comparison with it shows nothing"
    error = np.abs(value - expected).max() / largest
    assert error <= tolerance, f"relative error {error:.3g} > {tolerance:.3g}"
    cosine = np.vdot(value, expected) / (np.linalg.norm(value) * np.linalg.norm(expected))
    assert cosine >= 1.0 - max(tolerance, 1e-12)
