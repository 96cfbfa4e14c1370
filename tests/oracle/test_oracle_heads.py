"""The oracle's models: their parts against independent accounts, and the whole by hand."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.reference import (
    DeferredHead,
    FeaturesHead,
    Head,
    Network,
    RgbHead,
    ShHead,
    central_difference,
    distance_scale,
    grid_coordinates,
    integrate,
    jacobian_determinant,
    mlp,
    normalized_coordinates,
    photometric_loss,
    random_network,
    relative_error,
    render,
    softplus,
    spherical_harmonics,
    trilinear,
    view_encoding,
)
from tests.support.reference_tensors import normal, tiny_problem, uniform

# view encoding


@pytest.mark.parametrize("n_frequencies", [0, 1, 4])
def test_view_encoding_against_numpy(n_frequencies: int) -> None:
    d = torch.nn.functional.normalize(normal(5, 2, 3, seed=30), dim=-1)
    found = view_encoding(d, n_frequencies).numpy()
    assert found.shape == (5, 2, 3 + 6 * n_frequencies)
    expected = [d.numpy()]
    for k in range(n_frequencies):
        expected += [np.sin(d.numpy() * 2**k), np.cos(d.numpy() * 2**k)]
    np.testing.assert_allclose(found, np.concatenate(expected, axis=-1), rtol=1e-14)


def test_view_encoding_by_hand() -> None:
    found = view_encoding(torch.tensor([0.0, 0.6, -0.8], dtype=torch.float64), 2).tolist()
    s, c = math.sin, math.cos
    expected = [0.0, 0.6, -0.8]
    expected += [0.0, s(0.6), -s(0.8), 1.0, c(0.6), c(0.8)]
    expected += [0.0, s(1.2), -s(1.6), 1.0, c(1.2), c(1.6)]
    np.testing.assert_allclose(found, expected, rtol=1e-15)


# spherical harmonics


def legendre(degree: int, order: int, x: np.ndarray) -> np.ndarray:
    """P_l^m(x) with the Condon-Shortley phase, by recursion in the degree."""
    value, before = np.ones_like(x), np.zeros_like(x)
    for m in range(order):  # P_m^m = -(2 m - 1) sqrt(1 - x^2) P_{m-1}^{m-1}
        value = -(2 * m + 1) * np.sqrt(1 - x * x) * value
    for l in range(order, degree):  # noqa: E741
        after = ((2 * l + 1) * x * value - (l + order) * before) / (l - order + 1)
        value, before = after, value
    return value


def test_spherical_harmonics_against_legendre_functions() -> None:
    d = torch.nn.functional.normalize(normal(60, 3, seed=31), dim=-1)
    x, y, z = d.numpy().T
    azimuth = np.arctan2(y, x)
    expected = []
    for degree in range(4):
        for order in range(-degree, degree + 1):
            m = abs(order)
            share = math.factorial(degree - m) / math.factorial(degree + m)
            norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * share)
            wave = np.sin(m * azimuth) if order < 0 else np.cos(m * azimuth)
            expected.append((math.sqrt(2) if m else 1.0) * norm * wave * legendre(degree, m, z))
    for degree in range(4):
        found = spherical_harmonics(d, degree).numpy()
        count = (degree + 1) ** 2
        assert found.shape == (60, count)
        np.testing.assert_allclose(found, np.stack(expected[:count], axis=-1), atol=1e-13)
    with pytest.raises(ValueError, match="degree"):
        spherical_harmonics(d, 4)


def test_spherical_harmonics_are_orthonormal() -> None:
    """By a quadrature that is exact for polynomials of degree 6: 4 heights, 7 or more azimuths."""
    heights, shares = np.polynomial.legendre.leggauss(4)
    azimuths = 2 * math.pi * np.arange(8) / 8
    z, azimuth = np.meshgrid(heights, azimuths, indexing="ij")
    radius = np.sqrt(1 - z * z)
    d = torch.tensor(np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1))
    basis = spherical_harmonics(d, 3).numpy().reshape(-1, 16)
    area = np.broadcast_to(shares[:, None] * (2 * math.pi / 8), z.shape).reshape(-1, 1)
    np.testing.assert_allclose(basis.T @ (area * basis), np.eye(16), atol=1e-14)


def test_spherical_harmonics_have_the_usual_signs() -> None:
    """As the constants stand in the programs that made the convention."""
    x, y, z = 0.48, -0.6, 0.64
    found = spherical_harmonics(torch.tensor([x, y, z], dtype=torch.float64), 3).tolist()
    xx, yy, zz = x * x, y * y, z * z
    expected = [
        *(0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x),
        *(1.0925484 * x * y, -1.0925484 * y * z, 0.31539157 * (2 * zz - xx - yy)),
        *(-1.0925484 * x * z, 0.54627421 * (xx - yy), -0.59004359 * y * (3 * xx - yy)),
        *(2.89061144 * x * y * z, -0.45704580 * y * (4 * zz - xx - yy)),
        *(0.37317633 * z * (2 * zz - 3 * xx - 3 * yy), -0.45704580 * x * (4 * zz - xx - yy)),
        *(1.44530572 * z * (xx - yy), -0.59004359 * x * (xx - 3 * yy)),
    ]
    np.testing.assert_allclose(found, expected, rtol=2e-7)


# networks


@pytest.mark.parametrize("n_hidden", [0, 1, 2, 3])
def test_mlp_against_torch(n_hidden: int) -> None:
    network = random_network(7, n_hidden, 5, seed=32)
    layers: list[torch.nn.Module] = []
    for weight, bias in zip(*network, strict=True):
        linear = torch.nn.Linear(*weight.shape, dtype=torch.float64)
        with torch.no_grad():
            linear.weight.copy_(weight.T)
            linear.bias.copy_(bias)
        layers += [linear, torch.nn.ReLU()]
    theirs = torch.nn.Sequential(*layers[:-1])
    assert len(layers) == 2 * (n_hidden + 1)

    x, adjoint = normal(4, 6, 7, seed=33).requires_grad_(), normal(4, 6, 3, seed=34)
    parameters = [p.requires_grad_() for pair in zip(*network, strict=True) for p in pair]
    ours = mlp(x, network)
    expected = theirs(x)
    torch.testing.assert_close(ours, expected, rtol=1e-13, atol=1e-13)
    found = torch.autograd.grad(ours, [x, *parameters], adjoint)
    wanted = torch.autograd.grad(expected, [x, *theirs.parameters()], adjoint)
    for i, (a, b) in enumerate(zip(found, wanted, strict=True)):
        torch.testing.assert_close(a, b if i % 2 == 0 else b.T, rtol=1e-12, atol=1e-12)


# the models

THRESHOLD = 0.03
HEADS: dict[str, Head] = {
    "rgb": RgbHead(),
    "sh0": ShHead(0),
    "sh1": ShHead(1),
    "sh2": ShHead(2),
    "sh3": ShHead(3),
    "deferred": DeferredHead(random_network(3 + 4 + 9, seed=35)),
    "deferred, other sizes": DeferredHead(random_network(3 + 2 + 15, 1, 8, seed=36), 2, 2),
    "residual": FeaturesHead(random_network(9 + 27, seed=37), threshold=THRESHOLD),
    "direct": FeaturesHead(
        random_network(5 + 9, 1, 8, seed=38), 5, 1, residual=False, threshold=THRESHOLD
    ),
}
SPACES: dict[str, dict[str, Any]] = {
    "none": {"norm": "none"},
    "linf": {
        "norm": "linf",
        "border": 0.2,
        "far": 30.0,
        "growth": 0.1,
        "n_linear": 9,
        "n_steps": 40,
    },
}


def make_raw(head: Head, seed: int = 39) -> Tensor:
    return normal(4, 5, 3, 1 + head.n_features, seed=seed)


def make_problem(space: str = "none") -> dict[str, Any]:
    """With all that the walk can do."""
    return (
        tiny_problem()
        | SPACES[space]
        | {
            "offset": uniform(6, seed=40),
            "mask": uniform(3, 2, 4, seed=41) < 0.8,
            "background": uniform(6, 3, seed=42),
            "density_shift": 0.5,
            "density_scale": 1.5,
            "transmittance_min": 0.02,
        }
    )


def parameters_of(head: Head) -> list[Tensor]:
    network = getattr(head, "network", None)
    return [] if network is None else [*network.weights, *network.biases]


def values_at(raw: Tensor, problem: dict[str, Any], t: Tensor, kept: Tensor) -> Tensor:
    """What lies at the samples that count [n_rays, n_steps, 1 + F]."""
    low, high = torch.tensor([problem["box_min"], problem["box_max"]], dtype=torch.float64)
    points = problem["origins"][:, None] + t[..., None] * problem["directions"][:, None]
    norm, border = problem["norm"], problem.get("border", 1.0)
    u = grid_coordinates(points, low, high, raw.shape, norm, border)
    return trilinear(raw, torch.where(kept[..., None], u, 0.0))


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def perceptron(x: np.ndarray, network: Network) -> np.ndarray:
    """One input, neuron after neuron."""
    n_layers = len(network.weights)
    for layer in range(n_layers):
        weight, bias = network.weights[layer].numpy(), network.biases[layer].numpy()
        y = np.zeros(weight.shape[1])
        for j in range(weight.shape[1]):
            y[j] = bias[j] + sum(x[i] * weight[i, j] for i in range(weight.shape[0]))
        x = y if layer == n_layers - 1 else np.maximum(y, 0.0)
    return x


def sample_color(head: Head, f: np.ndarray, d: Tensor, weight: float) -> np.ndarray:
    """One sample of a model without a part for the ray."""
    if isinstance(head, RgbHead):
        return sigmoid(f)
    if isinstance(head, ShHead):
        basis = spherical_harmonics(d, head.degree).numpy()
        return sigmoid(
            np.array([sum(b * f[3 * k + c] for k, b in enumerate(basis)) for c in range(3)])
        )
    assert isinstance(head, FeaturesHead)
    if weight <= head.threshold:
        return np.zeros(3)
    encoded = view_encoding(d, head.n_frequencies).numpy()
    if head.residual:
        return sigmoid(f[:3] + perceptron(np.concatenate([f[3:], encoded]), head.network))
    return sigmoid(perceptron(np.concatenate([f, encoded]), head.network))


@pytest.mark.parametrize("name", HEADS)
def test_model_against_a_scalar_loop(name: str) -> None:
    head, problem = HEADS[name], make_problem("linf")
    raw = make_raw(head)
    out = render(raw, **problem, head=head)
    assert torch.equal(out.n_samples, out.kept.sum(dim=1)) and int(out.n_samples.min()) > 0
    values = values_at(raw, problem, out.t, out.kept).numpy()
    for ray in range(6):
        d, background = problem["directions"][ray], problem["background"][ray].numpy()
        light, rgb, depth = 1.0, np.zeros(3), 0.0
        composited = np.zeros(head.n_features)
        edges = [problem["near"] + k * problem["step"] for k in range(10)]
        while len(edges) < 41:
            edges.append(edges[-1] * 1.1)
        for k in np.flatnonzero(out.kept[ray].numpy()):
            sigma = 1.5 * math.log1p(math.exp(values[ray, k, 0] + 0.5))
            alpha = 1.0 - math.exp(-sigma * (edges[k + 1] - edges[k]))
            weight, features = light * alpha, values[ray, k, 1:]
            if isinstance(head, DeferredHead):
                composited += weight * sigmoid(features)
            else:
                rgb += weight * sample_color(head, features, d, weight)
            depth += weight * float(out.t[ray, k])
            light *= 1.0 - alpha
        if isinstance(head, DeferredHead):
            encoded = view_encoding(d, head.n_frequencies).numpy()
            specular = perceptron(np.concatenate([composited, encoded]), head.network)
            rgb = composited[:3] + (1.0 - light) * specular
        np.testing.assert_allclose(out.rgb[ray].numpy(), rgb + light * background, rtol=1e-10)
        np.testing.assert_allclose(float(out.opacity[ray]), 1.0 - light, rtol=1e-11)
        np.testing.assert_allclose(float(out.depth[ray]), depth, rtol=1e-11)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", HEADS)
def test_gradient_against_central_differences(name: str, space: str) -> None:
    """Of the grid in random directions, of a network number by number."""
    head, problem = HEADS[name], make_problem(space)
    target = uniform(6, 3, seed=43)
    on_rgb, on_opacity, on_depth = (
        normal(6, 3, seed=44),
        normal(6, seed=45),
        0.1 * normal(6, seed=46),
    )
    raw = make_raw(head)
    parameters = parameters_of(head)

    def loss(values: Tensor) -> Tensor:
        out = render(values, **problem, head=head)
        linear = (on_rgb * out.rgb).sum() + (on_opacity * out.opacity).sum()
        return photometric_loss(out.rgb, target) + linear + (on_depth * out.depth).sum()

    leaves = [raw, *parameters]
    for leaf in leaves:
        leaf.requires_grad_()
    gradients = torch.autograd.grad(loss(raw), leaves)
    for leaf in leaves:
        leaf.requires_grad_(False)
    assert all(float(gradient.abs().max()) > 1e-3 for gradient in gradients)

    differences, expected = [], []
    for seed in range(20):
        direction = normal(*raw.shape, seed=200 + seed)
        differences.append(central_difference(loss, raw, direction, 1e-6))
        expected.append((gradients[0] * direction).sum())
    for parameter, gradient in zip(parameters, gradients[1:], strict=True):
        for index in list(np.ndindex(*parameter.shape))[:: max(1, parameter.numel() // 5)]:
            was = float(parameter[index])
            at = []
            for value in (was + 1e-6, was - 1e-6):
                parameter[index] = value
                at.append(loss(raw))
            parameter[index] = was
            differences.append((at[0] - at[1]) / 2e-6)
            expected.append(gradient[index])
    assert relative_error(torch.stack(expected), torch.stack(differences)) < 1e-7


@pytest.mark.parametrize("name", HEADS)
def test_padding_is_not_read(name: str) -> None:
    head, problem = HEADS[name], make_problem()
    raw = make_raw(head)
    plain = render(raw, **problem, head=head)
    padded = torch.cat([raw, torch.full((4, 5, 3, 3), math.nan, dtype=torch.float64)], dim=-1)
    padded.requires_grad_()
    out = render(padded, **problem, head=head)
    for a, b in zip(plain, out, strict=True):
        assert torch.equal(a, b)
    (gradient,) = torch.autograd.grad(out.rgb.sum(), padded)
    assert not gradient[..., -3:].any() and bool((gradient[..., :-3] != 0).any())


def test_sh_of_degree_0_is_rgb() -> None:
    raw, problem = make_raw(RgbHead()), make_problem()
    scaled = raw.clone()
    scaled[..., 1:] *= 2.0 * math.sqrt(math.pi)
    expected = render(raw, **problem).rgb
    torch.testing.assert_close(render(scaled, **problem, head=ShHead(0)).rgb, expected)


@pytest.mark.parametrize("residual", [True, False])
def test_a_network_of_zeros(residual: bool) -> None:
    """Residual: rgb of the first three features; direct: grey."""
    network = random_network((9 if residual else 12) + 27)
    for tensor in [*network.weights, *network.biases]:
        tensor.zero_()
    head = FeaturesHead(network, residual=residual, threshold=0.0)
    raw, problem = make_raw(head), make_problem()
    found = render(raw, **problem, head=head)
    if not residual:
        raw[..., 1:] = 0.0
    expected = render(raw[..., :4], **problem)
    torch.testing.assert_close(found.rgb, expected.rgb)


def test_threshold() -> None:
    """What is dropped is colour, and nothing else."""
    problem = make_problem()
    network = random_network(9 + 27, seed=37)
    head, everything = (
        FeaturesHead(network, threshold=THRESHOLD),
        FeaturesHead(network, threshold=0),
    )
    raw = make_raw(head)
    found, full = render(raw, **problem, head=head), render(raw, **problem, head=everything)
    for name in ("opacity", "depth", "transmittance", "weights", "kept"):
        assert torch.equal(getattr(found, name), getattr(full, name))
    kept, dropped = found.kept, found.kept & (found.weights <= THRESHOLD)
    assert 0.1 < float(dropped.sum() / kept.sum()) < 0.9
    features = values_at(raw, problem, found.t, kept)[..., 1:]
    colors = everything.shade(features, problem["directions"], found.weights)
    lost = (torch.where(dropped, found.weights, 0.0)[..., None] * colors).sum(dim=1)
    torch.testing.assert_close(full.rgb - found.rgb, lost)
    # exactly at the threshold there is none
    at = found.weights[0, kept[0]].max()
    edge = FeaturesHead(network, threshold=float(at))
    above = FeaturesHead(network, threshold=float(at) * (1.0 - 1e-12))
    sky = found.transmittance[0] * problem["background"][0]
    assert torch.equal(render(raw, **problem, head=edge).rgb[0], sky)
    assert float((render(raw, **problem, head=above).rgb[0] - sky).min()) > 1e-3


@pytest.mark.parametrize("jacobian", ["none", "density", "paper"])
@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("name", HEADS)
def test_where_the_scaling_acts(name: str, space: str, jacobian: str) -> None:
    """On each sample's density and what is composited of it; never on a ray's network."""
    head, problem = HEADS[name], make_problem(space)
    content = 1.2 + 2.0 * uniform(6, seed=47)
    adjoints = [normal(6, 3, seed=48), normal(6, seed=49), normal(6, seed=50)]
    scaling = {"scaling": "clamped", "content_distance": content, "jacobian": jacobian}
    raw = make_raw(head).requires_grad_()
    leaves = [raw, *(p.requires_grad_() for p in parameters_of(head))]

    def gradients(**options: Any) -> tuple[Any, tuple[Tensor, ...]]:
        out = render(raw, **problem, head=head, **options)
        outputs = [out.rgb, out.opacity, out.depth]
        return out, torch.autograd.grad(outputs, leaves, adjoints)

    (plain, unscaled), (out, found) = gradients(), gradients(**scaling)
    for a, b in zip(plain, out, strict=True):
        assert torch.equal(a, b)

    values = values_at(raw, problem, out.t, out.kept)
    sigma = 1.5 * softplus(values[..., 0] + 0.5)
    channels = head.shade(values[..., 1:], problem["directions"], out.weights.detach())
    free = [samples.detach().requires_grad_() for samples in (sigma, channels)]
    edges = problem["near"] + problem["step"] * torch.arange(10, dtype=torch.float64)
    grown = edges[-1] * 1.1 ** torch.arange(1, 32, dtype=torch.float64)
    dt = (
        torch.cat([edges, grown]).diff()
        if space == "linf"
        else torch.tensor([0.23] * 20, dtype=torch.float64).double()
    )
    by_hand = integrate(
        *free,
        out.t,
        dt,
        problem["background"],
        out.kept,
        head=head,
        directions=problem["directions"],
    )
    torch.testing.assert_close(by_hand.rgb, out.rgb)
    on_samples = torch.autograd.grad(
        [by_hand.rgb, by_hand.opacity, by_hand.depth], free, adjoints, retain_graph=True
    )
    low, high = torch.tensor([problem["box_min"], problem["box_max"]], dtype=torch.float64)
    points = problem["origins"][:, None] + out.t[..., None] * problem["directions"][:, None]
    q = normalized_coordinates(points, low, high)
    det = jacobian_determinant(q, problem["norm"], problem.get("border", 1.0))
    s = distance_scale(out.t, content, "clamped", det, jacobian)
    assert bool((s[out.kept] < 0.5).any()) and bool((s[out.kept] == 1.0).any())
    scaled = [on_samples[0] * s, on_samples[1] * s[..., None]]
    expected = torch.autograd.grad([sigma, channels], leaves, scaled, allow_unused=True)
    assert relative_error(found[0], expected[0]) < 1e-10
    assert relative_error(found[0], unscaled[0]) > 0.05
    for ours, hand, without in zip(found[1:], expected[1:], unscaled[1:], strict=True):
        if isinstance(head, DeferredHead):
            assert torch.equal(ours, without) and hand is None
        else:
            assert relative_error(ours, hand) < 1e-10
            assert relative_error(ours, without) > 0.05
    for leaf in leaves:
        leaf.requires_grad_(False)
