"""Proposals: histograms of rays, intervals drawn from them, and the adjoint of the bound."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.kernels.test_render import early, masked
from tests.reference import resampling
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.problems import Problem, in_float32, make_problem, unbounded
from tests.support.proposal_runner import EPSILON, Drawn, Proposing, edges_of, histogram_of

SPACES = {"box": ("none", 0.0), "linf": ("linf", 1.0), "l2": ("l2", 0.7)}
each_space = pytest.mark.parametrize("space", SPACES)
DRAWN = {
    "near 0": Drawn(),
    "from a near plane on": Drawn(unit=0.0),
    "annealed": Drawn(anneal=0.3, samples=20),
    "more bins": Drawn(bins=48, samples=16),
}
each_way = pytest.mark.parametrize("drawn", DRAWN.values(), ids=DRAWN.keys())


def problem(space: str, seed: int) -> Problem:
    offsets = np.random.default_rng(seed).uniform(size=12)
    p = make_problem(seed, offsets=offsets, density_scale=2.0)
    contraction, border = SPACES[space]
    if contraction != "none":
        p = unbounded(p, contraction, border)
    return early(masked(p, seed)) if seed % 2 else p


def densities(p: Problem) -> torch.Tensor:
    return torch.tensor(p.raw[..., 0], requires_grad=True)


@each_space
@each_way
def test_histograms_and_edges_against_the_oracle(
    space: str, drawn: Drawn, kernels64: Kernels
) -> None:
    met = 0
    for seed in range(4):
        p = problem(space, seed)
        weights, edges = Proposing(kernels64, p, drawn).forward()
        found = histogram_of(p, drawn, densities(p))
        hits = found.edges.isfinite().all(dim=1).numpy()
        expected = found.weights.detach().numpy()
        assert_close(weights[hits], expected[hits], 1e-11)
        drawn_edges = edges_of(p, drawn, found).detach().numpy()
        assert_close(edges[hits], drawn_edges[hits], 1e-10)
        assert (np.diff(edges[hits]) > 0.0).all()
        met += int((expected[hits].sum(axis=1) > 0.1).sum())
    assert met > 12


@each_space
def test_the_vector_form_equals_the_plain_one(
    space: str, kernels64: Kernels, packed: Kernels
) -> None:
    for seed in range(4):
        for drawn in DRAWN.values():
            p = in_float32(problem(space, seed))
            exact = Proposing(kernels64, p, drawn).forward()
            found = Proposing(packed, p, drawn)
            weights, edges = found.forward()
            assert_close(weights, exact[0], 3e-5)
            # By the coordinate that bins are uniform in: the last ones are as long as all others.
            near, far = 1.0 / (0.1 + exact[1]), 1.0 / (0.1 + edges)
            assert_close(far, near, 1e-4)


def bounded(p: Problem, drawn: Drawn) -> np.ndarray:
    """What intervals may weigh: more than their bins for most."""
    weights = np.random.default_rng(5).uniform(0.0, 0.4, (p.n_rays, drawn.samples))
    weights[:, ::5] = 0.0
    return weights


@each_space
@each_way
def test_the_bound_and_its_gradient_against_the_oracle(
    space: str, drawn: Drawn, kernels64: Kernels
) -> None:
    total = 0.0
    for seed in range(4):
        p = problem(space, seed)
        kernel, weights = Proposing(kernels64, p, drawn), bounded(p, drawn)
        edges = kernel.forward()[1]
        # Edges of intervals of which none is an edge of a bin: those are as rounding has it.
        edges = edges + 1e-7 * np.diff(edges, append=edges[:, -1:]) * (edges > edges[:, :1])
        loss, gradient = kernel.backward(weights, edges)
        density = densities(p)
        found = histogram_of(p, drawn, density)
        hits = found.edges.isfinite().all(dim=1)
        expected = resampling.bound_loss(
            torch.tensor(edges)[hits],
            torch.tensor(weights)[hits],
            found.edges[hits],
            found.weights[hits],
            EPSILON,
        )
        assert_close(loss[hits.numpy()], expected.detach().numpy(), 1e-10)
        assert not loss[~hits.numpy()].any()
        (by_autograd,) = torch.autograd.grad(expected.sum(), density)
        assert_close(gradient, by_autograd.numpy(), 1e-10)
        total += float(by_autograd.abs().sum())
    assert total > 1.0


@each_space
def test_the_gradient_of_the_bound_against_central_differences(
    space: str, kernels64: Kernels
) -> None:
    """Edges and weights of intervals are constants: nothing flows through them."""
    h, drawn = 1e-5, Drawn()
    for seed in range(4):
        p = problem(space, seed)
        p = replace(p, steps=replace(p.steps, transmittance_min=0.0))
        kernel, weights = Proposing(kernels64, p, drawn), bounded(p, drawn)
        edges = kernel.forward()[1]
        gradient = kernel.backward(weights, edges)[1]

        def loss(raw: np.ndarray, p: Problem = p, edges: np.ndarray = edges) -> float:
            moved = Proposing(kernels64, replace(p, raw=raw), drawn)
            moved.forward()
            return float(moved.backward(bounded(p, drawn), edges)[0].sum())

        rng, found, expected = np.random.default_rng(seed), [], []
        for _ in range(6):
            direction = rng.normal(size=p.raw.shape)
            at = {k: loss(p.raw + k * h * direction) for k in (-2, -1, 1, 2)}
            near, far = at[1] - at[-1], at[2] - at[-2]
            found.append(np.vdot(direction[..., 0], gradient))
            expected.append((8.0 * near - far) / (12.0 * h))
        assert np.abs(expected).max() > 0.01
        assert_close(found, expected, 1e-7)


@each_space
def test_the_gradient_is_the_same_however_many_add_it(space: str, packed: Kernels) -> None:
    p = in_float32(problem(space, 2))
    drawn = Drawn()
    weights = bounded(p, drawn)
    found = []
    for parts in (1, 2, 3):
        kernel = Proposing(packed, p, drawn)
        kernel.forward()
        found.append(kernel.backward(weights, parts=parts)[1])
    assert found[0].any()
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_no_interval_above_its_bins_no_gradient(kernels64: Kernels) -> None:
    p, drawn = problem("linf", 0), Drawn()
    kernel = Proposing(kernels64, p, drawn)
    kernel.forward()
    loss, gradient = kernel.backward(np.full((p.n_rays, drawn.samples), 1e-9))
    assert not loss.any() and not gradient.any()
