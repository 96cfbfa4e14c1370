"""Gradients and determinism, checked on the machine and device that the kernels are to run on.

Each check yields an error and says how large it may be. The adjoint is held against differences of
the forward launch, in float64 and from the same source that trains in float32; the forms that train
are held against float64; what is promised exactly has the tolerance 0, where the device keeps it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpnerf.config import GridConfig, Scaling, TrainConfig
from warpnerf.evaluation.gradient_check import (
    BOX_MAX,
    BOX_MIN,
    Found,
    ProblemKernels,
    RayProblem,
    folded,
    make_problem,
    of_model,
    partly_free,
    stopping_early,
)
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, Features, SphericalHarmonics
from warpnerf.rendering.render import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.train import train

SEEDS = range(3)
SCALINGS: tuple[Scaling, ...] = ("quadratic", "clamped")

PATHS: dict[str, Callable[[RayProblem], RayProblem]] = {
    "plain": lambda problem: problem,
    "early stop": stopping_early,
    "free space": partly_free,
    "folded space": folded,
    "all of these": lambda problem: stopping_early(partly_free(folded(problem))),
}

VIEW_DEPENDENT: tuple[Model, ...] = (
    SphericalHarmonics(degree=3),
    Deferred(),
    Features(threshold=1e-3),
    Features(residual=False, threshold=0.0),
)
"""The models besides rgb, which the checks above are made with."""

Measure = Callable[[], float]


@dataclass(frozen=True, kw_only=True)
class Result:
    """One check's outcome."""

    name: str
    """What was checked."""
    error: float
    """How far apart the two sides are; not finite where a side is missing or says nothing."""
    tolerance: float
    """How far apart they may be."""
    note: str = ""
    """What went wrong, where the check could not be carried out."""

    @property
    def passed(self) -> bool:
        """Whether the error is within tolerance; NaN is not."""
        return self.error <= self.tolerance


def verify(
    device: str = "cpu",
    threads: int | None = None,
    on_check: Callable[[str], None] = lambda name: None,
    on_result: Callable[[Result], None] = lambda result: None,
) -> list[Result]:
    """Run all checks.

    Args:
        device: Where: cpu, cuda, cuda:1, ...
        threads: CPU threads; None: one per usable core.
        on_check: Called with each check's name before it runs.
        on_result: Called with each result.

    Returns:
        The results, in order.

    Raises:
        InputError: The device does not exist.
    """
    results = []
    for name, tolerance, measure in _checks(Workers(device, threads)):
        on_check(name)
        error, note = math.nan, ""
        try:
            error = float(measure())
        except Exception as raised:  # whatever it is: kernels that do not compile fail the check
            note = f"{type(raised).__name__}: {raised}".partition("\n")[0]
        results.append(Result(name=name, error=error, tolerance=tolerance, note=note))
        on_result(results[-1])
    return results


def report(results: list[Result], device: str, seconds: float) -> str:
    """The results as JSON; an error that is not finite is null."""
    checks = [
        {
            "name": result.name,
            "error": result.error if math.isfinite(result.error) else None,
            "tolerance": result.tolerance,
            "passed": result.passed,
            **({"note": result.note} if result.note else {}),
        }
        for result in results
    ]
    content = {
        "passed": all(result.passed for result in results),
        "device": device,
        "seconds": round(seconds, 2),
        "checks": checks,
    }
    return json.dumps(content, indent=2) + "\n"


def _checks(workers: Workers) -> Iterator[tuple[str, float, Measure]]:
    """Name, tolerance and measurement of each check that the device can be asked for."""
    on_cpu = not workers.device.is_cuda
    exact = ProblemKernels("float64", workers)
    plain = ProblemKernels("float32", workers)
    packed = ProblemKernels("float32", workers, packed=True)
    trained = packed if on_cpu else plain

    def same_sum(rounding: float) -> float:
        """What two sums of the same may differ by: CUDA adds up in no fixed order."""
        return 0.0 if on_cpu else rounding

    every = PATHS["plain"]
    for name, path in PATHS.items():
        measure = partial(_worst, _against_differences, path, exact)
        yield f"float64 adjoint = central differences, {name}", 1e-7, measure
    for model in VIEW_DEPENDENT:
        path = partial(_with_model, model)
        measure = partial(_worst, _against_differences, path, exact)
        yield f"float64 adjoint = central differences, {_words(model)}", 1e-7, measure
    for name, kernels, tolerance in (("float64", exact, 1e-15), ("float32", plain, 1e-6)):
        measure = partial(_transposed, kernels)
        yield f"{name} <gather x, y> = <x, adjoint of gather y>", tolerance, measure
    for name, kernels, tolerance, untouched in (
        ("float64", exact, 1e-13, same_sum(1e-13)),
        ("float32 as trained", trained, 1e-5, same_sum(1e-5)),
    ):
        yield (
            f"{name}, scaled gradient = s(t) times the gradient",
            tolerance,
            partial(_worst, _scaled_by_hand, every, kernels),
        )
        yield (
            f"{name}, each sample of a ray scaled by its own s(t)",
            tolerance,
            partial(_worst, _scaled_along_a_ray, every, kernels),
        )
        yield (
            f"{name}, beyond the content distance untouched",
            untouched,
            partial(_worst, _beyond, every, kernels),
        )
        yield f"{name}, no gradient at t = 0", 0.0, partial(_worst, _at_camera, every, kernels)
        yield (
            f"{name}, training launch = forward, then backward",
            tolerance,
            partial(_worst, _fused, stopping_early, kernels),
        )
    pairs = [("float32 to float64", plain, exact)]
    if on_cpu:
        pairs += [
            ("float32 in packs of sixteen to float64", packed, exact),
            ("float32 in packs of sixteen to one by one", packed, plain),
        ]
    for name, kernels, other in pairs:
        # Steps that grow to several units amplify rounding, to 4e-5 as measured.
        for path_name, tolerance in (("plain", 1e-5), ("all of these", 1e-4)):
            measure = partial(_worst, _forms, PATHS[path_name], kernels, other)
            yield f"{name}, {path_name}", tolerance, measure
        for model in VIEW_DEPENDENT:
            measure = partial(_worst, _forms, partial(_with_model, model), kernels, other)
            yield f"{name}, {_words(model)}", 1e-4, measure
    yield (
        "image has the same bits for every scaling",
        0.0,
        partial(_worst, _same_image, every, trained),
    )
    if on_cpu:
        several = max(2, workers.count)
        one, more = (
            ProblemKernels("float32", Workers("cpu", n), packed=True) for n in (1, several)
        )
        measure = partial(_worst, _threads, every, one, more)
        yield f"float32, 1 thread = {several} threads within rounding", 1e-5, measure
        yield (
            "training twice from one seed gives the same bits",
            0.0,
            partial(_trained_twice, workers.count),
        )


def _words(model: Model) -> str:
    direct = isinstance(model, Features) and not model.residual
    return f"{model.name}, {'direct' if direct else 'all of these'}"


def _with_model(model: Model, problem: RayProblem) -> RayProblem:
    return of_model(PATHS["all of these"](problem), model)


def _worst(
    measure: Callable[..., float],
    path: Callable[[RayProblem], RayProblem],
    *kernels: ProblemKernels,
) -> float:
    """The largest error of measure(*kernels, problem) over the seeds; NaN if any is."""
    return float(np.max([measure(*kernels, path(make_problem(seed))) for seed in SEEDS]))


def relative_error(value: np.ndarray, expected: np.ndarray) -> float:
    """Largest difference over the largest expected entry.

    NaN where either is not finite, or what is expected is next to zero: that would show nothing.
    """
    largest = float(np.abs(expected).max())
    if not largest > 1e-9:
        return math.nan
    return float(np.abs(value - expected).max()) / largest


def gradient_error(value: Found, expected: Found) -> float:
    """relative_error of what a model's grid gets, or that of its weights if it is larger."""
    errors = [relative_error(value.values, expected.values)]
    if expected.weights.size:
        errors.append(relative_error(value.weights, expected.weights))
    return float(np.max(errors))


def _against_differences(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The gradient along random directions, against central differences of order h^4."""
    gradient = kernels.gradient(problem)
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
    for of_weights in (False, True) if problem.weights.size else (False,):
        found, expected = [], []
        for _ in range(8):
            direction = rng.normal(size=problem.weights.shape if of_weights else problem.raw.shape)
            losses = {}
            smooth = True
            for k in (-2, -1, 1, 2):
                if of_weights:
                    moved = replace(problem, weights=problem.weights + k * h * direction)
                else:
                    moved = replace(problem, raw=problem.raw + k * h * direction)
                seen = kernels.see(moved)
                # Where a ray just reaches the end of its light, the loss jumps.
                smooth &= np.array_equal(seen.n_samples, visited)
                losses[k] = seen.loss(problem)
            near, far = losses[1] - losses[-1], losses[2] - losses[-2]
            smooth &= abs(2.0 * near - far) <= 1e-6 * abs(far)
            if smooth:
                expected.append((8.0 * near - far) / (12.0 * h))
                change = gradient.weights if of_weights else gradient.values
                found.append(np.vdot(direction, change))
        enough = len(found) > 4
        errors.append(relative_error(np.array(found), np.array(expected)) if enough else math.nan)
    return float(np.max(errors))


def _transposed(kernels: ProblemKernels) -> float:
    """The difference of the two products, over the sum of what is added up in them."""
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


def _scaled_by_hand(kernels: ProblemKernels, problem: RayProblem) -> float:
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


def _scaled_along_a_ray(kernels: ProblemKernels, problem: RayProblem) -> float:
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


def _beyond(kernels: ProblemKernels, problem: RayProblem) -> float:
    """Where every sample is at the content distance or beyond, clamping leaves 1."""
    beyond = replace(problem, steps=replace(problem.steps, near=0.5))
    beyond = replace(beyond, content_distance=np.full(problem.n_rays, 0.5))
    return gradient_error(kernels.gradient(beyond, "clamped"), kernels.gradient(beyond))


def _at_camera(kernels: ProblemKernels, problem: RayProblem) -> float:
    """The largest gradient of samples at the camera, where without scaling there is some."""
    one = replace(_one_sample(problem, 0.0), offsets=np.zeros(problem.n_rays))
    if not np.abs(kernels.gradient(one).values).max() > 1e-3:
        return math.nan
    found = [np.abs(kernels.gradient(one, scaling).values).max() for scaling in SCALINGS]
    return float(np.max(found))


def _fused(kernels: ProblemKernels, problem: RayProblem) -> float:
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


def _forms(a: ProblemKernels, b: ProblemKernels, problem: RayProblem) -> float:
    """What rays see, and all gradients."""
    problem = problem.rounded()
    ours, theirs = a.see(problem), b.see(problem)
    if not np.array_equal(ours.n_samples, theirs.n_samples):
        return math.nan
    errors = [
        relative_error(ours.rgb, theirs.rgb),
        relative_error(ours.opacity, theirs.opacity),
        relative_error(ours.depth, theirs.depth),
        gradient_error(a.gradient(problem), b.gradient(problem)),
        gradient_error(a.train(problem, "clamped")[1], b.train(problem, "clamped")[1]),
    ]
    return float(np.max(errors))


def _same_image(kernels: ProblemKernels, problem: RayProblem) -> float:
    """How many rays' errors change with the scaling, which must change the gradient."""
    error, gradient = kernels.train(problem)
    changed = 0
    for scaling in SCALINGS:
        scaled = kernels.train(problem, scaling)
        if np.array_equal(scaled[1].values, gradient.values):
            return math.nan
        changed += int((scaled[0] != error).sum())
    return changed


def _threads(one: ProblemKernels, several: ProblemKernels, problem: RayProblem) -> float:
    """The gradient of a training launch on one thread and on several."""
    error, gradient = one.train(problem, "clamped")
    again = several.train(problem, "clamped")
    if not np.array_equal(again[0], error):  # no sum over rays
        return math.nan
    return gradient_error(again[1], gradient)


def _trained_twice(threads: int) -> float:
    """Values and weights that differ between two short trainings, which grow the grid once."""
    scene = _noise()

    def values(seed: int) -> np.ndarray:
        config = TrainConfig(
            steps=240,
            rays_per_step=256,
            occupancy_every=20,
            background="random",
            seed=seed,
            threads=threads,
            grid=GridConfig(voxels=6000, grow_at=(0.5,)),
        )
        field = train(scene, config).field
        return np.concatenate([a.numpy().ravel() for a in (field.grid.values, field.weights)])

    first = values(0)
    if np.array_equal(first, values(1)) or not np.isfinite(first).all():
        return math.nan  # nothing that the seed decides
    return float((values(0) != first).sum())


def _noise() -> Scene:
    """Noise, photographed from four sides."""
    rng = np.random.default_rng(0)
    views = []
    for number in range(4):
        c, s = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[number]
        c2w = np.array([[c, 0.0, s, 2.5 * s], [0.0, 1.0, 0.0, 0.1], [-s, 0.0, c, 2.5 * c]])
        camera = Camera(width=24, height=18, fx=22.0, fy=22.0, cx=12.0, cy=9.0, c2w=c2w)
        image = rng.integers(0, 256, size=(18, 24, 4), dtype=np.uint8)
        views.append(View(name=f"{number}", camera=camera, image=image))
    return Scene(
        name="noise",
        views=views,
        splits={"train": (0, 1, 2, 3)},
        box_min=np.array([-1.0, -0.8, -0.9]),
        box_max=np.array([1.0, 0.9, 1.1]),
        unbounded=False,
        content_distance=2.0,
    )
