"""Intervals in place of steps: the walk through them, in both forms, and what it keeps."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base import precision
from warpnerf_kernels.sampling import resampled
from warpnerf_kernels.sampling.steps import STEPS

from tests.kernels.test_render import early, masked
from tests.seams.given_distances import AtDistances
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.problems import Problem, in_float32, make_problem, unbounded
from tests.support.solid_fields import ball_field
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.proposal import Intervals
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.structs import variant_of

SAMPLES = 37
"""Not whole packs."""


@dataclass(frozen=True, kw_only=True)
class Widths:
    """How wide intervals are on the rays of a problem."""

    seed: int

    def edges(self, p: Problem) -> np.ndarray:
        """[n_rays, n + 1]: each ray has its own."""
        rng = np.random.default_rng(self.seed)
        widths = rng.uniform(0.2, 1.0, (p.n_rays, SAMPLES))
        shares = np.cumsum(np.pad(widths, ((0, 0), (1, 0))), axis=1)
        far = min(p.steps.far, 6.0)
        return p.steps.near + (far - p.steps.near) * shares / shares[:, -1:]


class Resampling(Kernels):
    """The kernels, with intervals for each ray."""

    def with_intervals(self, p: Problem, edges: np.ndarray, *, keep: bool = False) -> Problem:
        """The problem, whose steps are now these."""
        self.kept = self.array(np.zeros((p.n_rays, SAMPLES) if keep else (0, 0)))
        intervals = Intervals(
            kind=Resampled(samples=SAMPLES),
            steps=p.steps,
            edges=self.array(edges),
            weights=self.kept,
        )
        return replace(p, steps=intervals)

    def variant(self, p: Problem, scaling: str = "none", jacobian: str = "none") -> Any:
        return variant_of(
            p.model,
            self.precision,
            p.contraction,
            scaling,
            jacobian,
            self.packed,
            p.objective.config,
            sampler=Resampled(samples=SAMPLES),
        )

    def adjoint(self, p: Problem, kernel: wp.Kernel, variant: Any) -> AdjointLaunch:
        return AdjointLaunch(kernel, variant, SAMPLES, p.n_rays, self.workers)


def problem(contraction: str, seed: int) -> Problem:
    p = make_problem(seed, offsets=np.random.default_rng(seed).uniform(size=12))
    if contraction != "none":
        p = unbounded(p, contraction, 0.8)
    return early(masked(p, seed)) if seed % 2 else p


each_space = pytest.mark.parametrize("contraction", ["none", "linf"])
harder_space = pytest.mark.parametrize(
    "contraction", ["linf", pytest.param("none", marks=pytest.mark.slow)]
)


@harder_space
def test_intervals_that_are_alike_are_steps_at_given_distances(
    contraction: str, device: str, kernels64: Kernels
) -> None:
    """The same samples, the same numbers: as a sampler from outside the package has them."""
    kernels = Resampling("float64", device)
    for seed in range(4):
        p = problem(contraction, seed)
        alike = Widths(seed=seed).edges(p)[:1]
        given = replace(p, model=AtDistances(edges=tuple(alike[0].tolist())))
        drawn = kernels.with_intervals(p, alike.repeat(p.n_rays, axis=0))
        expected, found = kernels64.forward(given), kernels.forward(drawn)
        np.testing.assert_array_equal(found.n_samples, expected.n_samples)
        assert expected.n_samples.sum() > 30
        assert_close(found.rgb, expected.rgb, 1e-12)
        assert_close(found.depth, expected.depth, 1e-12)
        gradients = kernels64.backward(given, "clamped"), kernels.backward(drawn, "clamped")
        assert_close(gradients[1], gradients[0], 1e-12)


@harder_space
@pytest.mark.parametrize("threads", [1, 3])
def test_the_vector_form_equals_the_plain_one(
    contraction: str, threads: int, device: str, on_cpu: None
) -> None:
    exact, found = (
        Resampling("float64", device),
        Resampling("float32", device, threads=threads, packed=True),
    )
    for seed in range(4):
        p = in_float32(problem(contraction, seed))
        edges = Widths(seed=seed).edges(p).astype(np.float32).astype(np.float64)
        ours, theirs = (k.with_intervals(p, edges, keep=True) for k in (found, exact))
        counts = [k.forward(q).n_samples for k, q in ((found, ours), (exact, theirs))]
        np.testing.assert_array_equal(*counts)
        assert_close(found.train(ours, "clamped")[1], exact.train(theirs, "clamped")[1], 2e-5)
        assert_close(found.kept.numpy(), exact.kept.numpy(), 1e-5)


@each_space
def test_what_samples_weigh_is_kept(contraction: str, device: str) -> None:
    """Opacity and depth are sums over it; where no sample is, nothing is written."""
    kernels = Resampling("float64", device)
    for seed in range(4):
        p = problem(contraction, seed)
        edges = Widths(seed=seed).edges(p)
        drawn = kernels.with_intervals(p, edges, keep=True)
        seen = kernels.forward(drawn)
        kept = kernels.kept.numpy()
        t = edges[:, :-1] + p.offsets[:, None] * np.diff(edges, axis=1)
        assert_close(kept.sum(axis=1), seen.opacity, 1e-12)
        assert_close((kept * t).sum(axis=1), seen.depth, 1e-12)
        assert ((kept > 0.0).sum(axis=1) <= seen.n_samples).all()


def test_what_is_free_depends_on_no_interval() -> None:
    """Cells are judged by the steps that a march would take."""
    load = precision.load
    steps = Steps(near=0.1, far=30.0, step=0.2, n_linear=10, growth=0.3)
    kernels = Kernels("float32", "cpu")
    intervals = Intervals(
        kind=Resampled(), steps=steps, edges=kernels.zeros((2, 33)), weights=kernels.zeros((0, 0))
    )
    march = steps.struct(), intervals.struct(lambda name: load("float32", name))
    field = ball_field(contraction="linf")
    cells = [
        FreeCells.of(field.storage, field.workers, params, 1e-3, sampler)
        for params, sampler in zip(march, (STEPS, resampled.INTERVALS), strict=True)
    ]
    np.testing.assert_array_equal(cells[0].distance.numpy(), cells[1].distance.numpy())
    short = FreeCells.of(
        field.storage, field.workers, replace(steps, growth=1e-4).struct(), 1e-3, STEPS
    )
    assert 0.0 < short.share() < cells[0].share() < 1.0  # long steps see more
