"""Shares of the workers: disjoint and complete."""

import threading
from typing import Any

import numpy as np
import pytest
import warp as wp
from drive import Kernels, make_problem

from warpnerf.checks import InputError
from warpnerf.parallel import NODES, RAYS, Workers


@wp.kernel(enable_backward=False)
def count_visits(first: int, visits: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    visits[i] = visits[i] + 1


@wp.kernel(enable_backward=False)
def note_worker(first: int, worker: int, workers: wp.array(dtype=wp.int32)):
    workers[first + wp.tid()] = worker


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
