"""Trials say of the kernels what the tests' own driver says."""

from __future__ import annotations

import numpy as np
import pytest
from drive import Kernels, Problem, assert_close

from warpnerf.parallel import Workers
from warpnerf.trial import (
    BOX_MAX,
    BOX_MIN,
    DENSITY_SHIFT,
    Trial,
    TrialKernels,
    folded,
    make_trial,
    partly_free,
    stopping_early,
)

PATHS = [lambda trial: trial, stopping_early, partly_free, folded]


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
    )


@pytest.mark.parametrize("path", PATHS)
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
        gradient = kernels64.backward(problem(trial), scaling)
        assert_close(ours.gradient(trial, scaling), gradient, 1e-13)
        error, gradient = kernels64.train(problem(trial), scaling)
        assert_close(ours.train(trial, scaling)[0], error, 1e-14)
        assert_close(ours.train(trial, scaling)[1], gradient, 1e-13)


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
