"""Gradient errors: by launches of a problem that ought to agree.

Each function gives the largest difference over the largest of what is expected, unless it says
otherwise; NaN where the two say nothing, so that no check passes for want of anything to compare.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warpnerf.config import Scaling
from warpnerf.rendering.steps import Steps
from warpnerf.verification.gradient_check import ProblemKernels
from warpnerf.verification.problems import BOX_MAX, BOX_MIN, Found, RayProblem, make_problem

SCALINGS: tuple[Scaling, ...] = ("quadratic", "clamped")


def relative_error(value: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference over the largest expected entry.

    NaN where either is not finite, or what is expected is next to zero: that would show nothing.
    """
    largest = float(np.abs(expected).max())
    if not largest > 1e-9:
        return math.nan
    return float(np.abs(value - expected).max()) / largest


def gradient_error(value: Found, expected: Found) -> float:
    """relative_error of each array, the largest."""
    pairs = ((value.arrays[name], array) for name, array in expected.arrays.items())
    return float(np.max([relative_error(*pair) for pair in pairs]))


def against_differences(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The gradient of the problem's loss, against differences of what rays see."""
    gradient = kernels.gradient(problem)
    return _differences(kernels, problem, gradient, lambda p: kernels.see(p).loss(problem))


def trained_against_differences(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The gradient of a training launch, against differences of the losses that it reports."""
    _, gradient = kernels.train(problem)
    return _differences(kernels, problem, gradient, lambda p: float(kernels.train(p)[0].mean()))


def bound_against_differences(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The gradient of a proposal's loss, against differences of that loss."""
    _, gradient = kernels.bound(problem)
    return _differences(kernels, problem, gradient, lambda p: float(kernels.bound(p)[0].sum()))


def _differences(
    kernels: ProblemKernels,
    problem: RayProblem,
    gradient: Found,
    loss: Callable[[RayProblem], float],
) -> float:
    """A gradient along random directions, against central differences of order h^4."""
    visited = kernels.see(problem).n_samples
    if problem.free.size > 1 or problem.steps.transmittance_min > 0.0:
        whole = replace(problem, free=np.zeros((1, 1, 1), np.uint8))
        whole = replace(whole, steps=replace(problem.steps, transmittance_min=0.0))
        if visited.sum() >= kernels.see(whole).n_samples.sum():
            return math.nan  # nothing was left out
    rng = np.random.default_rng(1)
    # A ReLU or a threshold crossed within h leaves no derivative; with many, h has to be small.
    h = 2e-6 if problem.weights.size else 2e-5
    errors = []
    for name, array in problem.learned.items():
        found, expected = [], []
        for _ in range(8):
            direction = rng.normal(size=array.shape)
            losses = {}
            smooth = True
            for k in (-2, -1, 1, 2):
                moved = problem.moved(name, k * h * direction)
                # Where a ray just reaches the end of its light, the loss jumps.
                smooth &= np.array_equal(kernels.see(moved).n_samples, visited)
                losses[k] = loss(moved)
            near, far = losses[1] - losses[-1], losses[2] - losses[-2]
            smooth &= abs(2.0 * near - far) <= 1e-6 * abs(far)
            if smooth:
                expected.append((8.0 * near - far) / (12.0 * h))
                found.append(np.vdot(direction, gradient.arrays[name]))
        enough = len(found) > 4
        errors.append(relative_error(np.array(found), np.array(expected)) if enough else math.nan)
    return float(np.max(errors))


def transposed(kernels: ProblemKernels) -> float:
    """The difference of the two products, over the sum of their terms."""
    rng = np.random.default_rng(0)
    size = (5, 6, 7)
    values, out = rng.normal(size=(*size, 4)), rng.normal(size=(200, 4))
    points = rng.uniform(-1.0, 1.0, size=(200, 3))
    points[0], points[1] = -1.0, 1.0
    problem = replace(make_problem(0), raw=values)
    forward = np.vdot(kernels.gather(values, points), out)
    backward = np.vdot(values, kernels.scatter(problem, points, out))
    scale = np.abs(kernels.gather(np.abs(values), points) * out).sum()
    return abs(forward - backward) / scale if abs(forward) > 1e-4 * scale else math.nan


def _one_sample(problem: RayProblem, t: float) -> RayProblem:
    """Rays from inside the box with a single sample each, around a distance t."""
    steps = Steps(near=t, far=t + 0.1, step=0.1)
    return replace(problem, origins=0.1 * problem.origins, steps=steps)


def scaled_by_hand(kernels: ProblemKernels, problem: RayProblem) -> float:
    """A ray with one sample: scaling its gradient is scaling what flows back along it."""
    errors = []
    for t in (0.05, 0.2, 0.4):
        one = _one_sample(problem, t)
        # on both sides of the clamp
        one = replace(one, content_distance=problem.content_distance * t / 1.5).rounded()
        if not (kernels.see(one).n_samples == 1).all():
            return math.nan
        for scaling in SCALINGS:
            scale = ((one.steps.near + one.offsets * one.steps.step) / one.content_distance) ** 2
            if scaling == "clamped":
                scale = np.minimum(1.0, scale)
            by_hand = replace(
                one,
                rgb_slope=scale[:, None] * one.rgb_slope,
                opacity_slope=scale * one.opacity_slope,
                depth_slope=scale * one.depth_slope,
            )
            errors.append(gradient_error(kernels.gradient(one, scaling), kernels.gradient(by_hand)))
    return float(np.max(errors))


def scaled_along_a_ray(kernels: ProblemKernels, problem: RayProblem) -> float:
    """Samples two voxels apart share no node, so each node has the scale of its one sample."""
    nodes = 24
    voxel = float(BOX_MAX[0] - BOX_MIN[0]) / (nodes - 1)
    start = np.array([BOX_MIN[0], 0.11, 0.07])
    steps = Steps(near=0.0, far=30.0, step=2.0 * voxel)
    along = replace(
        make_problem(0, n_rays=1, size=(nodes, 3, 3)),
        origins=start[None],
        directions=np.array([[1.0, 0.0, 0.0]]),
        offsets=np.array([0.2]),
        rgb_slope=problem.rgb_slope[:1],
        content_distance=problem.content_distance[:1],
        density_scale=0.3,
        steps=steps,
    )
    t = (np.arange(nodes) // 2 + along.offsets[0]) * steps.step  # of each node's sample
    scale = (t / along.content_distance[0]) ** 2
    errors = []
    for scaling in SCALINGS:
        by_hand = np.minimum(1.0, scale) if scaling == "clamped" else scale
        expected = by_hand[:, None, None, None] * kernels.gradient(along).values
        errors.append(relative_error(kernels.gradient(along, scaling).values, expected))
    return float(np.max(errors))


def beyond(kernels: ProblemKernels, problem: RayProblem) -> float:
    """Where every sample is at the content distance or beyond, clamping leaves 1."""
    beyond = replace(problem, steps=replace(problem.steps, near=0.5))
    beyond = replace(beyond, content_distance=np.full(problem.n_rays, 0.5))
    return gradient_error(kernels.gradient(beyond, "clamped"), kernels.gradient(beyond))


def at_camera(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The largest gradient of samples at the camera, where without scaling there is some."""
    one = replace(_one_sample(problem, 0.0), offsets=np.zeros(problem.n_rays))
    if not np.abs(kernels.gradient(one).values).max() > 1e-3:
        return math.nan
    found = [np.abs(kernels.gradient(one, scaling).values).max() for scaling in SCALINGS]
    return float(np.max(found))


def fused(kernels: ProblemKernels, problem: RayProblem) -> float:
    """Loss and gradient in one launch, against two launches and the loss by hand."""
    errors = []
    for scaling in ("none", "clamped"):
        error, gradient = kernels.train(problem, scaling)
        rgb = kernels.see(problem).rgb
        two = replace(
            problem,
            rgb_slope=2.0 / problem.n_rays * (rgb - problem.target),
            opacity_slope=np.zeros(problem.n_rays),
            depth_slope=np.zeros(problem.n_rays),
        )
        errors.append(gradient_error(gradient, kernels.gradient(two, scaling)))
        errors.append(relative_error(error, ((rgb - problem.target) ** 2).sum(axis=-1)))
    return float(np.max(errors))


def forms(a: ProblemKernels, b: ProblemKernels, problem: RayProblem) -> float:
    """What rays see, and all gradients."""
    found, expected = (kernels.gradient(problem.rounded()) for kernels in (a, b))
    return float(np.max([trained_forms(a, b, problem), gradient_error(found, expected)]))


def trained_forms(a: ProblemKernels, b: ProblemKernels, problem: RayProblem) -> float:
    """What rays see, and the gradient of a training launch."""
    problem = problem.rounded()
    ours, theirs = a.see(problem), b.see(problem)
    if not np.array_equal(ours.n_samples, theirs.n_samples):
        return math.nan
    errors = [
        relative_error(ours.rgb, theirs.rgb),
        relative_error(ours.opacity, theirs.opacity),
        relative_error(ours.depth, theirs.depth),
        gradient_error(a.train(problem, "clamped")[1], b.train(problem, "clamped")[1]),
    ]
    return float(np.max(errors))


def bound_forms(a: ProblemKernels, b: ProblemKernels, problem: RayProblem) -> float:
    """A proposal's loss of each ray, and its gradient."""
    (ours, found), (theirs, expected) = (kernels.bound(problem.rounded()) for kernels in (a, b))
    return float(np.max([relative_error(ours, theirs), gradient_error(found, expected)]))


def same_image(kernels: ProblemKernels, problem: RayProblem) -> float:
    """How many rays' errors change with the scaling, which must change the gradient."""
    error, gradient = kernels.train(problem)
    changed = 0
    for scaling in SCALINGS:
        scaled = kernels.train(problem, scaling)
        if np.array_equal(scaled[1].values, gradient.values):
            return math.nan
        changed += int((scaled[0] != error).sum())
    return changed


def threads(one: ProblemKernels, several: ProblemKernels, problem: RayProblem) -> float:
    """The gradient of a training launch on one thread and on several."""
    error, gradient = one.train(problem, "clamped")
    again = several.train(problem, "clamped")
    if not np.array_equal(again[0], error):  # no sum over rays
        return math.nan
    return gradient_error(again[1], gradient)
