"""Gradients and determinism, checked on the machine and device that the kernels are to run on.

Each check yields an error and says how large it may be. The adjoint is compared with differences of
the forward launch, in float64 and from the same source that trains in float32; the forms that train
are compared with float64; what is promised exactly has the tolerance 0, where the device keeps it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpnerf.config import GridConfig, LossConfig, TrainConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.storage_kinds import Hash, StorageKind, Vm
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.train import train
from warpnerf.verification import gradient_errors
from warpnerf.verification.gradient_check import ProblemKernels
from warpnerf.verification.problems import (
    RayProblem,
    contracted,
    in_frustum,
    make_problem,
    of_model,
    partly_free,
    stopping_early,
    stored_in,
    with_losses,
)

SEEDS = range(3)
N_RAYS = 40
"""Of a problem: on CUDA a full warp sums in another order than part of one, so some of both."""

BESIDES = "all but the frustum"

PATHS: dict[str, Callable[[RayProblem], RayProblem]] = {
    "plain": lambda problem: problem,
    "early stop": stopping_early,
    "free space": partly_free,
    "contracted space": contracted,
    "frustum": in_frustum,
    BESIDES: lambda problem: stopping_early(partly_free(contracted(problem))),
}

DEFERRED = Deferred(specular=4, width=32)
"""A small one: its kernels are those of larger ones, and compile sooner."""

VIEW_DEPENDENT: tuple[Model, ...] = (
    SphericalHarmonics(degree=3),
    DEFERRED,
    PerSample(threshold=1e-3),
    PerSample(residual=False, threshold=0.0),
)
"""The models besides rgb, which the checks above are made with."""

STORED: tuple[StorageKind, ...] = (
    Vm(),
    Hash(levels=4, coarsest=3, finest=40, table=64),
    Hash(levels=4, coarsest=3, finest=40, table=64, hidden=16),
)
"""The storages besides dense grids; one level of a hash has an entry for each node."""

BOUND = "bound of resampled steps"


def field_words(kind: StorageKind) -> str:
    """A storage, as names of checks have it."""
    hidden = isinstance(kind, Hash) and kind.hidden > 0
    return f"field {kind.name}{' with a hidden layer' if hidden else ''}"


TRAINING = TrainConfig(
    steps=240,
    rays_per_step=256,
    occupancy_every=20,
    background="random",
    model=Rgb(),
    loss=LossConfig(),
    grid=GridConfig(voxels=6000, grow_at=(0.5,)),
)
"""Short, growing the grid once."""

TRAININGS: dict[str, TrainConfig] = {
    "training": replace(TRAINING, model=DEFERRED),
    **{f"training with {field_words(kind)}": replace(TRAINING, field=kind) for kind in STORED},
    "training with resampled steps": replace(
        TRAINING, sampler=Resampled(samples=16, bins=32, voxels=1000)
    ),
}
"""Each twice; where a pair shares kernels with a check above, these are compiled already."""

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
    """Name, tolerance and measurement of each check that suits the device."""
    on_cpu = not workers.device.is_cuda
    exact = ProblemKernels("float64", workers)
    plain = ProblemKernels("float32", workers)
    packed = ProblemKernels("float32", workers, packed=True)
    trained = packed if on_cpu else plain

    def same_sum(rounding: float) -> float:
        """What two sums of the same may differ by: CUDA sums in no fixed order."""
        return 0.0 if on_cpu else rounding

    every = PATHS["plain"]
    for name, path in PATHS.items():
        measure = partial(_worst, gradient_errors.against_differences, path, exact)
        yield f"float64 adjoint = central differences, {name}", 1e-7, measure
    for model in VIEW_DEPENDENT:
        path = partial(_with_model, model)
        measure = partial(_worst, gradient_errors.against_differences, path, exact)
        yield f"float64 adjoint = central differences, {_words(model)}", 1e-7, measure
    measure = partial(_worst, gradient_errors.trained_against_differences, with_losses, exact)
    yield "float64 adjoint = central differences, losses of rays", 1e-7, measure
    for kind in STORED:
        measure = partial(
            _worst, gradient_errors.against_differences, partial(_with_storage, kind), exact
        )
        yield f"float64 adjoint = central differences, {field_words(kind)}", 1e-7, measure
    measure = partial(_worst, gradient_errors.bound_against_differences, partly_free, exact)
    yield f"float64 adjoint = central differences, {BOUND}", 1e-7, measure
    for name, kernels, tolerance in (("float64", exact, 1e-15), ("float32", plain, 1e-6)):
        measure = partial(gradient_errors.transposed, kernels)
        yield f"{name} <gather x, y> = <x, adjoint of gather y>", tolerance, measure
    for name, kernels, tolerance, untouched in (
        ("float64", exact, 1e-13, same_sum(1e-13)),
        ("float32 as trained", trained, 1e-5, same_sum(1e-5)),
    ):
        yield (
            f"{name}, scaled gradient = s(t) times the gradient",
            tolerance,
            partial(_worst, gradient_errors.scaled_by_hand, every, kernels),
        )
        yield (
            f"{name}, each sample of a ray scaled by its own s(t)",
            tolerance,
            partial(_worst, gradient_errors.scaled_along_a_ray, every, kernels),
        )
        yield (
            f"{name}, beyond the content distance untouched",
            untouched,
            partial(_worst, gradient_errors.beyond, every, kernels),
        )
        yield (
            f"{name}, no gradient at t = 0",
            0.0,
            partial(_worst, gradient_errors.at_camera, every, kernels),
        )
        yield (
            f"{name}, training launch = forward, then backward",
            tolerance,
            partial(_worst, gradient_errors.fused, stopping_early, kernels),
        )
    pairs = [("float32 to float64", plain, exact)]
    if on_cpu:
        pairs += [
            ("float32 in packs of sixteen to float64", packed, exact),
            ("float32 in packs of sixteen to one by one", packed, plain),
        ]
    for name, kernels, other in pairs:
        # Steps that grow to several units amplify rounding, to 4e-5 as measured.
        for path_name, tolerance in (
            ("plain", 1e-5),
            ("frustum", 1e-5),
            (BESIDES, 1e-4),
        ):
            measure = partial(_worst, gradient_errors.forms, PATHS[path_name], kernels, other)
            yield f"{name}, {path_name}", tolerance, measure
        measure = partial(_worst, gradient_errors.forms, _with_all_losses, kernels, other)
        yield f"{name}, losses", 1e-5, measure
        for model in VIEW_DEPENDENT:
            measure = partial(
                _worst, gradient_errors.forms, partial(_with_model, model), kernels, other
            )
            yield f"{name}, {_words(model)}", 1e-4, measure
        for kind in STORED:
            path = partial(_with_storage, kind)
            measure = partial(_worst, gradient_errors.trained_forms, path, kernels, other)
            # Fine levels of a hash amplify the rounding of positions, to 7e-6 as measured.
            yield f"{name}, {field_words(kind)}", 5e-5, measure
        measure = partial(_worst, gradient_errors.bound_forms, partly_free, kernels, other)
        yield f"{name}, {BOUND}", 1e-5, measure
    yield (
        "image has the same bits for every scaling",
        0.0,
        partial(_worst, gradient_errors.same_image, every, trained),
    )
    if on_cpu:
        several = max(2, workers.count)
        one, more = (
            ProblemKernels("float32", Workers("cpu", n), packed=True) for n in (1, several)
        )
        measure = partial(_worst, gradient_errors.threads, every, one, more)
        yield f"float32, 1 thread = {several} threads within rounding", 1e-5, measure
        for kind in STORED:
            path = partial(_with_storage, kind)
            measure = partial(_worst, gradient_errors.threads, path, one, more)
            name = f"float32, 1 thread = {several} threads within rounding, {field_words(kind)}"
            yield name, 1e-5, measure
        for name, config in TRAININGS.items():
            measure = partial(_trained_twice, replace(config, threads=workers.count))
            yield f"{name} twice from one seed gives the same bits", 0.0, measure


def _with_all_losses(problem: RayProblem) -> RayProblem:
    return with_losses(problem, sample_colour=0.4)


def _words(model: Model) -> str:
    direct = isinstance(model, PerSample) and not model.residual
    return f"{model.name}, {'direct, ' if direct else ''}{BESIDES}"


def _with_storage(kind: StorageKind, problem: RayProblem) -> RayProblem:
    return stored_in(stopping_early(partly_free(problem)), kind)


def _with_model(model: Model, problem: RayProblem) -> RayProblem:
    return of_model(PATHS[BESIDES](problem), model)


def _worst(
    measure: Callable[..., float],
    path: Callable[[RayProblem], RayProblem],
    *kernels: ProblemKernels,
) -> float:
    """The largest error of measure(*kernels, problem) over the seeds; NaN if any is."""
    return float(np.max([measure(*kernels, path(make_problem(seed, N_RAYS))) for seed in SEEDS]))


def _trained_twice(config: TrainConfig) -> float:
    """How many of the numbers that are learned differ between two trainings."""
    scene = _noise()

    def values(seed: int) -> np.ndarray:
        field = train(scene, replace(config, seed=seed), progress=False).field
        arrays = [*field.storage.tensors().values(), field.weights.numpy()]
        if field.proposal is not None:
            arrays.append(field.proposal.grid.values.numpy())
        return np.concatenate([a.ravel() for a in arrays])

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
