"""Shares of the workers: disjoint and complete."""

import threading
from typing import Any

import numpy as np
import pytest
import warp as wp
from drive import Kernels, make_problem

from warpnerf.checks import InputError
from warpnerf.parallel import NODES, RAYS, Packed, Workers


@wp.kernel(enable_backward=False)
def count_visits(first: int, visits: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    visits[i] = visits[i] + 1


@wp.kernel(enable_backward=False)
def note_worker(first: int, worker: int, workers: wp.array(dtype=wp.int32)):
    workers[first + wp.tid()] = worker


@wp.struct
class Line:
    slope: float
    start: wp.array(dtype=float)


@wp.kernel(enable_backward=False)
def draw_line(first: int, line: Line, factor: float, out: wp.array(dtype=float)):
    i = first + wp.tid()
    out[i] = factor * (line.start[0] + line.slope * float(i))


@pytest.mark.parametrize("threads", [1, 2, 3, 5])
@pytest.mark.parametrize("n", [0, 1, 2, 7, 1000, 2 * NODES + 3])
def test_every_item_once(threads: int, n: int, device: str) -> None:
    workers = Workers(device, threads)
    visits = wp.zeros(n + 1, dtype=wp.int32, device=workers.device)
    for chunk in (NODES, RAYS):
        visits.zero_()
        workers.launch(count_visits, n, visits, chunk=chunk)
        assert (visits.numpy()[:n] == 1).all() and visits.numpy()[n] == 0


def test_workers_own_contiguous_shares(on_cpu: None) -> None:
    workers = Workers("cpu", 3)
    owner = wp.zeros(100, dtype=wp.int32, device="cpu")
    workers.launch_owned(note_worker, 100, owner)
    assert workers.count == 3
    assert np.array_equal(owner.numpy(), np.repeat([0, 1, 2], [33, 33, 34]))
    owner.fill_(7)
    workers.launch_owned(note_worker, [20, 25, 25, 90], owner)
    assert np.array_equal(owner.numpy(), np.repeat([7, 0, 2, 7], [20, 5, 65, 10]))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_what_is_packed_follows_what_changes(threads: int, device: str) -> None:
    workers, packed = Workers(device, threads), Packed()

    def array(*values: float) -> wp.array:
        return wp.array(values, dtype=float, device=workers.device)

    line, out = Line(), array(*[0.0] * 50)
    line.slope, line.start = 2.0, array(3.0)
    for n, factor, slope, start, to in (
        (50, 1.0, 2.0, line.start, out),
        (50, 1.0, 2.0, line.start, out),
        (50, 4.0, 2.0, line.start, out),  # another number
        (7, 4.0, 2.0, line.start, out),  # fewer items
        (50, 4.0, -1.0, line.start, out),  # a field of the struct
        (50, 4.0, -1.0, array(5.0), out),  # and one that is an array
        (20, 4.0, -1.0, line.start, array(*[0.0] * 50)),  # another array
    ):
        line.slope, line.start = slope, start
        to.fill_(-100.0)
        workers.launch(draw_line, n, line, factor, to, chunk=6, packed=packed)
        expected = factor * (start.numpy()[0] + slope * np.arange(n))
        np.testing.assert_array_equal(to.numpy(), [*expected, *[-100.0] * (50 - n)])


def test_what_stays_the_same_is_packed_once(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    workers, packed = Workers("cpu", 2), Packed()
    visits = wp.zeros(10, dtype=wp.int32, device="cpu")
    owner = wp.zeros(10, dtype=wp.int32, device="cpu")
    kept = Packed()
    workers.launch(count_visits, 10, visits, packed=packed)
    workers.launch_owned(note_worker, 10, owner, packed=kept)
    monkeypatch.setattr(wp, "launch", None)
    for _ in range(3):
        workers.launch(count_visits, 10, visits, packed=packed)
    workers.launch_owned(note_worker, [0, 2, 10], owner, packed=kept)
    assert (visits.numpy() == 4).all()
    assert np.array_equal(owner.numpy(), np.repeat([0, 1], [2, 8]))


def test_what_was_interrupted_is_packed_anew(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    workers, packed = Workers("cpu", 1), Packed()
    visits, others = (wp.zeros(10, dtype=wp.int32, device="cpu") for _ in range(2))
    workers.launch(count_visits, 10, visits, packed=packed)

    def interrupted(command: wp.Launch, n: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(wp.Launch, "set_dim", interrupted)
        with pytest.raises(KeyboardInterrupt):
            workers.launch(count_visits, 5, others, packed=packed)
    workers.launch(count_visits, 10, visits, packed=packed)
    assert (visits.numpy() == 2).all() and not others.numpy().any()


def test_a_thread_alone(on_cpu: None) -> None:
    workers, packed = Workers("cpu", 2), Packed()
    visits = wp.zeros(10, dtype=wp.int32, device="cpu")
    for first in (3, 3, 7):
        workers.launch_alone(count_visits, first, visits, packed=packed)
    assert visits.numpy().tolist() == [0, 0, 0, 2, 0, 0, 0, 1, 0, 0]


def test_one_keeps_what_several_kernels_take(on_cpu: None) -> None:
    workers, packed = Workers("cpu", 2), Packed()
    visits = wp.zeros(10, dtype=wp.int32, device="cpu")
    owner = wp.zeros(10, dtype=wp.int32, device="cpu")
    for _ in range(2):
        workers.launch(count_visits, 10, visits, packed=packed)
        workers.launch_owned(note_worker, 10, owner, packed=packed)
    assert (visits.numpy() == 2).all()
    assert np.array_equal(owner.numpy(), np.repeat([0, 1], 5))


def test_cuda_gets_one_worker_and_the_cpu_its_cores(device: str) -> None:
    assert Workers("cpu", 4).count == 4
    assert Workers("cpu").count >= 1
    if device != "cpu":
        assert Workers(device, 4).count == 1


def test_a_missing_device() -> None:
    with pytest.raises(InputError, match=r"device 'cuda:97' is not available.*use --device cpu"):
        Workers("cuda:97")


def test_an_error_in_a_launch_is_raised(device: str) -> None:
    with pytest.raises(Exception):  # noqa: B017 (Warp's own)
        Workers(device, 2).launch(count_visits, 10, "no array")


def test_same_bits_from_threads_in_any_order(on_cpu: None) -> None:
    """Workers add to parts of their own, so interleaving cannot show."""
    p = make_problem(2, n_rays=301)
    kernels = Kernels("float32", "cpu", threads=2, packed=True)
    expected = kernels.train(p, "clamped")
    results: list[Any] = []
    callers = [
        threading.Thread(target=lambda: results.append(kernels.train(p, "clamped")))
        for _ in range(4)
    ]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(results) == 4
    for error, gradient in results:
        assert np.array_equal(error, expected[0]) and np.array_equal(gradient, expected[1])
