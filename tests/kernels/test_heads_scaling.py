"""What the distance scaling promises, for models whose colour depends on the view."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.model_problems import (
    DEFERRED,
    FEATURES,
    SH,
    Stale,
    name_of,
    oracle_both,
    oracle_train_both,
    problem_of,
)
from tests.support.problems import Float64, Problem
from warpnerf.model.interface import Model
from warpnerf.rendering.steps import Steps

each_model = pytest.mark.parametrize("model", [SH[3], DEFERRED, FEATURES], ids=name_of)
each_form = pytest.mark.parametrize("form", ["float64", "packed"])


def kernels_of(form: str, device: str) -> Kernels:
    if form == "float64":
        return Kernels("float64", device)
    if device != "cpu":
        pytest.skip("packs of samples are the CPU's form of the kernels")
    return Stale("float32", device, packed=True)


def same(values: Any, expected: Any, device: str) -> bool:
    """The same bits; CUDA sums in no fixed order."""
    if device != "cpu":
        return np.allclose(values, expected, rtol=1e-5, atol=1e-5 * np.abs(expected).max(initial=0))
    return np.array_equal(values, expected)


def near_and_far(model: Model, seed: int) -> Problem:
    """Samples on both sides of the content distance."""
    return replace(problem_of(model, seed, n_rays=20), content_distance=np.array([1.2]))


@each_model
def test_errors_are_the_same_bits_for_every_scaling(model: Model, packed: Kernels) -> None:
    """Of the launch that trains; images have a kernel without scaling."""
    p = near_and_far(model, 1)
    plain, scaled = (packed.both_train(p, scaling) for scaling in ("none", "clamped"))
    assert np.array_equal(plain[0], scaled[0])
    assert not np.array_equal(plain[1], scaled[1])
    assert_close(plain[1], oracle_train_both(p)[1], 1e-5)


@each_form
def test_weights_of_a_head_of_rays_get_the_whole_gradient(form: str, device: str) -> None:
    """They belong to no sample: the scaling is that of what the ray has accumulated."""
    kernels = kernels_of(form, device)
    for seed in range(3):
        p = near_and_far(DEFERRED, seed)
        beyond = replace(p, content_distance=np.array([1e-30]))
        scaled, plain = (kernels.both_backward(q, "clamped") for q in (p, beyond))
        assert np.abs(plain[1]).max() > 1e-3
        assert same(scaled[1], plain[1], device)
        assert np.abs(scaled[0] - plain[0]).max() > 0.02 * np.abs(plain[0]).max()


def test_weights_of_a_head_of_samples_get_what_passes_scaled_samples(kernels64: Kernels) -> None:
    """The weights' gradient is a sum over samples, each times its own factor."""
    for seed in range(3):
        p = near_and_far(FEATURES, seed)
        plain, expected = oracle_both(p)[1], oracle_both(p, "clamped")[1]
        assert np.abs(plain - expected).max() > 0.02 * np.abs(plain).max()
        assert_close(kernels64.both_backward(p, "clamped")[1], expected, 1e-9)


@each_form
def test_one_factor_for_all_samples_is_a_factor_on_the_gradient(form: str, device: str) -> None:
    """Rays of one sample each, at t = D / 2: a quarter of all that passes it."""
    kernels = kernels_of(form, device)
    p = at_one_distance(problem_of(FEATURES, 5), near=0.4)
    t = p.steps.near + 0.5 * p.steps.step
    found = kernels.both_backward(replace(p, content_distance=np.array([2.0 * t])), "clamped")
    whole = kernels.both_backward(replace(p, content_distance=np.array([t / 2.0])), "clamped")
    tolerance = 1e-12 if form == "float64" else 1e-6
    for quarter, full in zip(found, whole, strict=True):
        assert_close(quarter, 0.25 * full, tolerance)


def at_one_distance(p: Problem, near: float) -> Problem:
    """Rays from inside the box with a single sample each, in a dense medium."""
    return replace(
        p,
        origins=0.1 * p.origins,
        offsets=np.array([0.5]),
        density_scale=5.0,
        steps=Steps(near=near, far=near + 0.1, step=0.1),
    )


@each_model
@each_form
def test_beyond_the_content_distance_gradients_are_untouched(
    model: Model, form: str, device: str
) -> None:
    kernels = kernels_of(form, device)
    for seed in range(3):
        p = problem_of(model, seed)
        p = replace(p, steps=replace(p.steps, near=0.5))
        at, beyond = (
            kernels.both_backward(replace(p, content_distance=np.array([d])), "clamped")
            for d in (0.5, 1e-3)
        )
        assert np.abs(at[0]).max() > 1e-3
        for a, b in zip(at, beyond, strict=True):
            assert same(a, b, device)


@each_model
@each_form
def test_no_gradient_at_the_camera(model: Model, form: str, device: str) -> None:
    """Samples at t = 0. The weights of a head of rays get theirs all the same."""
    kernels = kernels_of(form, device)
    p = at_one_distance(problem_of(model, 6), near=0.0)
    p = replace(p, offsets=np.array([0.0]))
    assert (kernels.forward(p).n_samples == 1).all()
    values, weights = kernels.both_backward(p, "clamped")
    assert not values.any()
    assert weights.any() == (model == DEFERRED)
    expected: tuple[Float64, Float64] = oracle_both(p)
    assert np.abs(expected[0]).max() > 1e-3
