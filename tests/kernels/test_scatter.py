"""Several workers, one gradient: who adds where, and that nothing is lost on the way."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base.simd import LANES
from warpnerf_kernels.base.tiles import TILE
from warpnerf_kernels.cpu import schedule

from tests.kernels.test_render import early, masked
from tests.support.expected import assert_close
from tests.support.kernel_runner import Kernels
from tests.support.problems import Problem, make_problem, unbounded
from tests.support.unwritten import leave_chunks_unwritten, leave_sinks_unwritten
from warpnerf.rendering import adjoint
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import LaunchCache

PLANES = 5
"""Of nodes along x, in the problems here."""


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    leave_sinks_unwritten(monkeypatch)
    leave_chunks_unwritten(monkeypatch)


def problem(seed: int) -> Problem:
    """Rays enough for many records from each worker to each."""
    p = make_problem(seed, n_rays=301, steps=Steps(near=0.0, far=4.0, step=0.04))
    return replace(p, raw=np.random.default_rng(seed).normal(size=(PLANES, 7, 6, 4)))


def of(threads: int) -> Kernels:
    return Kernels("float32", "cpu", threads=threads, packed=True)


@pytest.mark.parametrize("threads", [2, 3, 4, PLANES + 2])
@pytest.mark.parametrize("scaling", [pytest.param("none", marks=pytest.mark.slow), "clamped"])
def test_one_thread_against_more(threads: int, scaling: str) -> None:
    for seed in range(3):
        for p in (problem(seed), early(masked(problem(seed), seed))):
            error, gradient = of(1).train(p, scaling)
            again = of(threads).train(p, scaling)
            assert np.array_equal(again[0], error)  # no sum over rays
            assert_close(again[1], gradient, 3e-6)
            assert_close(of(threads).backward(p, scaling), of(1).backward(p, scaling), 3e-6)


def one_sample_each(nodes: Any, size: tuple[int, int, int], seed: int = 0) -> Problem:
    """Rays that meet a single sample, at positions [n_rays, 3] between the nodes of such a grid."""
    p = make_problem(seed, n_rays=len(nodes), size=size, steps=Steps(near=0.0, far=0.1, step=0.1))
    at = p.box_min + nodes * (p.box_max - p.box_min) / (np.array(size) - 1)
    return replace(p, origins=at - 0.05 * p.directions)


@pytest.mark.parametrize("n", [1, 2, 5, 130])
def test_any_number_of_records(n: int) -> None:
    """Each worker has a record of each of its n rays for those others that own a plane of it."""
    size = (PLANES, 7, 6)
    for threads, plane in ((2, 2), (3, 1), (3, 3)):
        nodes = np.random.default_rng(n).uniform(size=(threads * n, 3)) * (1, 6, 5) + (plane, 0, 0)
        p = one_sample_each(nodes, size)
        assert (of(1).forward(p).n_samples == 1).all()
        assert_close(of(threads).backward(p), of(1).backward(p), 3e-6)


def test_nothing_is_left_of_what_is_all_one_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays in the first worker's part, half of them the second's, each a sample."""
    n = 20
    nodes = np.random.default_rng(8).uniform(size=(n, 3)) * (1.9, 6, 5)
    p = one_sample_each(nodes, (PLANES, 7, 6))
    launches = launches_of(monkeypatch)
    gradient = of(2).backward(p)
    made = launches[0].sink
    assert made is not None
    assert made.n_records.numpy()[:, 0].tolist() == [0, n // 2]
    assert made.n_recipients.numpy()[:, :2].tolist() == [[0, 0], [n // 2, 0]]
    assert_close(gradient, of(1).backward(p), 3e-6)


def launches_of(monkeypatch: pytest.MonkeyPatch) -> list[adjoint.AdjointLaunch]:
    """Where what is run from now on is listed."""
    launches: list[adjoint.AdjointLaunch] = []
    run = adjoint.AdjointLaunch.run
    monkeypatch.setattr(
        adjoint.AdjointLaunch,
        "run",
        lambda launch, *given: launches.append(launch) or run(launch, *given),
    )
    return launches


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_only_tiles_around_a_sample_are_flagged(threads: int) -> None:
    size = (PLANES, 4, 40)
    kernels = of(threads)
    for node in np.random.default_rng(threads).uniform(size=(20, 1, 3)) * (PLANES - 1, 3, 39):
        p = one_sample_each(node, size)
        gradient = kernels.no_gradient(p)
        kernels.add_backward(p, gradient)
        nodes = np.flatnonzero(gradient.values.numpy().any(axis=1))
        assert len(nodes) == 8
        # A pair of nodes along z flags the tile that it begins in.
        assert np.array_equal(
            np.flatnonzero(gradient.touched.numpy()), np.unique(nodes[::2] // TILE)
        )


def most_steps(p: Problem) -> int:
    length = float(np.linalg.norm(p.box_max - p.box_min))
    return p.model.most_steps(p.steps, length if p.contraction == "none" else math.inf)


@pytest.mark.parametrize("near", [0.0, 0.5])
@pytest.mark.parametrize("far", [0.9, 2.9, 40.0, 1e30])
@pytest.mark.parametrize(("growth", "n_linear"), [(0.0, 0), (0.02, 12), (0.09, 30), (0.002, 3)])
@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_no_ray_takes_more_steps_than_are_reckoned_with(
    near: float, far: float, growth: float, n_linear: int, contraction: str
) -> None:
    """From corner to corner of the box through thin air, and from anywhere else."""
    if contraction != "none" and far == 1e30 and growth == 0.0:
        return  # a walk without end
    steps = Steps(near=near, far=far, step=0.04, growth=growth, n_linear=n_linear)
    p = make_problem(0, n_rays=40, steps=steps, contraction=contraction, density_scale=1e-6)
    p = replace(p, border=0.0 if contraction == "none" else 0.2)
    across = (p.box_max - p.box_min) / np.linalg.norm(p.box_max - p.box_min)
    p.origins[0], p.directions[0] = p.box_min - (near + 1e-3) * across, across
    taken = of(1).forward(p).n_samples
    assert taken.max() <= most_steps(p)
    if contraction != "none" or (growth == 0.0 and far > 10.0):
        assert taken.max() >= most_steps(p) - 6


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_rays_in_chunks(contraction: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where records of all rays do not fit; of two for each worker, which do; and of fewer."""
    p = problem(1)
    if contraction != "none":
        p = unbounded(p, contraction, 0.2)
    at_once = of(2).train(p)
    most = most_steps(p)
    for samples in (20_000, 4 * (most + LANES + schedule.RAY), 4 * most, 1):
        monkeypatch.setattr(adjoint, "RECORDS", 32 * samples)
        in_chunks = of(2).train(p)
        assert np.array_equal(in_chunks[0], at_once[0])
        assert_close(in_chunks[1], at_once[1], 3e-6)
        assert_close(of(2).backward(p), of(1).backward(p), 3e-6)


def test_fewer_workers_where_there_is_no_room_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of three."""
    p = problem(1)
    monkeypatch.setattr(adjoint, "RECORDS", 128 * (most_steps(p) + LANES + schedule.RAY))
    launches = launches_of(monkeypatch)
    assert_close(of(3).backward(p), of(1).backward(p), 3e-6)
    made = launches[0].sink
    assert made is not None and made.records.shape[0] == 2


@pytest.mark.parametrize("threads", [2, 3])
def test_nothing_is_added_where_a_worker_is_missing(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them; the others leave, and the next batch is whole."""
    p = problem(2)
    whole = of(1).backward(p)
    kernels = of(threads)
    start = LaunchCache.launch
    for missing in range(threads):

        def fails(cache: LaunchCache, worker: int, *given: Any, missing: int = missing) -> None:
            if worker == missing:
                raise KeyboardInterrupt
            start(cache, worker, *given)

        gradient = kernels.no_gradient(p)
        with monkeypatch.context() as patch:
            patch.setattr(LaunchCache, "launch", fails)
            with pytest.raises(KeyboardInterrupt):
                kernels.add_backward(p, gradient)
        assert not gradient.values.numpy().any()
        assert_close(kernels.backward(p), whole, 3e-6)


def test_there_is_room_for_all_records(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays between the parts of the second and the third worker, a third of them the first's."""
    p = problem(7)
    nodes = np.random.default_rng(7).uniform(size=(p.n_rays, 3)) * (1, 0, 5) + (3, 0, 0)
    voxel = (p.box_max - p.box_min) / (np.array(p.raw.shape[:3]) - 1)
    p.origins[:] = p.box_min + nodes * voxel
    p.directions[:] = (0, 1, 0)
    p = replace(p, steps=Steps(near=0.0, far=4.0, step=0.004))
    launches = launches_of(monkeypatch)
    monkeypatch.setattr(adjoint, "RECORDS", 32 * 2 * p.n_rays * most_steps(p))
    of(3).backward(p)
    work = int(launches[0].sink.chunk.work.numpy().sum())
    samples = work + 3 * (most_steps(p) + LANES + schedule.RAY) + 2
    monkeypatch.setattr(adjoint, "RECORDS", 32 * samples)
    kernels = of(3)
    kernels.backward(p)
    made = launches[1].sink
    assert made is not None
    most, room = made.n_records.numpy()[:, 0].max(), made.records.shape[1]
    assert 0.9 * room < most <= room


def test_nothing_is_left_where_each_takes_its_own_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the second worker's part come first."""
    n = 20
    nodes = np.random.default_rng(9).uniform(size=(n, 3)) * (0.9, 6, 5)
    nodes[: n // 2, 0] += 3
    p = one_sample_each(nodes, (PLANES, 7, 6))
    launches = launches_of(monkeypatch)
    gradient = of(2).backward(p)
    made = launches[0].sink
    assert made is not None
    assert made.n_records.numpy()[:, 0].tolist() == [0, 0]
    assert_close(gradient, of(1).backward(p), 3e-6)


@pytest.mark.parametrize("threads", [2, 3])
def test_workers_add_to_no_planes_but_their_own(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each worker with a gradient for itself."""
    p = problem(2)
    whole = of(1).backward(p)
    kernels = of(threads)
    own = [kernels.no_gradient(p) for _ in range(threads)]
    start = LaunchCache.launch

    def launch(
        cache: LaunchCache,
        worker: int,
        kernel: wp.Kernel,
        n: int,
        arguments: list[Any],
        device: Any,
    ) -> None:
        shared = arguments[-1]
        alone = type(shared)()
        for name in ("records", "n_records", "recipients", "n_recipients", "chunk"):
            setattr(alone, name, getattr(shared, name))
        alone.gradient = own[worker]
        start(cache, worker, kernel, n, [*arguments[:-1], alone], device)

    monkeypatch.setattr(LaunchCache, "launch", launch)
    kernels.backward(p)
    n_planes = -(-PLANES // threads)
    found = [gradient.values.numpy().reshape(whole.shape) for gradient in own]
    for worker, gradient in enumerate(found):
        planes = np.flatnonzero(gradient.any((1, 2, 3)))
        first = worker * n_planes
        assert planes.tolist() == list(range(first, min(first + n_planes, PLANES)))
    assert_close(np.sum(found, axis=0), whole, 3e-6)
