"""The render kernels: values, adjoint and scaling, against autograd, differences and themselves."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from tests.support.expected import (
    assert_close,
    directional_differences,
    oracle,
    oracle_gradient,
    oracle_train,
)
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS, Problem, in_frustum, make_problem, unbounded, unit
from warpnerf.rendering.steps import Steps

Path = Callable[[int], Problem]


def rng_of(seed: int) -> np.random.Generator:
    return np.random.default_rng(1000 + seed)


def coloured(*rgb: float) -> Path:
    return lambda seed: make_problem(seed, background=np.array([rgb]))


def masked(p: Problem, seed: int) -> Problem:
    """Half of 3 x 4 x 5 cells are free, next to an occupied one."""
    occupied = rng_of(seed).uniform(size=(3, 4, 5)) < 0.5
    return replace(p, free=np.where(occupied, 0, 1).astype(np.uint8))


def early(p: Problem) -> Problem:
    return replace(p, density_scale=2.5, steps=replace(p.steps, transmittance_min=0.2))


def clipped(p: Problem) -> Problem:
    """Near and far plane, in scene units, on the way through the box."""
    return replace(p, steps=replace(p.steps, near=0.9, far=2.3))


def jittered(p: Problem, seed: int) -> Problem:
    return replace(p, offsets=rng_of(seed).uniform(size=p.n_rays))


def axis_parallel(seed: int) -> Problem:
    p = make_problem(seed)
    axes = (
        np.eye(3)[np.arange(p.n_rays) % 3] * np.where(np.arange(p.n_rays) % 2, 1.0, -1.0)[:, None]
    )
    origins = 0.6 * rng_of(seed).uniform(-1.0, 1.0, size=(p.n_rays, 3))
    return replace(
        p, origins=origins - 1.3 * axes * (np.arange(p.n_rays) < 6)[:, None], directions=axes
    )


PATHS: dict[str, Path] = {
    "random background": make_problem,
    "white": coloured(1.0, 1.0, 1.0),
    "black": coloured(0.0, 0.0, 0.0),
    "colour": coloured(0.2, 0.7, 0.4),
    "axis parallel": axis_parallel,
    "density scale": lambda seed: make_problem(seed, density_scale=3.0, density_shift=-1.0),
    "jitter": lambda seed: jittered(make_problem(seed), seed),
    "far inside the box": lambda seed: make_problem(
        seed, steps=Steps(near=0.4, far=1.3, step=0.08)
    ),
    "many steps": lambda seed: make_problem(seed, steps=Steps(near=0.0, far=4.0, step=0.02)),
    "mask": lambda seed: masked(make_problem(seed), seed),
    "early stop": lambda seed: early(make_problem(seed)),
    "linf": lambda seed: unbounded(make_problem(seed), "linf", 0.2),
    "l2": lambda seed: unbounded(make_problem(seed), "l2", 1.0),
    "ndc": lambda seed: in_frustum(make_problem(seed), seed),
    "ndc, clipped": lambda seed: clipped(in_frustum(make_problem(seed), seed)),
    "all, ndc": lambda seed: early(
        jittered(masked(in_frustum(make_problem(seed), seed), seed), seed)
    ),
    "all, linf": lambda seed: early(
        jittered(masked(unbounded(make_problem(seed), "linf", 0.5), seed), seed)
    ),
    "all, l2": lambda seed: early(
        jittered(masked(unbounded(make_problem(seed), "l2", 0.3), seed), seed)
    ),
}
each_path = pytest.mark.parametrize("make", PATHS.values(), ids=PATHS.keys())
USUAL = [
    *(("none", scaling, "none") for scaling in ("none", "quadratic", "clamped")),
    *(("linf", *scaled) for scaled in (("none", "none"), ("clamped", "none"))),
    ("linf", "quadratic", "density"),
    ("ndc", "none", "none"),
    ("ndc", "clamped", "none"),
    ("l2", "none", "none"),
    ("l2", "clamped", "paper"),
]
"""Contractions, scalings and terms of the Jacobian that are always compiled; each takes seconds."""
OTHERS = [
    ("linf", "clamped", "density"),
    ("linf", "quadratic", "paper"),
    ("l2", "quadratic", "density"),
    ("ndc", "quadratic", "none"),
]
"""With these there is each pair of two that a variant can have. A contraction passes on nothing but
the determinant, which the other two multiply by: no code depends on all three."""


def variant(constants: tuple[str, str, str], *marks: Any) -> Any:
    """A parameter of a test, with these words in its name."""
    return pytest.param(*constants, marks=marks, id="-".join(constants))


PACKED = {
    ("none", "quadratic", "none"),
    ("none", "clamped", "none"),
    ("linf", "quadratic", "density"),
    ("ndc", "clamped", "none"),
}
"""Of these, and of those without a scaling, the vector form is always compiled, too."""
VARIANTS = [*map(variant, USUAL), *(variant(other, pytest.mark.slow) for other in OTHERS)]


@each_path
def test_values_and_visited_samples(make: Path, kernels64: Kernels) -> None:
    dropped = 0
    for seed in range(N_SEEDS):
        p = make(seed)
        ours, theirs = kernels64.forward(p), oracle(p, torch.tensor(p.raw))
        assert_close(ours.rgb, theirs.rgb, 1e-11)
        assert_close(ours.opacity, theirs.opacity, 1e-11)
        assert_close(ours.depth, theirs.depth, 1e-11)
        assert np.array_equal(ours.n_samples, theirs.kept.sum(1).numpy())
        if p.free.size > 1 or p.steps.transmittance_min > 0.0:
            plain = replace(p, free=np.zeros((1, 1, 1), np.uint8))
            plain = replace(plain, steps=replace(p.steps, transmittance_min=0.0))
            dropped += int(kernels64.forward(plain).n_samples.sum() - ours.n_samples.sum())
            assert dropped > 0  # what is to drop samples does


@each_path
def test_adjoint_against_autograd(make: Path, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = make(seed)
        assert_close(kernels64.backward(p), oracle_gradient(p), 1e-9)


@each_path
def test_adjoint_against_central_differences(make: Path, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS // 2):
        p = make(seed)

        visited = kernels64.forward(p).n_samples
        moved = []

        def loss(raw: Any, p: Problem = p, visited: Any = visited, moved: Any = moved) -> float:
            out = kernels64.forward(replace(p, raw=raw))
            moved.append(not np.array_equal(out.n_samples, visited))
            return float(
                (p.adj_rgb * out.rgb).sum()
                + (p.adj_opacity * out.opacity).sum()
                + (p.adj_depth * out.depth).sum()
            )

        directions = rng_of(seed).normal(size=(4, *p.raw.shape))
        expected = directional_differences(loss, p.raw, directions, h=2e-5)
        # An early stop makes the image jump where a ray just reaches the threshold.
        smooth = ~np.array(moved).reshape(4, -1).any(axis=1)
        assert smooth.sum() >= 3
        gradient = np.tensordot(directions, kernels64.backward(p), axes=4)
        assert_close(gradient[smooth], expected[smooth], 1e-7)


def test_each_entry_against_central_differences(kernels64: Kernels) -> None:
    p = make_problem(77, n_rays=8, size=(3, 4, 2))

    def loss(raw: Any) -> float:
        out = kernels64.forward(replace(p, raw=raw))
        return float((p.adj_rgb * out.rgb).sum() + (p.adj_depth * out.depth).sum())

    p = replace(p, adj_opacity=np.zeros(p.n_rays))
    entries = np.eye(p.raw.size).reshape(-1, *p.raw.shape)
    expected = directional_differences(loss, p.raw, entries, h=1e-3).reshape(p.raw.shape)
    assert_close(kernels64.backward(p), expected, 1e-8)


@pytest.mark.parametrize("output", ["adj_rgb", "adj_opacity", "adj_depth"])
def test_each_output_alone(output: str, kernels64: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = make_problem(seed)
        others = {"adj_rgb", "adj_opacity", "adj_depth"} - {output}
        p = replace(p, **{name: np.zeros_like(getattr(p, name)) for name in others})
        assert_close(kernels64.backward(p), oracle_gradient(p), 1e-9)


@pytest.mark.parametrize("per_ray", [False, True])
@pytest.mark.parametrize(("contraction", "scaling", "jacobian"), VARIANTS)
def test_scaling_against_the_papers_operation(
    scaling: str, jacobian: str, contraction: str, per_ray: bool, kernels64: Kernels
) -> None:
    for seed in range(N_SEEDS if per_ray else 3):
        p = jittered(make_problem(seed), seed)
        content = rng_of(seed).uniform(0.5, 3.0, size=p.n_rays if per_ray else 1)
        p = replace(p, content_distance=content)
        if contraction != "none":  # thin, so that light gets far: scales grow to 1e9 there
            p = replace(unbounded(p, contraction, 0.7), density_scale=0.1)
        expected = oracle_gradient(p, scaling, jacobian)
        assert_close(kernels64.backward(p, scaling, jacobian), expected, 1e-9)
        if scaling != "none":
            plain = oracle_gradient(p)
            assert np.abs(plain - expected).max() > 0.02 * np.abs(plain).max()
        if jacobian != "none":
            flat = oracle_gradient(p, scaling)
            assert np.abs(flat - expected).max() > 1e-3 * np.abs(flat).max()


@pytest.mark.parametrize(
    ("contraction", "scaling", "jacobian"), [v for v in VARIANTS if v.values[0] != "l2"]
)
def test_training_launch_against_autograd(
    scaling: str, jacobian: str, contraction: str, kernels64: Kernels
) -> None:
    for seed in range(5):
        p = make_problem(seed)
        if contraction != "none":
            p = unbounded(p, contraction, 0.2)
        p = early(masked(jittered(p, seed), seed))
        p = replace(p, content_distance=rng_of(seed).uniform(0.5, 3.0, size=p.n_rays))
        error, gradient = kernels64.train(p, scaling, jacobian)
        expected_error, expected = oracle_train(p, scaling, jacobian)
        assert_close(error, expected_error, 1e-11)
        assert_close(gradient, expected, 1e-9)


def fused_against_two(kernels: Kernels, p: Problem, scaling: str, tolerance: float) -> None:
    error, fused = kernels.train(p, scaling)
    adj_rgb = 2.0 / p.n_rays * (kernels.forward(p).rgb - p.target)
    zero = np.zeros(p.n_rays)
    two = kernels.backward(replace(p, adj_rgb=adj_rgb, adj_opacity=zero, adj_depth=zero), scaling)
    assert_close(fused, two, tolerance)
    rgb = kernels.forward(p).rgb
    assert_close(error, ((rgb - p.target) ** 2).sum(-1), tolerance)


@pytest.mark.ci
@pytest.mark.parametrize("scaling", [pytest.param("none", marks=pytest.mark.slow), "clamped"])
def test_fused_launch_equals_forward_and_backward(
    scaling: str, kernels64: Kernels, kernels32: Kernels
) -> None:
    for seed in range(N_SEEDS):
        p = early(make_problem(seed, content_distance=np.array([1.5])))
        fused_against_two(kernels64, p, scaling, 1e-13)
        fused_against_two(kernels32, p, scaling, 3e-6)


@pytest.mark.parametrize(
    ("contraction", "scaling", "jacobian"),
    [
        variant(("none", "clamped", "none")),
        variant(("linf", "quadratic", "density")),
        variant(("none", "quadratic", "none"), pytest.mark.slow),
        variant(("linf", "clamped", "none"), pytest.mark.slow),
        variant(("ndc", "clamped", "none"), pytest.mark.slow),
    ],
)
def test_forward_is_the_same_bits_for_every_scaling(
    contraction: str, scaling: str, jacobian: str, kernels32: Kernels
) -> None:
    p = make_problem(5, n_rays=200, content_distance=np.array([1.5]))
    p = early(p if contraction == "none" else unbounded(p, contraction, 0.2))
    plain = kernels32.train(p)
    scaled = kernels32.train(p, scaling, jacobian)
    assert np.array_equal(scaled[0], plain[0])
    assert not np.array_equal(scaled[1], plain[1])


def test_limits_of_the_scaling(kernels64: Kernels, on_cpu: None) -> None:
    for seed in range(N_SEEDS):
        p = make_problem(seed)
        plain = kernels64.backward(p)
        tiny = replace(p, content_distance=np.array([1e-200]))
        assert np.array_equal(kernels64.backward(tiny, "clamped"), plain)
        # every sample beyond D
        beyond = replace(p, steps=replace(p.steps, near=0.5))
        beyond = replace(beyond, content_distance=np.array([0.5]))
        untouched = kernels64.backward(beyond)
        assert np.abs(untouched).max() > 1e-3
        assert np.array_equal(kernels64.backward(beyond, "clamped"), untouched)
        # a single sample, at t = 0, in the middle of the box
        at_camera = replace(
            p,
            origins=0.1 * p.origins,
            offsets=np.array([0.0]),
            steps=Steps(near=0.0, far=0.1, step=0.1),
        )
        assert (kernels64.forward(at_camera).n_samples == 1).all()
        assert np.abs(kernels64.backward(at_camera)).max() > 1e-3
        for scaling in ("quadratic", "clamped"):
            assert not kernels64.backward(at_camera, scaling).any()


def test_a_sample_at_content_distance_keeps_its_gradient_exactly(kernels32: Kernels) -> None:
    p = make_problem(3, n_rays=1, origins=np.zeros((1, 3)), offsets=np.array([0.5]))
    p = replace(p, background=np.ones((1, 3)), steps=Steps(near=0.0, far=0.6, step=0.6))
    t = float(np.float32(0.5) * np.float32(0.6))
    p = replace(p, content_distance=np.array([t]))
    plain = kernels32.backward(p)
    assert np.abs(plain).max() > 1e-3
    assert np.array_equal(kernels32.backward(p, "clamped"), plain)
    twice = replace(p, content_distance=np.array([2.0 * t]))
    assert np.array_equal(kernels32.backward(twice, "clamped"), 0.25 * plain)


def test_nothing_flows_back_from_behind_an_opaque_wall(kernels32: Kernels) -> None:
    """What lies behind is shed by subtraction: of its rounding, nothing may reach unlit nodes."""
    for seed in range(N_SEEDS):
        p = make_problem(seed, size=(9, 4, 4), density_scale=10.0)
        raw = p.raw.astype(np.float32).astype(np.float64)
        raw[..., 0] -= 4.0
        raw[4, ..., 0] = 300.0
        directions = unit(p.directions * [0.2, 0.2, 0.2] + [1.0, 0.0, 0.0])
        p = replace(p, raw=raw, origins=0.3 * p.origins - [1.5, 0.0, 0.0], directions=directions)
        through = replace(p, density_scale=1e-3)  # rays do get there
        assert kernels32.backward(through)[6:].any()
        gradient = kernels32.backward(p)
        assert_close(gradient, oracle_gradient(p), 1e-5)
        assert not gradient[6:].any()


@pytest.mark.ci
def test_float32_against_float64_on_300_000_samples(kernels64: Kernels, packed: Kernels) -> None:
    require_float32_like_float64(kernels64, packed)


@pytest.mark.slow
def test_the_plain_form_on_300_000_samples(kernels64: Kernels, device: str) -> None:
    require_float32_like_float64(kernels64, Kernels("float32", device))


def require_float32_like_float64(kernels64: Kernels, kernels32: Kernels) -> None:
    rng = np.random.default_rng(8)
    n_rays, n_steps = 1500, 200
    p = make_problem(8, n_rays=n_rays, size=(48, 48, 48))
    origins = np.array([0.1, 0.05, -0.05]) + 0.02 * rng.normal(size=(n_rays, 3))
    step = np.float64(np.float32(0.8 / n_steps))
    p = replace(
        p,
        origins=origins.astype(np.float32).astype(np.float64),
        directions=unit(rng.normal(size=(n_rays, 3))),
        raw=p.raw.astype(np.float32).astype(np.float64),
        steps=Steps(near=0.0, far=1e30, step=float(step)),
        content_distance=np.array([0.4]),
    )
    p = replace(p, steps=replace(p.steps, far=float(step) * n_steps))
    assert kernels64.forward(p).n_samples.sum() == n_rays * n_steps == 300_000
    assert kernels32.forward(p).n_samples.sum() == 300_000
    for scaling in ("none", "quadratic", "clamped"):
        exact, rounded = kernels64.train(p, scaling)[1], kernels32.train(p, scaling)[1]
        error = np.abs(rounded - exact).max() / np.abs(exact).max()
        print(f"float32 against float64, {scaling}: {error:.2e}")
        assert_close(rounded, exact, 1e-5)


def test_rays_that_miss_see_the_background(kernels64: Kernels) -> None:
    p = make_problem(4)
    away = replace(p, origins=5.0 * unit(p.origins), directions=unit(p.origins))
    out = kernels64.forward(away)
    assert not out.n_samples.any()
    assert np.array_equal(out.rgb, p.background)
    assert not out.opacity.any() and not out.depth.any()
    assert not kernels64.backward(away).any()
    before_near = replace(p, steps=replace(p.steps, near=10.0, far=20.0))
    assert not kernels64.forward(before_near).n_samples.any()


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_rays_that_are_not_finite_see_the_background(contraction: str, kernels32: Kernels) -> None:
    """They would walk on for a thousand million steps."""
    p = make_problem(5, steps=Steps(near=0.0, far=1e30, step=0.08))
    if contraction != "none":
        steps = Steps(near=0.0, far=1e6, step=0.08, n_linear=30, growth=0.05)
        p = replace(unbounded(p, contraction, 0.2), steps=steps)
    lost = [0, 3, 4, 6]
    p.directions[lost[0]] = np.nan
    p.directions[lost[1], 1] = np.inf
    p.origins[lost[2], 2] = np.nan
    p.directions[lost[3]] = 0.0
    out = kernels32.forward(p)
    assert not out.n_samples[lost].any() and out.n_samples.any()
    assert np.array_equal(out.rgb[lost], p.background[lost].astype(np.float32))
    assert np.isfinite(kernels32.backward(p)).all()
