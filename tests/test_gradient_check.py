"""Trials say of the kernels what the tests' own driver says."""

from __future__ import annotations

import numpy as np
import pytest
from drive import Kernels, Problem, assert_close

from warpnerf.evaluation.gradient_check import (
    BOX_MAX,
    BOX_MIN,
    DENSITY_SHIFT,
    Trial,
    TrialKernels,
    folded,
    make_trial,
    of_model,
    partly_free,
    stopping_early,
)
from warpnerf.model.models import Deferred, Features
from warpnerf.runtime.parallel import Workers

PATHS = {
    "plain": lambda trial: trial,
    "stopping early": stopping_early,
    "partly free": partly_free,
    "folded": folded,
    "deferred": lambda trial: of_model(trial, Deferred()),
    "features": lambda trial: of_model(trial, Features(width=16, hidden_layers=1)),
}


def problem(trial: Trial) -> Problem:
    return Problem(
        raw=trial.raw,
        box_min=BOX_MIN,
        box_max=BOX_MAX,
        origins=trial.origins,
        directions=trial.directions,
        background=trial.background,
        target=trial.target,
        adj_rgb=trial.rgb_slope,
        adj_opacity=trial.opacity_slope,
        adj_depth=trial.depth_slope,
        steps=trial.steps,
        offsets=trial.offsets,
        content_distance=trial.content_distance,
        contraction=trial.contraction,
        border=trial.border,
        density_shift=DENSITY_SHIFT,
        density_scale=trial.density_scale,
        free=trial.free,
        model=trial.model,
        weights=trial.weights,
    )


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=name, marks=pytest.mark.slow if name == "features" else ())
        for name, path in PATHS.items()
    ],
)
def test_trials_are_the_problems_of_the_tests(path, kernels64: Kernels, device: str) -> None:
    trial = path(make_trial(3))
    ours = TrialKernels("float64", Workers(device, 1))
    seen, expected = ours.see(trial), kernels64.forward(problem(trial))
    assert seen.n_samples.sum() > 100
    assert np.array_equal(seen.n_samples, expected.n_samples)
    assert_close(seen.rgb, expected.rgb, 1e-14)
    assert_close(seen.depth, expected.depth, 1e-14)
    assert_close(seen.opacity, expected.opacity, 1e-14)
    for scaling in ("none", "clamped"):
        found = ours.gradient(trial, scaling)
        error, trained = ours.train(trial, scaling)
        values, weights = kernels64.both_backward(problem(trial), scaling)
        expected_error, trained_values, trained_weights = kernels64.both_train(
            problem(trial), scaling
        )
        assert_close(error, expected_error, 1e-14)
        assert_close(found.values, values, 1e-13)
        assert_close(trained.values, trained_values, 1e-13)
        assert found.weights.shape == trained.weights.shape == trial.weights.shape
        if trial.weights.size:
            assert_close(found.weights, weights, 1e-13)
            assert_close(trained.weights, trained_weights, 1e-13)


def test_paths_leave_samples_out(device: str) -> None:
    kernels = TrialKernels("float64", Workers(device, 1))
    whole = kernels.see(make_trial(0)).n_samples.sum()
    assert kernels.see(stopping_early(make_trial(0))).n_samples.sum() < whole
    assert kernels.see(partly_free(make_trial(0))).n_samples.sum() < whole


def test_rounded_numbers_are_those_of_float32() -> None:
    trial = make_trial(0).rounded()
    assert trial.raw.dtype == np.float64
    assert np.array_equal(trial.raw.astype(np.float32), trial.raw)
    assert np.abs(trial.raw - make_trial(0).raw).max() > 0.0
