"""Models that see the direction of view: values and gradients in float64, against the oracle."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.kernels.test_render import early, masked
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.model_problems import (
    DEFERRED,
    DEFERRED_LARGE,
    DEFERRED_SMALL,
    FEATURES,
    FEATURES_LARGE,
    FEATURES_SMALL,
    SH,
    layers_of,
    name_of,
    oracle_both,
    oracle_seen,
    oracle_train_both,
    problem_of,
)
from tests.support.problems import Problem, unbounded, unscaled
from warpnerf.model.interface import Model

CASES = [
    (SH[0], "none"),
    (SH[1], "linf"),
    (SH[2], "linf"),
    (SH[3], "none"),
    (DEFERRED_SMALL, "none"),
    (DEFERRED, "none"),
    (DEFERRED_LARGE, "linf"),
    (FEATURES_SMALL, "none"),
    (FEATURES, "none"),
    (FEATURES_LARGE, "linf"),
]
"""Each is compiled for one contraction, and for the clamped scaling; see ``unscaled``."""
each_case = pytest.mark.parametrize(
    ("model", "contraction"), CASES, ids=[f"{name_of(model)}-{where}" for model, where in CASES]
)
SEEDS = range(4)
LARGE = (DEFERRED_LARGE, FEATURES_LARGE)


def problem(model: Model, contraction: str, seed: int) -> Problem:
    """On odd seeds with free space, and rays that end early."""
    p = problem_of(model, seed)
    if contraction != "none":
        p = unbounded(p, contraction, 0.2)
    return early(masked(p, seed)) if seed % 2 else p


def assert_layers_close(model: Model, value: Any, expected: Any, tolerance: float) -> None:
    """Each layer's weights and biases by themselves; the output's padding has no gradient."""
    for layer, wanted in zip(layers_of(model, value), layers_of(model, expected), strict=True):
        assert_close(layer, wanted, tolerance)
    rest = value.copy()
    for layer in layers_of(model, rest):
        layer[...] = 0.0
    assert not rest.any()


@each_case
def test_values_and_gradients_against_autograd(
    model: Model, contraction: str, kernels64: Kernels
) -> None:
    first = len(SEEDS) * CASES.index((model, contraction))
    for seed in range(first, first + len(SEEDS)):
        p = problem(model, contraction, seed)
        ours, theirs = kernels64.forward(p), oracle_seen(p)
        assert_close(ours.rgb, theirs.rgb, 1e-11)
        assert_close(ours.opacity, theirs.opacity, 1e-11)
        assert_close(ours.depth, theirs.depth, 1e-11)
        assert np.array_equal(ours.n_samples, theirs.n_samples.numpy())
        plain = oracle_both(p)
        for given, expected in ((p, oracle_both(p, "clamped")), (unscaled(p), plain)):
            values, weights = kernels64.both_backward(given, "clamped")
            assert_close(values, expected[0], 1e-9)
            assert not values[..., 1 + model.n_features :].any()  # padding
            assert_layers_close(model, weights, expected[1], 1e-9)
            if given is p:
                assert np.abs(plain[0] - values).max() > 0.02 * np.abs(plain[0]).max()


@pytest.mark.parametrize("model", [DEFERRED_SMALL, FEATURES_SMALL, SH[0]], ids=name_of)
def test_training_launch_against_autograd(model: Model, kernels64: Kernels) -> None:
    for seed in range(5):
        p = problem(model, "none", seed)
        error, values, weights = kernels64.both_train(p, "clamped")
        expected = oracle_train_both(p, "clamped")
        assert_close(error, expected[0], 1e-11)
        assert_close(values, expected[1], 1e-9)
        assert_layers_close(model, weights, expected[2], 1e-9)


@pytest.mark.parametrize("model", [DEFERRED_SMALL, FEATURES_SMALL], ids=name_of)
def test_weights_get_the_gradient_of_many_rays(model: Model, kernels64: Kernels) -> None:
    """More than a warp of CUDA, whose threads add up among themselves where all of them can."""
    p = problem_of(model, 3, n_rays=80)
    expected = oracle_train_both(p, "clamped")[2]
    assert_layers_close(model, kernels64.both_train(p, "clamped")[2], expected, 1e-9)


def test_the_threshold_leaves_samples_out(kernels64: Kernels) -> None:
    """Some, not all: then rays would have no colour."""
    p = problem_of(FEATURES, 2)
    weights = oracle_seen(p).weights.numpy()
    lit = weights[weights > 0.0]
    assert 0.1 < (lit > FEATURES.threshold).mean() < 0.9
    all_lit = kernels64.forward(replace(p, model=replace(FEATURES, threshold=0.0))).rgb
    assert np.abs(all_lit - kernels64.forward(p).rgb).max() > 1e-3


@pytest.mark.parametrize(
    ("model", "contraction"),
    [
        pytest.param(*case, marks=pytest.mark.slow if case[0] in LARGE else (), id=name_of(case[0]))
        for case in CASES
    ],
)
def test_adjoint_against_central_differences(
    model: Model, contraction: str, kernels64: Kernels
) -> None:
    """Of values and of weights, along random directions that cross no kink."""
    for seed in SEEDS:
        p = problem(model, contraction, seed)
        rng = np.random.default_rng(seed)
        gradients = kernels64.both_backward(unscaled(p), "clamped")
        for changed, gradient in zip(("raw", "weights"), gradients, strict=True):
            if not gradient.size:
                continue
            found, expected = [], []
            for _ in range(30):
                direction = rng.normal(size=gradient.shape)
                slope = difference(kernels64, p, changed, direction)
                if slope is not None:
                    expected.append(slope)
                    found.append(np.vdot(direction, gradient))
                if len(found) == 6:
                    break
            assert len(found) == 6
            assert_close(found, expected, 1e-7)


def difference(
    kernels: Kernels, p: Problem, changed: str, direction: Any, h: float = 1e-6
) -> float | None:
    """Central difference of order h^4 of the loss; None where near and far ones disagree: a unit of
    the MLP crosses 0, a weight the threshold, or a ray the end of its light."""
    loss = {}
    for k in (-2, -1, 1, 2):
        out = kernels.forward(replace(p, **{changed: getattr(p, changed) + k * h * direction}))
        loss[k] = float(
            (p.adj_rgb * out.rgb).sum()
            + (p.adj_opacity * out.opacity).sum()
            + (p.adj_depth * out.depth).sum()
        )
    near, far = loss[1] - loss[-1], loss[2] - loss[-2]
    if abs(2.0 * near - far) > 1e-6 * abs(far):
        return None
    return (8.0 * near - far) / (12.0 * h)
