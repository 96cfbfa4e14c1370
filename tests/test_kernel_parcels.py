"""Several workers, one gradient: who adds where, and that nothing is lost on the way."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import reference
import torch
import warp as wp
from drive import Kernels, Problem, assert_close, make_problem, unbounded, unit
from test_kernel_render import early, masked
from warpnerf_kernels import parcels
from warpnerf_kernels.tiles import TILE
from warpnerf_kernels.vectors import LANES

from warpnerf import adjoint
from warpnerf.parallel import Packed
from warpnerf.render import Steps

PLANES = 5
"""Of nodes along x, in the problems here."""


@pytest.fixture(autouse=True)
def _(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory begins with what shows where it is read before it is written."""
    make_parcels = adjoint._make_parcels

    def unwritten(n_packs: int, n_workers: int) -> parcels.Parcels:
        made = make_parcels(n_packs, n_workers)
        made.contents.numpy().view(np.uint8).fill(255)  # not a number
        for numbers in (made.addressed, made.n_contents, made.n_addressed):
            numbers.fill_(1 << 24)  # in no one's memory
        return made

    monkeypatch.setattr(adjoint, "_make_parcels", unwritten)


def problem(seed: int) -> Problem:
    """Rays enough for many parcels from each worker to each."""
    p = make_problem(seed, n_rays=301, steps=Steps(near=0.0, far=4.0, step=0.04))
    return replace(p, raw=np.random.default_rng(seed).normal(size=(PLANES, 7, 6, 4)))


def of(threads: int) -> Kernels:
    return Kernels("float32", "cpu", threads=threads, packed=True)


@pytest.mark.parametrize("threads", [2, 3, 4, PLANES + 2])
@pytest.mark.parametrize("scaling", ["none", "clamped"])
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
def test_any_number_of_parcels(n: int) -> None:
    """Each worker has a parcel of each of its n rays for those others that own a plane of it."""
    size = (PLANES, 7, 6)
    for threads, plane in ((2, 2), (3, 1), (3, 3)):
        nodes = np.random.default_rng(n).uniform(size=(threads * n, 3)) * (1, 6, 5) + (plane, 0, 0)
        p = one_sample_each(nodes, size)
        assert (of(1).forward(p).n_samples == 1).all()
        assert_close(of(threads).backward(p), of(1).backward(p), 3e-6)


def test_nothing_is_sent_of_what_is_all_one_s_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays in the first worker's part, half of them the second's, each a sample."""
    n = 20
    nodes = np.random.default_rng(8).uniform(size=(n, 3)) * (1.9, 6, 5)
    p = one_sample_each(nodes, (PLANES, 7, 6))
    launches = launches_of(monkeypatch)
    gradient = of(2).backward(p)
    made = launches[0].parcels
    assert made is not None
    assert made.n_contents.numpy()[:, 0].tolist() == [0, n // 2]
    assert made.n_addressed.numpy()[:, :2].tolist() == [[0, 0], [n // 2, 0]]
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
        gradient = kernels.no_gradient(size)
        kernels.add_backward(p, gradient)
        nodes = np.flatnonzero(gradient.values.numpy().any(axis=1))
        assert len(nodes) == 8
        # A pair of nodes along z flags the tile that it begins in.
        assert np.array_equal(
            np.flatnonzero(gradient.touched.numpy()), np.unique(nodes[::2] // TILE)
        )


def most_steps(p: Problem) -> int:
    length = float(np.linalg.norm(p.box_max - p.box_min))
    return p.steps.most(length if p.contraction == "none" else math.inf)


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
def test_rays_in_turns(contraction: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where parcels of all rays do not fit; of two for each worker, which do; and of fewer."""
    p = problem(1)
    if contraction != "none":
        p = unbounded(p, contraction, 0.2)
    at_once = of(2).train(p)
    most = most_steps(p)
    for samples in (20_000, 4 * (most + LANES + parcels.RAY), 4 * most, 1):
        monkeypatch.setattr(adjoint, "SAMPLES", samples)
        in_turns = of(2).train(p)
        assert np.array_equal(in_turns[0], at_once[0])
        assert_close(in_turns[1], at_once[1], 3e-6)
        assert_close(of(2).backward(p), of(1).backward(p), 3e-6)


def middles(p: Problem) -> np.ndarray:
    """Where along x rays have half of their steps behind them, in shares of the grid."""
    at = reference.sample_distances(
        p.steps.near, p.steps.far, p.steps.step, p.steps.growth, p.steps.n_linear, most_steps(p)
    )
    points = p.origins[:, None] + at.t.numpy()[:, None] * p.directions[:, None]
    box_min, box_max = torch.tensor(p.box_min), torch.tensor(p.box_max)
    u = reference.grid_coordinates(
        torch.tensor(points), box_min, box_max, p.raw.shape, p.contraction, p.border
    ).numpy() / (np.array(p.raw.shape[:3]) - 1)
    inside = ((u >= 0) & (u <= 1)).all(axis=2) & at.before_far.numpy()
    return np.array(
        [x[found][found.sum() // 2] for x, found in zip(u[..., 0], inside, strict=True)]
    )


@pytest.mark.parametrize("contraction", ["none", "linf", "l2"])
@pytest.mark.parametrize("threads", [2, 3])
def test_each_worker_has_the_rays_nearest_its_part(
    contraction: str, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    p = problem(4)
    if contraction != "none":
        steps = Steps(near=0.07, far=40.0, step=0.03, n_linear=60, growth=0.02)
        p = replace(unbounded(p, contraction, 0.2), steps=steps)
    met = of(1).forward(p).n_samples > 3
    p = replace(p, origins=p.origins[met], directions=p.directions[met])
    p = replace(
        p,
        background=p.background[:1],
        **{
            name: getattr(p, name)[met]
            for name in ("target", "adj_rgb", "adj_opacity", "adj_depth")
        },
    )
    monkeypatch.setattr(adjoint, "SAMPLES", p.n_rays * most_steps(p) // 2)
    middle = middles(p)
    turns = turns_of(lambda: of(threads).backward(p), monkeypatch)
    assert len(turns) >= 2
    first = 0
    for turn in turns:
        assert len(turn) == threads
        rays = np.concatenate(turn)
        assert sorted(rays) == list(range(first, first + len(rays)))
        first += len(rays)
        for share, following in itertools.pairwise(turn):
            # Which of two steps is the middle one is no matter.
            assert middle[share].max() <= middle[following].min() + 0.06
        for share in turn:
            assert (np.diff(share) > 0).all()  # neighbours stay neighbours
    assert first == p.n_rays


def turns_of(launch: Callable[[], Any], monkeypatch: pytest.MonkeyPatch) -> list[list[np.ndarray]]:
    """The rays of each worker in each turn of what is launched."""
    turns = []
    share_out = adjoint.AdjointLaunch._share_out

    def spy(launch: adjoint.AdjointLaunch, begin: int, end: int) -> list[int]:
        bounds = share_out(launch, begin, end)
        assert bounds[0] == begin < bounds[-1] <= end
        order = launch._order.numpy().copy()
        turns.append([order[i:j] for i, j in itertools.pairwise(bounds)])
        return bounds

    monkeypatch.setattr(adjoint.AdjointLaunch, "_share_out", spy)
    launch()
    return turns


@pytest.mark.parametrize("contraction", ["none", "linf"])
def test_rays_that_are_not_finite_are_someone_s(contraction: str) -> None:
    p = problem(9)
    if contraction != "none":
        p = unbounded(p, contraction, 0.2)
    p.directions[:30] = np.nan
    p.directions[30:60, 0] = np.inf
    p.origins[60:90, 0] = -np.inf
    assert_close(of(2).backward(p), of(1).backward(p), 3e-6)


@pytest.mark.parametrize("n_workers", [2, 3, 7])
@pytest.mark.parametrize("largest", [20, 1 << 30])
def test_rays_are_shared_out_by_middle_and_work(largest: int, n_workers: int) -> None:
    """Against sorting: rays of more work than there is room for, and many with the same middle."""
    rng = np.random.default_rng(n_workers)
    n, begin, most_work = 200, 17, 900 * largest // 20
    work = rng.integers(1, largest, n)
    work[[begin, 150]] = 2 * most_work if largest == 20 else 2**31 - 1
    middle = rng.integers(0, parcels.MIDDLES, n)
    middle[::2] = rng.choice([0, 5, parcels.MIDDLES - 1], n // 2)
    scratch = [np.zeros(parcels.MIDDLES, np.int64), np.zeros(n, np.int32)]
    bounds, order = np.zeros(n_workers + 1, np.int32), np.full(n, -1, np.int32)
    arrays = [work.astype(np.int32), middle.astype(np.int32), *scratch, bounds, order]
    on_device = [wp.array(array, device="cpu", copy=False) for array in arrays]
    while begin < n:
        until = np.cumsum(work[begin:])
        end = begin + max(1, int((until <= most_work).sum()))
        wp.launch(parcels.share_out, 1, inputs=[begin, n, most_work, *on_device], device="cpu")
        rays = begin + np.argsort(middle[begin:end], kind="stable")
        until = np.cumsum(work[rays]) - work[rays]
        owner = until * n_workers // work[rays].sum()
        expected = [np.sort(rays[owner == worker]) for worker in range(n_workers)]
        assert (bounds[0], bounds[-1]) == (begin, end)
        for worker, (first, last) in enumerate(itertools.pairwise(bounds)):
            assert np.array_equal(order[first:last], expected[worker])
        assert (order[end:] == -1).all()
        begin = end


@pytest.mark.parametrize("threads", [2, 3, 5])
@pytest.mark.parametrize("distance", [0.1, 9.0])
def test_each_worker_has_as_much_work(
    distance: float, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Cameras at one end of the box, whose rays often miss it, and one on the other side of it."""
    p = replace(problem(6), steps=Steps(near=0.0, far=20.0, step=0.04))
    rng = np.random.default_rng(6)
    middle = 0.5 * (p.box_min + p.box_max)
    p.origins[:] = p.box_max + 0.1
    p.directions[:] = unit(rng.normal(size=p.directions.shape))
    p.directions[::3] = unit(middle - p.origins[::3])
    p.origins[1::3] = middle - (distance, 0.5, 0.5)
    p.directions[1::3] = unit(middle - (0.3, 0, 0) - p.origins[1::3])
    steps = of(1).forward(p).n_samples
    assert 0.5 < (steps > 0).mean() < 0.9
    (turn,) = turns_of(lambda: of(threads).backward(p), monkeypatch)
    work = np.array([steps[share].sum() for share in turn])
    assert work.max() < 1.2 * work.mean()


def test_there_is_room_for_all_parcels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rays between the parts of the second and the third worker, a third of them the first's."""
    p = problem(7)
    nodes = np.random.default_rng(7).uniform(size=(p.n_rays, 3)) * (1, 0, 5) + (3, 0, 0)
    voxel = (p.box_max - p.box_min) / (np.array(p.raw.shape[:3]) - 1)
    p.origins[:] = p.box_min + nodes * voxel
    p.directions[:] = (0, 1, 0)
    p = replace(p, steps=Steps(near=0.0, far=4.0, step=0.004))
    launches = launches_of(monkeypatch)
    of(3).backward(p)
    work = int(launches[0]._work.numpy().sum())
    monkeypatch.setattr(adjoint, "SAMPLES", work + 3 * (most_steps(p) + LANES + parcels.RAY) + 2)
    kernels = of(3)
    turns = turns_of(lambda: kernels.backward(p), monkeypatch)
    assert len(turns) == 1
    made = launches[1].parcels
    assert made is not None
    most, room = made.n_contents.numpy()[:, 0].max(), made.contents.shape[1]
    assert 0.9 * room < most <= room


def test_workers_take_rays_in_the_order_that_they_are_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    p = problem(5)
    whole = of(2).train(p)

    def all_but_the_last(launch: adjoint.AdjointLaunch, begin: int, end: int) -> list[int]:
        launch._order.numpy()[begin:end] = [*range(end - 2, begin - 1, -1), begin]
        return [begin, (begin + end) // 2, end]

    monkeypatch.setattr(adjoint.AdjointLaunch, "_share_out", all_but_the_last)
    error, _ = of(2).train(p)
    assert np.array_equal(error[:-1], whole[0][:-1])
    assert whole[0][-1] != 0 and error[-1] == 0


def test_workers_add_to_no_planes_but_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each delivery by itself."""
    p = problem(2)
    whole = of(1).backward(p)
    seen = []

    def deliver_in_turns(kernels: Kernels) -> None:
        launch = kernels.workers.launch

        def spy(kernel: wp.Kernel, n: int, *arguments: Any, packed: Packed) -> None:
            if kernel is not parcels.deliver_parcels:
                return launch(kernel, n, *arguments, packed=packed)
            size, sent = arguments
            planes = -(-PLANES // n)
            for worker in range(n):
                before = sent.gradient.values.numpy().copy()
                wp.launch(kernel, 1, inputs=[worker, size, sent], device="cpu")
                changed = sent.gradient.values.numpy() != before
                changed = np.flatnonzero(changed.reshape(whole.shape).any((1, 2, 3)))
                assert len(changed) and (changed // planes == worker).all()
                seen.append(worker)

        monkeypatch.setattr(kernels.workers, "launch", spy)

    for threads in (2, 3):
        kernels = of(threads)
        deliver_in_turns(kernels)
        assert_close(kernels.backward(p), whole, 3e-6)
    assert seen == [0, 1, 0, 1, 2]


def test_what_a_worker_adds_at_once_is_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """All rays given to one worker of three: what it does not own is in parcels."""
    p = problem(3)
    whole = of(1).backward(p)
    kernels = of(3)
    launch, make_parcels = kernels.workers.launch_owned, adjoint._make_parcels
    planes: list[list[int]] = []

    def by_owner(kernel: wp.Kernel, items: Any, *arguments: Any, **packed: Packed) -> None:
        if "backward" not in kernel.key:
            return launch(kernel, items, *arguments, **packed)
        wp.launch(kernel, items[-1], inputs=[0, len(planes), *arguments], device="cpu")
        found = arguments[-1].gradient.values.numpy().reshape(whole.shape)
        planes.append(np.flatnonzero(found.any((1, 2, 3))).tolist())

    monkeypatch.setattr(kernels.workers, "launch_owned", by_owner)
    monkeypatch.setattr(adjoint, "_make_parcels", lambda n, workers: make_parcels(3 * n, workers))
    for _ in range(3):
        assert_close(kernels.backward(p), whole, 3e-6)
    assert planes == [[0, 1], [2, 3], [4]]
