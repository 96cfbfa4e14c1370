"""Problems say of the kernels what the tests' own driver says."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.problems import Problem
from tests.support.small_model import SMALL
from warpnerf.model.models import PerSample
from warpnerf.runtime.parallel import Workers
from warpnerf.verification.gradient_check import ProblemKernels
from warpnerf.verification.gradient_errors import bound_forms
from warpnerf.verification.problems import (
    DENSITY_SHIFT,
    RayProblem,
    contracted,
    in_frustum,
    make_problem,
    of_model,
    partly_free,
    stopping_early,
    with_losses,
)

PATHS = {
    "plain": lambda problem: problem,
    "stopping early": stopping_early,
    "partly free": partly_free,
    "contracted": contracted,
    "frustum": in_frustum,
    "losses": lambda problem: with_losses(problem, sample_colour=0.4),
    "deferred": lambda problem: of_model(problem, SMALL),
    "features": lambda problem: of_model(problem, PerSample(width=16, hidden_layers=1)),
}


def for_driver(problem: RayProblem) -> Problem:
    return Problem(
        raw=problem.raw,
        box_min=problem.box_min,
        box_max=problem.box_max,
        origins=problem.origins,
        directions=problem.directions,
        background=problem.background,
        target=problem.target,
        adj_rgb=problem.rgb_slope,
        adj_opacity=problem.opacity_slope,
        adj_depth=problem.depth_slope,
        steps=problem.steps,
        offsets=problem.offsets,
        content_distance=problem.content_distance,
        contraction=problem.contraction,
        border=problem.border,
        frustum=problem.frustum,
        objective=problem.objective,
        density_shift=DENSITY_SHIFT,
        density_scale=problem.density_scale,
        free=problem.free,
        model=problem.model,
        weights=problem.weights,
    )


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=name, marks=pytest.mark.slow if name == "features" else ())
        for name, path in PATHS.items()
    ],
)
def test_problems_are_those_of_the_tests(path, kernels64: Kernels, device: str) -> None:
    problem = path(make_problem(3))
    ours = ProblemKernels("float64", Workers(device, 1))
    seen, expected = ours.see(problem), kernels64.forward(for_driver(problem))
    assert seen.n_samples.sum() > 100
    assert np.array_equal(seen.n_samples, expected.n_samples)
    assert_close(seen.rgb, expected.rgb, 1e-14)
    assert_close(seen.depth, expected.depth, 1e-14)
    assert_close(seen.opacity, expected.opacity, 1e-14)
    found = ours.gradient(problem, "clamped")
    error, trained = ours.train(problem, "clamped")
    values, weights = kernels64.both_backward(for_driver(problem), "clamped")
    expected_error, trained_values, trained_weights = kernels64.both_train(
        for_driver(problem), "clamped"
    )
    assert_close(error, expected_error, 1e-14)
    assert_close(found.values, values, 1e-13)
    assert_close(trained.values, trained_values, 1e-13)
    if problem.weights.size:
        assert_close(found.arrays["weights"], weights, 1e-13)
        assert_close(trained.arrays["weights"], trained_weights, 1e-13)


def test_paths_leave_samples_out(device: str) -> None:
    kernels = ProblemKernels("float64", Workers(device, 1))
    whole = kernels.see(make_problem(0)).n_samples.sum()
    assert kernels.see(stopping_early(make_problem(0))).n_samples.sum() < whole
    assert kernels.see(partly_free(make_problem(0))).n_samples.sum() < whole


def test_rounded_numbers_are_those_of_float32() -> None:
    problem = make_problem(0).rounded()
    assert problem.raw.dtype == np.float64
    assert np.array_equal(problem.raw.astype(np.float32), problem.raw)
    assert np.abs(problem.raw - make_problem(0).raw).max() > 0.0
    frustum, before = in_frustum(make_problem(0)).rounded().frustum, in_frustum(make_problem(0))
    assert frustum is not None and before.frustum is not None
    for ours, exact in (
        (frustum.axes, before.frustum.axes),
        (frustum.origin, before.frustum.origin),
    ):
        assert np.array_equal(ours.astype(np.float32), ours) and np.abs(ours - exact).max() > 0.0


def test_the_proposal_s_gradient_in_packs(on_cpu: None) -> None:
    workers = Workers("cpu", 2)
    exact, packs = ProblemKernels("float64", workers), ProblemKernels("float32", workers, True)
    for seed in range(3):
        assert bound_forms(packs, exact, partly_free(make_problem(seed))) < 1e-5
