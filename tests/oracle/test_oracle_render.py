"""The oracle's rendering and its scaling, against numbers by hand and a scalar loop."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference import (
    GradientScaler,
    central_difference,
    contract,
    distance_scale,
    integrate,
    jacobian_determinant_autograd,
    photometric_loss,
    relative_error,
    render,
    softplus,
    trilinear,
)
from tests.support.reference_tensors import normal, tiny_problem, tiny_raw, uniform

LN2 = math.log(2.0)
LN3 = math.log(3.0)


def hand_problem() -> tuple[Tensor, dict[str, Any]]:
    """One ray along x through nodes 0, 1, 2: two samples with alpha = 1/2, red 3/4 then 1/4."""
    raw = torch.zeros(3, 2, 2, 4, dtype=torch.float64)  # softplus(0) = ln 2
    raw[1, :, :, 1] = 2.0 * LN3  # red is logit ln 3 halfway between nodes 0 and 1
    raw[2, :, :, 1] = -4.0 * LN3  # and -ln 3 between nodes 1 and 2
    return raw, {
        "origins": torch.tensor([[0.0, 0.5, 0.5]], dtype=torch.float64),
        "directions": torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64),
        "box_min": (0.0, 0.0, 0.0),
        "box_max": (2.0, 1.0, 1.0),
        "near": 0.0,
        "far": 10.0,
        "step": 1.0,
        "n_steps": 5,  # three of them beyond the box
        "background": (1.0, 0.0, 0.5),
    }


def test_two_samples_by_hand() -> None:
    raw, problem = hand_problem()
    out = render(raw, **problem)
    assert out.kept.tolist() == [[True, True, False, False, False]]
    # T = 1, 1/2, 1/4; w = 1/2, 1/4
    expected = [
        0.5 * 0.75 + 0.25 * 0.25 + 0.25 * 1.0,
        0.5 * 0.5 + 0.25 * 0.5 + 0.25 * 0.0,
        0.5 * 0.5 + 0.25 * 0.5 + 0.25 * 0.5,
    ]
    np.testing.assert_allclose(out.rgb[0].numpy(), expected, rtol=1e-14)
    np.testing.assert_allclose(out.weights[0].numpy(), [0.5, 0.25, 0, 0, 0], rtol=1e-14)
    assert math.isclose(float(out.opacity), 0.75)
    assert math.isclose(float(out.transmittance), 0.25)
    assert math.isclose(float(out.depth), 0.5 * 0.5 + 0.25 * 1.5)


@pytest.mark.parametrize(
    ("scaling", "content_distance", "s1", "s2"),
    [
        ("none", 1.0, 1.0, 1.0),
        ("clamped", 1.0, 0.25, 1.0),
        ("quadratic", 1.0, 0.25, 2.25),
        ("clamped", 2.0, 0.0625, 0.5625),
    ],
)
def test_two_sample_gradient_by_hand(
    scaling: str, content_distance: float, s1: float, s2: float
) -> None:
    raw, problem = hand_problem()
    raw.requires_grad_()
    out = render(raw, **problem, scaling=scaling, content_distance=content_distance)
    (gradient,) = torch.autograd.grad(out.rgb[0, 0], raw)
    # of red, T_{i+1} c_i - sum_{j>i} w_j c_j - T_end background, times d softplus = 1/2, times s
    density1 = s1 * 0.5 * (0.5 * 0.75 - 0.25 * 0.25 - 0.25)
    density2 = s2 * 0.5 * (0.25 * 0.25 - 0.25)
    # w_i, times d sigmoid = c (1 - c) = 3/16, times s
    red1 = s1 * 0.5 * 3.0 / 16.0
    red2 = s2 * 0.25 * 3.0 / 16.0
    # each node of a plane has 1/4 across the ray; along it the samples sit halfway
    for channel, (first, second) in enumerate([(density1, density2), (red1, red2)]):
        planes = np.array([first / 2, (first + second) / 2, second / 2]) / 4
        np.testing.assert_allclose(
            gradient[..., channel].numpy(),
            np.broadcast_to(planes[:, None, None], (3, 2, 2)),
            rtol=1e-13,
        )
    assert not gradient[..., 2:].any()


# the whole render against a scalar loop


def loop_render(
    raw: Tensor,
    origin: Tensor,
    direction: Tensor,
    mask: Tensor,
    problem: dict[str, Any],
    transmittance_min: float,
    shift: float,
    background: list[float],
) -> tuple[list[float], float, float, float, list[int]]:
    """One ray in Python floats, sample after sample, stopping for good below the threshold."""
    node = raw.numpy()
    size = node.shape[:3]
    rgb, depth, light, visited = [0.0, 0.0, 0.0], 0.0, 1.0, []
    for k in range(problem["n_steps"]):
        t = problem["near"] + (k + 0.5) * problem["step"]
        if t >= problem["far"]:
            break
        if light < transmittance_min:
            break
        u, cell = [], []
        for a in range(3):
            low, high = problem["box_min"][a], problem["box_max"][a]
            share = (float(origin[a]) + t * float(direction[a]) - low) / (high - low)
            u.append(share * (size[a] - 1))
            cell.append(min(math.floor(share * mask.shape[a]), mask.shape[a] - 1))
        if any(u[a] < 0.0 or u[a] > size[a] - 1 for a in range(3)):
            continue
        if not mask[tuple(cell)]:
            continue
        value = np.zeros(4)
        for index in np.ndindex(*size):  # hat functions of every node
            hat = [max(0.0, 1.0 - abs(u[a] - index[a])) for a in range(3)]
            value += hat[0] * hat[1] * hat[2] * node[index]
        sigma = math.log1p(math.exp(value[0] + shift))
        alpha = 1.0 - math.exp(-sigma * problem["step"])
        for channel in range(3):
            rgb[channel] += light * alpha / (1.0 + math.exp(-value[1 + channel]))
        depth += light * alpha * t
        light *= 1.0 - alpha
        visited.append(k)
    rgb = [rgb[channel] + light * background[channel] for channel in range(3)]
    return rgb, 1.0 - light, depth, light, visited


@pytest.mark.parametrize(("transmittance_min", "far"), [(0.0, 4.0), (0.3, 4.0), (0.0, 2.0)])
def test_render_against_a_scalar_loop(transmittance_min: float, far: float) -> None:
    problem = tiny_problem() | {"far": far}
    raw, shift, background = tiny_raw(), 1.0, [0.2, 0.7, 1.0]
    mask = uniform(3, 2, 4, seed=8) < 0.7
    options = {"mask": mask, "transmittance_min": transmittance_min, "density_shift": shift}
    out = render(raw, **problem, **options, background=background)
    n_visited = 0
    for ray in range(len(problem["origins"])):
        rgb, opacity, depth, light, visited = loop_render(
            raw,
            problem["origins"][ray],
            problem["directions"][ray],
            mask,
            problem,
            transmittance_min,
            shift,
            background,
        )
        assert out.kept[ray].nonzero()[:, 0].tolist() == visited
        np.testing.assert_allclose(out.rgb[ray].numpy(), rgb, rtol=1e-12)
        np.testing.assert_allclose(float(out.opacity[ray]), opacity, rtol=1e-12)
        np.testing.assert_allclose(float(out.depth[ray]), depth, rtol=1e-12)
        np.testing.assert_allclose(float(out.transmittance[ray]), light, rtol=1e-12)
        n_visited += len(visited)
    # each of the three reasons to drop a sample was at work
    full = render(raw, **tiny_problem(), density_shift=shift)
    masked = render(raw, **tiny_problem(), density_shift=shift, mask=mask)
    assert 0 < int(masked.kept.sum()) < int(full.kept.sum()) < full.kept.numel()
    if transmittance_min > 0.0 or far < 4.0:
        assert 0 < n_visited < int(masked.kept.sum())


# the whole render against differences


@pytest.mark.parametrize("background", ["black", "white", "per ray"])
@pytest.mark.parametrize(
    "space",
    [
        {"norm": "none"},
        {"norm": "linf", "border": 0.2, "far": 30.0, "growth": 0.1, "n_linear": 9, "n_steps": 40},
        {"norm": "l2", "border": 1.0, "far": 30.0, "growth": 0.1, "n_linear": 9, "n_steps": 40},
    ],
    ids=lambda space: space["norm"],
)
def test_gradient_against_central_differences(background: str, space: dict[str, Any]) -> None:
    colors = {"black": torch.zeros(3), "white": torch.ones(3), "per ray": uniform(6, 3, seed=9)}
    problem = tiny_problem() | space | {"background": colors[background].double()}
    problem["offset"] = uniform(6, seed=10)
    target = uniform(6, 3, seed=11)
    on_opacity, on_depth = normal(6, seed=12), 0.1 * normal(6, seed=13)

    def loss(values: Tensor) -> Tensor:
        out = render(values, **problem)
        extra = (on_opacity * out.opacity).sum() + (on_depth * out.depth).sum()
        return photometric_loss(out.rgb, target) + extra

    raw = tiny_raw().requires_grad_()
    (gradient,) = torch.autograd.grad(loss(raw), raw)
    assert float(gradient.abs().max()) > 1e-2
    differences = torch.zeros_like(raw).detach()
    for index in np.ndindex(*raw.shape):
        direction = torch.zeros_like(differences)
        direction[index] = 1.0
        differences[index] = central_difference(loss, raw.detach(), direction, 1e-5)
    assert relative_error(gradient, differences) < 1e-8


def test_background_shifts_by_the_transmittance() -> None:
    problem, raw = tiny_problem(), tiny_raw()
    black, white = render(raw, **problem), render(raw, **problem, background=(1.0, 1.0, 1.0))
    torch.testing.assert_close(white.rgb - black.rgb, black.transmittance[:, None].expand(-1, 3))
    assert torch.equal(white.depth, black.depth) and float(black.transmittance.max()) > 0.01


def test_float32_agrees_with_float64() -> None:
    problem = tiny_problem() | {
        "norm": "linf",
        "far": 30.0,
        "growth": 0.1,
        "n_linear": 9,
        "n_steps": 40,
    }
    exact, rounded = render(tiny_raw(), **problem), render(tiny_raw().float(), **problem)
    assert rounded.rgb.dtype == rounded.depth.dtype == torch.float32
    assert relative_error(rounded.rgb, exact.rgb) < 1e-5
    assert relative_error(rounded.depth, exact.depth) < 1e-5


def test_density_scale_multiplies_the_density() -> None:
    problem, raw = tiny_problem(), tiny_raw()
    plain, denser = render(raw, **problem), render(raw, **problem, density_scale=2.0)
    torch.testing.assert_close(denser.transmittance, plain.transmittance**2)


def test_softplus_is_exact() -> None:
    x = torch.tensor([-800.0, -30.0, 0.0, 19.0, 25.0, 800.0], dtype=torch.float64)
    expected = [0.0, math.log1p(math.exp(-30.0)), LN2]
    expected += [19.0 + math.log1p(math.exp(-19.0)), 25.0 + math.log1p(math.exp(-25.0)), 800.0]
    np.testing.assert_allclose(softplus(x).numpy(), expected, rtol=1e-15)


# the gradient scaling


def test_scaler_is_identity_forward_and_scales_backward() -> None:
    sigma = normal(4, 5, seed=14).requires_grad_()
    colors = normal(4, 5, 3, seed=15).requires_grad_()
    scale, adj_sigma, adj_colors = (
        uniform(4, 5, seed=16),
        normal(4, 5, seed=17),
        normal(4, 5, 3, seed=18),
    )
    out_sigma, out_colors = GradientScaler.apply(sigma, colors, scale)
    assert torch.equal(out_sigma, sigma) and torch.equal(out_colors, colors)
    grads = torch.autograd.grad([out_sigma, out_colors], [sigma, colors], [adj_sigma, adj_colors])
    assert torch.equal(grads[0], scale * adj_sigma)
    assert torch.equal(grads[1], scale[..., None] * adj_colors)


def test_distance_scale_values() -> None:
    t = torch.tensor([[0.0, 1.0, 3.0], [0.0, 1.0, 3.0]], dtype=torch.float64)
    det = torch.tensor([[1.0, 0.5, 0.25], [1.0, 0.5, 0.25]], dtype=torch.float64)
    content = torch.tensor([2.0, 4.0], dtype=torch.float64)

    def scale(*arguments: Any) -> list[list[float]]:
        return distance_scale(t, *arguments).tolist()

    assert scale(2.0, "none")[0] == [1.0, 1.0, 1.0]
    assert scale(content, "quadratic") == [[0.0, 0.25, 2.25], [0.0, 0.0625, 0.5625]]
    assert scale(content, "clamped") == [[0.0, 0.25, 1.0], [0.0, 0.0625, 0.5625]]
    assert scale(2.0, "clamped", det, "none")[0] == [0.0, 0.25, 1.0]
    assert scale(2.0, "clamped", det, "density")[0] == [0.0, 0.125, 0.5625]
    assert scale(2.0, "clamped", det, "paper")[0] == [0.0, 0.5, 1.0]
    assert scale(2.0, "quadratic", det, "paper")[0] == [0.0, 0.5, 9.0]
    assert scale(1e-9, "clamped")[0] == [0.0, 1.0, 1.0]
    for bad in [
        (0.0, "clamped"),
        (math.nan, "clamped"),
        (1.0, "cubic"),
        (1.0, "clamped", None, "paper"),
    ]:
        with pytest.raises(ValueError):
            scale(*bad)


@pytest.mark.parametrize("jacobian", ["none", "density", "paper"])
@pytest.mark.parametrize("norm", ["none", "linf"])
def test_scaled_render(norm: str, jacobian: str) -> None:
    """The image stays bit-identical; each sample's gradient is scaled before the scatter."""
    problem = tiny_problem() | {"norm": norm, "border": 0.2, "background": (0.1, 0.5, 0.9)}
    content = 1.5 + 3.0 * uniform(6, seed=19)
    on_rgb, on_depth = normal(6, 3, seed=20), normal(6, seed=21)

    raw = tiny_raw().requires_grad_()
    plain = render(raw, **problem)
    scaled = render(raw, **problem, scaling="clamped", content_distance=content, jacobian=jacobian)
    for a, b in zip(plain, scaled, strict=True):
        assert torch.equal(a, b)
    outputs, adjoints = [scaled.rgb, scaled.depth], [on_rgb, on_depth]
    (gradient,) = torch.autograd.grad(outputs, raw, adjoints)

    # the same by hand: gradients of free samples, times s, through activations and interpolation
    centre = torch.tensor([0.1, 0.05, -0.05], dtype=torch.float64)
    half = torch.tensor([1.1, 0.85, 1.05], dtype=torch.float64)
    points = problem["origins"][:, None] + plain.t[..., None] * problem["directions"][:, None]
    q = (points - centre) / half
    border = 0.2 if norm == "linf" else 0.0
    c = contract(q, norm, border)
    u = (c / (1.0 + border) + 1.0) / 2.0 * torch.tensor([3.0, 4.0, 2.0], dtype=torch.float64)
    values = trilinear(raw, torch.where(plain.kept[..., None], u, 0.0))
    activated = [softplus(values[..., 0]), torch.sigmoid(values[..., 1:])]
    sigma, colors = (samples.detach().requires_grad_() for samples in activated)
    dt = torch.full((20,), 0.23, dtype=torch.float64)
    background = torch.tensor([0.1, 0.5, 0.9], dtype=torch.float64)
    out = integrate(sigma, colors, plain.t, dt, background, plain.kept)
    torch.testing.assert_close(out.rgb, plain.rgb, rtol=1e-12, atol=0)
    by_sample = torch.autograd.grad([out.rgb, out.depth], [sigma, colors], adjoints)
    det = jacobian_determinant_autograd(q, norm, border)
    power = {"none": 0, "density": 1, "paper": -1}[jacobian]
    s = ((plain.t / content[:, None]) ** 2 * det**power).clamp(max=1.0)
    assert bool((s[plain.kept] < 0.5).any()) and bool((s[plain.kept] == 1.0).any())
    (expected,) = torch.autograd.grad(
        activated, raw, [by_sample[0] * s, by_sample[1] * s[..., None]]
    )
    assert relative_error(gradient, expected) < 1e-12

    (unscaled,) = torch.autograd.grad([plain.rgb, plain.depth], raw, adjoints, retain_graph=True)
    assert relative_error(gradient, unscaled) > 0.05
    near_zero = render(raw, **problem, scaling="clamped", content_distance=1e-3, jacobian="none")
    (same,) = torch.autograd.grad([near_zero.rgb, near_zero.depth], raw, adjoints)
    assert torch.equal(same, unscaled)
