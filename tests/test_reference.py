"""The oracle of tests/reference, tested against independent accounts of the same numbers."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from reference import (
    GradientScaler,
    adam,
    central_difference,
    contract,
    distance_scale,
    distort,
    grid_coordinates,
    integrate,
    jacobian_determinant,
    jacobian_determinant_autograd,
    photometric_loss,
    pinhole_rays,
    relative_error,
    render,
    sample_distances,
    softplus,
    total_variation,
    trilinear,
    undistort,
)
from torch import Tensor

LN2 = math.log(2.0)
LN3 = math.log(3.0)


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(*shape, generator=generator(seed), dtype=torch.float64)


def uniform(*shape: int, seed: int) -> Tensor:
    return torch.rand(*shape, generator=generator(seed), dtype=torch.float64)


def tiny_problem(n_rays: int = 6) -> dict[str, Any]:
    """Rays from around a box that is a little off-centre and not a cube."""
    origins = 2.0 * torch.nn.functional.normalize(normal(n_rays, 3, seed=1), dim=-1)
    targets = 0.4 * normal(n_rays, 3, seed=2)
    return {
        "origins": origins,
        "directions": torch.nn.functional.normalize(targets - origins, dim=-1),
        "box_min": (-1.0, -0.8, -1.1),
        "box_max": (1.2, 0.9, 1.0),
        "near": 0.1,
        "far": 4.0,
        "step": 0.23,
        "n_steps": 20,
    }


def tiny_raw(seed: int = 3) -> Tensor:
    return normal(4, 5, 3, 4, seed=seed)


# contraction and coordinates


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


# one ray by hand


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


# training


def test_photometric_loss_by_hand() -> None:
    rgb = torch.tensor([[0.5, 0.0, 1.0], [0.0, 0.0, 0.0]], requires_grad=True)
    target = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    loss = photometric_loss(rgb, target)
    assert loss.item() == (0.25 + 1.0 + 1.0) / 2
    (gradient,) = torch.autograd.grad(loss, rgb)
    assert gradient.tolist() == [[0.5, 0.0, 1.0], [0.0, -1.0, 0.0]]


def test_total_variation_against_pairs() -> None:
    raw, weights = tiny_raw(), torch.tensor([0.5, 1.0, 2.0, 0.0], dtype=torch.float64)
    expected = 0.0
    for i, j, k, c in np.ndindex(*raw.shape):
        for other in [(i + 1, j, k, c), (i, j + 1, k, c), (i, j, k + 1, c)]:
            if all(other[a] < raw.shape[a] for a in range(3)):
                d = abs(float(raw[i, j, k, c] - raw[other]))
                expected += float(weights[c]) * (d * d / 2 if d <= 1 else d - 0.5)
    assert math.isclose(float(total_variation(raw, weights)), expected)
    raw.requires_grad_()
    (gradient,) = torch.autograd.grad(total_variation(raw, weights), raw)
    direction = normal(*raw.shape, seed=22)
    difference = central_difference(
        lambda values: total_variation(values, weights), raw.detach(), direction, 1e-6
    )
    assert relative_error((gradient * direction).sum(), difference) < 1e-8
    assert not gradient[..., 3].any()


def test_adam_against_torch_and_skips_zero_gradients() -> None:
    param, lr, betas, eps = normal(7, seed=23), 0.1, (0.9, 0.99), 1e-8
    m, v = torch.zeros_like(param), torch.zeros_like(param)
    theirs = param.clone().requires_grad_()
    optimizer = torch.optim.Adam([theirs], lr=lr, betas=betas, eps=eps)
    for step in range(1, 6):
        theirs.grad = normal(7, seed=100 + step)
        optimizer.step()
        param, m, v = adam(param, m, v, theirs.grad, step, lr, *betas, eps)
    torch.testing.assert_close(param, theirs.detach(), rtol=1e-12, atol=0)

    grad = normal(7, seed=24)
    grad[2], grad[5] = 0.0, -0.0
    moved, new_m, new_v = adam(param, m, v, grad, 6, lr, *betas, eps)
    still = torch.tensor([2, 5])
    for new, old in [(moved, param), (new_m, m), (new_v, v)]:
        assert (new == old).nonzero()[:, 0].equal(still)


# cameras

LENSES = [
    {},
    {"k1": -0.12, "k2": 0.03},
    {"k1": 0.08, "k2": -0.02, "p1": 1e-3, "p2": -2e-3, "k3": 0.004},
]


def lens_vector(lens: dict[str, float]) -> np.ndarray:
    return np.array([lens.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])


@pytest.mark.parametrize("lens", LENSES)
def test_rays_against_opencv(lens: dict[str, float]) -> None:
    fx, fy, cx, cy = 310.0, 290.0, 205.0, 148.0
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    v, u = np.meshgrid(np.arange(0, 300, 23), np.arange(0, 400, 31), indexing="ij")
    rng = np.random.default_rng(25)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    position = rng.normal(size=3)
    c2w = np.concatenate([rotation, position[:, None]], axis=1)

    origins, directions = pinhole_rays(fx, fy, cx, cy, c2w, u, v, **lens)
    assert origins.shape == directions.shape == (*u.shape, 3)
    assert np.array_equal(origins, np.broadcast_to(position, origins.shape))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, rtol=1e-15)

    # undistortPoints gives the point that OpenCV means for each pixel centre
    centres = np.stack([u, v], axis=-1).reshape(-1, 1, 2) + 0.5
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    theirs = cv2.undistortPoints(centres, matrix, lens_vector(lens), criteria=criteria)[:, 0]
    in_camera = directions.reshape(-1, 3) @ rotation
    assert np.all(in_camera[:, 2] < 0.0)
    ours = np.stack([in_camera[:, 0], -in_camera[:, 1]], axis=-1) / -in_camera[:, 2:]
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-10)

    # and projectPoints brings a point on each ray back to the pixel centre
    opencv_axes = in_camera * np.array([1.0, -1.0, -1.0])
    zero = np.zeros(3)
    back = cv2.projectPoints(4.0 * opencv_axes, zero, zero, matrix, lens_vector(lens))[0]
    np.testing.assert_allclose(back, centres, rtol=0, atol=1e-9)


def test_undistort_inverts_to_1e_14() -> None:
    rng = np.random.default_rng(26)
    for lens in LENSES:
        x, y = rng.uniform(-0.7, 0.7, size=(2, 500))
        found = undistort(*distort(x, y, **lens), **lens)
        np.testing.assert_allclose(found, [x, y], rtol=0, atol=5e-14)
        again = distort(*found, **lens)
        np.testing.assert_allclose(again, distort(x, y, **lens), rtol=0, atol=1e-14)
    with pytest.raises(ValueError, match="no inverse"):
        undistort(2.0, 0.0, k1=-0.5)  # r - r^3 / 2 never exceeds 0.55


def test_ray_directions_by_hand() -> None:
    identity = np.eye(4)
    _, ahead = pinhole_rays(100.0, 50.0, 20.5, 10.5, identity, 20, 10)
    assert ahead.tolist() == [0.0, 0.0, -1.0]
    _, corner = pinhole_rays(100.0, 50.0, 20.5, 10.5, identity, 120, 110)
    # 100 pixels right and 100 down: tangents 1 and 2, and down is -y
    np.testing.assert_allclose(corner, np.array([1.0, -2.0, -1.0]) / math.sqrt(6.0))


# measures


def test_measures() -> None:
    x = torch.tensor([0.3, -0.2], dtype=torch.float64)
    direction = torch.tensor([2.0, 1.0], dtype=torch.float64)
    slope = central_difference(lambda p: (p**3).sum(), x, direction, 1e-4)
    assert math.isclose(float(slope), 3 * (0.09 * 2.0 + 0.04), rel_tol=1e-6)
    assert relative_error([1.0, 2.0], [1.0, 4.0]) == 0.5
    assert relative_error(np.array([3.0], dtype=np.float32), torch.tensor([4.0])) == 0.25
    assert math.isnan(relative_error([math.nan, 2.0], [1.0, 4.0]))
    with pytest.raises(ValueError, match="zero"):
        relative_error([1.0], [0.0])
    with pytest.raises(ValueError, match="shapes"):
        relative_error([1.0], [1.0, 2.0])
