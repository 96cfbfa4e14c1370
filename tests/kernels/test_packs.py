"""Sixteen samples at a time: held to the plain kernels, and to the oracle on all their paths."""

from dataclasses import replace

import numpy as np
import pytest

from tests.kernels.test_render import (
    OTHERS,
    PACKED,
    USUAL,
    Path,
    each_path,
    early,
    jittered,
    masked,
    rng_of,
    variant,
)
from tests.support.expected import assert_close, oracle_gradient, oracle_train
from tests.support.kernel_runner import Kernels
from tests.support.problems import N_SEEDS, Problem, in_float32, make_problem, unbounded
from warpnerf.rendering.steps import Steps


def rounding(p: Problem, scaling: str = "none") -> float:
    """What float32 may cost, of the largest value. Steps that grow to several units, in contracted
    space, amplify it: there each of the two is off float64 by up to 4e-5, as measured. So does a
    scaling without an upper bound in a frustum, where a far distance is the quotient of a small
    difference: the square of that is off by up to 1.7e-5."""
    if p.contraction == "ndc":
        return 3e-5 if scaling == "quadratic" else 1e-5
    return 1e-5 if p.steps.growth == 0.0 else 5e-5


each_variant = pytest.mark.parametrize(
    ("contraction", "scaling", "jacobian"),
    [
        variant(v, *(() if v[1] == "none" or v in PACKED else [pytest.mark.slow]))
        for v in (*USUAL, *OTHERS)
    ],
)


@pytest.fixture(scope="module")
def plain(packed: Kernels) -> Kernels:
    return Kernels("float32", "cpu")


@each_path
def test_packs_equal_the_plain_kernels(make: Path, packed: Kernels, plain: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = make(seed)
        ours, theirs = packed.forward(p), plain.forward(p)
        assert np.array_equal(ours.n_samples, theirs.n_samples)
        assert_close(ours.rgb, theirs.rgb, rounding(p))
        assert_close(ours.opacity, theirs.opacity, rounding(p))
        assert_close(ours.depth, theirs.depth, rounding(p))
        assert_close(packed.backward(p), plain.backward(p), rounding(p))
        assert_close(packed.train(p)[1], plain.train(p)[1], rounding(p))


@each_path
def test_adjoint_against_autograd(make: Path, packed: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = in_float32(make(seed))
        assert_close(packed.backward(p), oracle_gradient(p), rounding(p))


@each_variant
def test_scaling_against_the_papers_operation(
    scaling: str, jacobian: str, contraction: str, packed: Kernels
) -> None:
    for seed in range(N_SEEDS):
        p = jittered(make_problem(seed), seed)
        p = replace(p, content_distance=rng_of(seed).uniform(0.5, 3.0, size=p.n_rays))
        if contraction != "none":
            p = replace(unbounded(p, contraction, 0.7), density_scale=0.1)
        p = in_float32(p)
        expected = oracle_gradient(p, scaling, jacobian)
        assert_close(packed.backward(p, scaling, jacobian), expected, rounding(p, scaling))


@each_variant
def test_training_launch_against_autograd(
    scaling: str, jacobian: str, contraction: str, packed: Kernels
) -> None:
    for seed in range(5):
        p = make_problem(seed)
        if contraction != "none":
            p = unbounded(p, contraction, 0.2)
        p = early(masked(jittered(p, seed), seed))
        p = in_float32(replace(p, content_distance=rng_of(seed).uniform(0.5, 3.0, size=p.n_rays)))
        error, gradient = packed.train(p, scaling, jacobian)
        expected_error, expected = oracle_train(p, scaling, jacobian)
        assert_close(error, expected_error, rounding(p))
        assert_close(gradient, expected, rounding(p, scaling))


def test_capacity_changes_nothing(packed: Kernels) -> None:
    """Rays of up to ten packs: in one slot, in some, and in more than they need."""
    for seed in range(N_SEEDS):
        p = masked(make_problem(seed, steps=Steps(near=0.0, far=4.0, step=0.02)), seed)
        for problem in (p, early(p)):
            in_one_slot = packed.train(problem, "clamped", capacity=0)
            for capacity in (2, 3, 5, 8, 64):
                error, gradient = packed.train(problem, "clamped", capacity=capacity)
                assert np.array_equal(error, in_one_slot[0])
                assert np.array_equal(gradient, in_one_slot[1])


def test_limits_of_the_scaling(packed: Kernels) -> None:
    for seed in range(N_SEEDS):
        p = make_problem(seed)
        beyond = replace(p, steps=replace(p.steps, near=0.5), content_distance=np.array([0.5]))
        untouched = packed.backward(beyond)
        assert np.abs(untouched).max() > 1e-3
        assert np.array_equal(packed.backward(beyond, "clamped"), untouched)
        at_camera = replace(
            p,
            origins=0.1 * p.origins,
            offsets=np.array([0.0]),
            steps=Steps(near=0.0, far=0.1, step=0.1),
        )
        assert (packed.forward(at_camera).n_samples == 1).all()
        assert np.abs(packed.backward(at_camera)).max() > 1e-3
        for scaling in ("quadratic", "clamped"):
            assert not packed.backward(at_camera, scaling).any()


def test_activations_over_their_whole_range(packed: Kernels) -> None:
    """One sample in a uniform grid: opacity and colour are the activations themselves."""
    step = 0.25
    p = make_problem(0, n_rays=1, size=(2, 2, 2), origins=np.zeros((1, 3)))
    p = replace(p, background=np.zeros((1, 3)), density_shift=0.0)
    p = replace(p, steps=Steps(near=0.0, far=step, step=step))
    far, wide = np.linspace(-500.0, 500.0, 21), np.linspace(-80.0, 80.0, 161)
    thin = np.linspace(-4.0, -3.0, 41)  # an optical depth of 0.01, where formulas change
    for raw in [*far, *wide, *thin, *np.linspace(-2.0, 2.0, 101)]:
        value = float(np.float32(raw))
        rgb = np.array([value, -value, 0.5 * value])
        out = packed.forward(replace(p, raw=np.broadcast_to([value, *rgb], p.raw.shape)))
        opacity = -np.expm1(-step * np.logaddexp(0.0, value))
        np.testing.assert_allclose(out.opacity, opacity, rtol=4e-7, atol=6e-8)
        colour = opacity / (1.0 + np.exp(-rgb))
        np.testing.assert_allclose(out.rgb[0], colour, rtol=8e-7, atol=6e-8)


def test_thin_media_keep_their_digits(packed: Kernels) -> None:
    """An optical depth far below float32's resolution of 1."""
    p = make_problem(1, density_scale=1e-12, background=np.zeros((1, 3)))
    thicker = replace(p, density_scale=1e-6)
    ratio = packed.forward(thicker).depth / packed.forward(p).depth
    np.testing.assert_allclose(ratio, 1e6, rtol=1e-4)


@pytest.mark.parametrize("channel", range(4))
def test_what_is_not_a_number_shows(channel: int, packed: Kernels) -> None:
    """Else a broken training would look like empty space."""
    p = make_problem(2)
    raw = p.raw.copy()
    raw[..., channel] = np.nan
    out = packed.forward(replace(p, raw=raw))
    seen = out.n_samples > 0
    assert seen.any()
    colour = out.rgb if channel == 0 else out.rgb[:, [channel - 1]]
    assert np.isnan(colour[seen]).all()
    assert np.isnan(packed.train(replace(p, raw=raw))[0][seen]).all()
