"""Models that see the direction of view in packs of sixteen: float32 against float64, threads."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.kernels.test_render import early, masked
from tests.support.expected import assert_close
from tests.support.model_problems import (
    DEFERRED,
    DEFERRED_LARGE,
    DEFERRED_SMALL,
    FEATURES,
    FEATURES_LARGE,
    FEATURES_SMALL,
    SH,
    Stale,
    name_of,
    oracle_both,
    oracle_seen,
    oracle_train_both,
    problem_of,
    smooth_problems,
)
from tests.support.problems import Problem
from tests.support.unwritten import leave_sinks_unwritten
from warpnerf.model.interface import Model
from warpnerf.rendering.steps import Steps

MODELS = (
    SH[0],
    SH[3],
    DEFERRED_SMALL,
    DEFERRED,
    DEFERRED_LARGE,
    FEATURES_SMALL,
    FEATURES,
    FEATURES_LARGE,
)
each_model = pytest.mark.parametrize("model", MODELS, ids=name_of)
"""All of them clamped: a scaling is compiled for."""
one_of_each = pytest.mark.parametrize("model", [SH[3], DEFERRED, FEATURES], ids=name_of)
with_mlp = pytest.mark.parametrize("model", [DEFERRED, DEFERRED_SMALL, FEATURES], ids=name_of)


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_sinks_unwritten(monkeypatch)


def of(threads: int) -> Stale:
    return Stale("float32", "cpu", threads=threads, packed=True)


def assert_none_in_padding(model: Model, values: Any) -> None:
    assert not values[..., 1 + model.n_features :].any()


@pytest.mark.ci
@each_model
def test_training_launch_against_float64(model: Model) -> None:
    """In batches that are not full: 16 and 21 rays, of one worker; 37 of several."""
    for p in smooth_problems(model, 3, n_rays=37):
        expected = oracle_train_both(p, "clamped")
        for threads in (1, 2, 3):
            error, values, weights = of(threads).both_train(p, "clamped")
            assert_close(error, expected[0], 1e-5)
            assert_close(values, expected[1], 1e-5)
            assert_none_in_padding(model, values)
            if weights.size:
                assert_close(weights, expected[2], 1e-5)


@one_of_each
def test_forward_and_backward_against_float64(model: Model) -> None:
    for p in smooth_problems(model, 3, first=100, n_rays=21):
        theirs = oracle_seen(p)
        expected = oracle_both(p, "clamped")
        for threads in (1, 2):
            kernels = of(threads)
            ours = kernels.forward(p)
            assert np.array_equal(ours.n_samples, theirs.n_samples.numpy())
            assert_close(ours.rgb, theirs.rgb, 1e-5)
            assert_close(ours.opacity, theirs.opacity, 1e-5)
            assert_close(ours.depth, theirs.depth, 1e-5)
            values, weights = kernels.both_backward(p, "clamped")
            assert_close(values, expected[0], 1e-5)
            assert_none_in_padding(model, values)
            if weights.size:
                assert_close(weights, expected[1], 1e-5)


@one_of_each
@pytest.mark.parametrize("n_rays", [1, 3, 15, 16, 17, 32, 35])
def test_batches_of_any_size(model: Model, n_rays: int) -> None:
    (p,) = smooth_problems(model, 1, first=200, n_rays=n_rays)
    expected = oracle_train_both(p, "clamped")
    for threads in (1, 2):
        found = of(threads).both_train(p, "clamped")
        for ours, theirs in zip(found, expected, strict=True):
            if theirs.size:
                assert_close(ours, theirs, 1e-5)
    assert_close(of(1).forward(p).rgb, oracle_seen(p).rgb, 1e-5)


def long(model: Model, seed: int) -> Problem:
    """Rays of up to ten packs."""
    p = problem_of(model, seed, n_rays=35, steps=Steps(near=0.0, far=4.0, step=0.02))
    return masked(p, seed)


def test_long_rays_against_float64() -> None:
    """More samples at a time than an MLP takes through a layer together."""
    p = long(replace(FEATURES, threshold=0.0), 0)
    assert oracle_seen(p).n_samples.max() > 100
    expected = oracle_train_both(p, "clamped")
    for ours, theirs in zip(of(1).both_train(p, "clamped"), expected, strict=True):
        assert_close(ours, theirs, 1e-5)


@one_of_each
def test_capacity_changes_nothing(model: Model) -> None:
    """Packs of a batch in one slot, in some, and in more than they need.

    Packs that are kept go through an MLP per sample together, which adds its weights' gradient up
    in another order.
    """
    for seed in range(4):
        for p in (long(model, seed), early(long(model, seed))):
            in_one_slot = of(1).both_train(p, "clamped", capacity=0)
            for capacity in (2, 5, 17, 40, 200):
                kept = of(1).both_train(p, "clamped", capacity=capacity)
                for ours, theirs in zip(kept[:2], in_one_slot[:2], strict=True):
                    assert np.array_equal(ours, theirs)
                if kept[2].size:
                    assert_close(kept[2], in_one_slot[2], 1e-6)


@with_mlp
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_gradients_have_the_same_bits_each_time(model: Model, threads: int) -> None:
    p = long(model, 7)
    first, again = (of(threads).both_train(p, "clamped") for _ in range(2))
    for a, b in zip(first, again, strict=True):
        assert np.array_equal(a, b)
    for ours, alone in zip(first, of(1).both_train(p, "clamped"), strict=True):
        assert_close(ours, alone, 1e-5)


@pytest.mark.parametrize("model", [DEFERRED, FEATURES], ids=name_of)
def test_each_worker_has_a_gradient_of_its_own(model: Model) -> None:
    """Of its rays; a worker without rays has none."""
    kernels = of(3)
    for n_rays, most in ((1, 1), (40, 3)):
        p = problem_of(model, 3, n_rays=n_rays)
        gradient = kernels.no_gradient(p)
        kernels.add_backward(p, gradient, "clamped")
        rows = gradient.weights.numpy().any(axis=1)
        assert rows.sum() == most


def test_the_transposed_copy_is_made_in_each_launch() -> None:
    """Two launches of the same workers with other weights."""
    kernels = of(2)
    for first in (1, 50):
        (p,) = smooth_problems(DEFERRED, 1, first=first, n_rays=20)
        assert_close(kernels.both_train(p, "clamped")[1], oracle_train_both(p, "clamped")[1], 1e-5)


@one_of_each
def test_what_is_not_a_number_shows(model: Model) -> None:
    """Else a broken training would look like empty space."""
    p = problem_of(model, 2)
    for number in (0, 1, model.n_features):
        raw = p.raw.copy()
        raw[..., number] = np.nan
        out = of(1).forward(replace(p, raw=raw))
        seen = out.n_samples > 0
        assert seen.any() and np.isnan(out.rgb[seen]).any(axis=1).all()
