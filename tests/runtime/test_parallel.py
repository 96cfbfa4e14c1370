"""Shares of the workers: disjoint and complete."""

import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.cpu.barrier import wait_for_all

from tests.support.compiling import OPTION
from tests.support.kernel_runner import Kernels
from tests.support.problems import make_problem
from warpnerf.checks import InputError
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import NODES, RAYS, LaunchCache, Thread, Workers


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
    for at_once in (NODES, RAYS):
        visits.zero_()
        workers.launch(count_visits, n, visits, at_once=at_once)
        assert (visits.numpy()[:n] == 1).all() and visits.numpy()[n] == 0


def test_workers_own_contiguous_shares(on_cpu: None) -> None:
    workers = Workers("cpu", 3)
    owner = wp.zeros(100, dtype=wp.int32, device="cpu")
    workers.launch_owned(note_worker, 100, owner)
    assert workers.count == 3
    assert np.array_equal(owner.numpy(), np.repeat([0, 1, 2], [33, 33, 34]))


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_what_is_kept_follows_what_changes(threads: int, device: str) -> None:
    workers, cache = Workers(device, threads), LaunchCache()

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
        workers.launch(draw_line, n, line, factor, to, at_once=6, cache=cache)
        expected = factor * (start.numpy()[0] + slope * np.arange(n))
        np.testing.assert_array_equal(to.numpy(), [*expected, *[-100.0] * (50 - n)])


def test_what_stays_the_same_is_converted_once(
    monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    workers, cache = Workers("cpu", 2), LaunchCache()
    visits = wp.zeros(10, dtype=wp.int32, device="cpu")
    owner = wp.zeros(10, dtype=wp.int32, device="cpu")
    kept = LaunchCache()
    workers.launch(count_visits, 10, visits, cache=cache)
    workers.launch_owned(note_worker, 10, owner, cache=kept)
    monkeypatch.setattr(wp, "launch", None)
    for _ in range(3):
        workers.launch(count_visits, 10, visits, cache=cache)
    owner.fill_(7)
    workers.launch_owned(note_worker, 10, owner, cache=kept)
    assert (visits.numpy() == 4).all()
    assert np.array_equal(owner.numpy(), np.repeat([0, 1], 5))


def test_what_was_interrupted_is_converted_anew(
    monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    workers, cache = Workers("cpu", 1), LaunchCache()
    visits, others = (wp.zeros(10, dtype=wp.int32, device="cpu") for _ in range(2))
    workers.launch(count_visits, 10, visits, cache=cache)

    def interrupted(command: wp.Launch, n: int) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(wp.Launch, "set_dim", interrupted)
        with pytest.raises(KeyboardInterrupt):
            workers.launch(count_visits, 5, others, cache=cache)
    workers.launch(count_visits, 10, visits, cache=cache)
    assert (visits.numpy() == 2).all() and not others.numpy().any()


@wp.kernel(module="unique", enable_backward=False)
def add_up_together(
    first: int,
    worker: int,
    n_waits: int,
    barrier: wp.array(dtype=wp.int32),
    numbers: wp.array(dtype=wp.int32),
    out_sum: wp.array2d(dtype=wp.int32),
):
    n_workers = numbers.shape[0]
    for i in range(n_waits):
        numbers[worker] = numbers[worker] + worker + 1
        if not wait_for_all(barrier, n_workers):
            return
        for other in range(n_workers):
            out_sum[worker, i] += numbers[other]
        if not wait_for_all(barrier, n_workers):
            return


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_workers_wait_for_each_other(threads: int, on_cpu: None) -> None:
    """More of them than cores, again and again: none continues before all have come."""
    workers, cache = Workers("cpu", threads), LaunchCache()
    expected = threads * (threads + 1) // 2 * np.arange(1, 51)
    for _ in range(8):
        numbers = wp.zeros(threads, dtype=wp.int32, device="cpu")
        sums = wp.zeros((threads, 50), dtype=wp.int32, device="cpu")
        workers.launch_owned(
            add_up_together, threads, 50, workers.barrier, numbers, sums, cache=cache
        )
        assert (sums.numpy() == expected).all()


@pytest.mark.parametrize("missing", [0, 1, 2])
def test_nobody_waits_for_who_does_not_come(
    missing: int, monkeypatch: pytest.MonkeyPatch, on_cpu: None
) -> None:
    workers, cache = Workers("cpu", 3), LaunchCache()
    numbers = wp.zeros(3, dtype=wp.int32, device="cpu")
    sums = wp.zeros((3, 1), dtype=wp.int32, device="cpu")

    def launch() -> None:
        workers.launch_owned(add_up_together, 3, 1, workers.barrier, numbers, sums, cache=cache)

    launch()
    start = LaunchCache.launch

    def fails(cache: LaunchCache, worker: int, *given: Any) -> None:
        if worker == missing:
            raise KeyboardInterrupt
        start(cache, worker, *given)

    with monkeypatch.context() as patch:
        patch.setattr(LaunchCache, "launch", fails)
        with pytest.raises(KeyboardInterrupt):
            launch()
    assert (sums.numpy() == 6).all()
    launch()
    assert (sums.numpy() > 6).all()


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no such signal here")
def test_interrupted_anywhere(on_cpu: None) -> None:
    """Launches that follow are whole."""
    workers, cache = Workers("cpu", 3), LaunchCache()
    numbers = wp.zeros(3, dtype=wp.int32, device="cpu")
    sums = wp.zeros((3, 1), dtype=wp.int32, device="cpu")
    arguments = (add_up_together, 3, 1, workers.barrier, numbers, sums)
    workers.launch_owned(*arguments, cache=cache)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    interrupted = 0
    try:
        for seconds in np.random.default_rng(0).uniform(1e-5, 5e-4, 300):
            try:
                signal.setitimer(signal.ITIMER_REAL, seconds)
                for _ in range(100):
                    workers.launch_owned(*arguments, cache=cache)
            except KeyboardInterrupt:
                interrupted += 1
            signal.setitimer(signal.ITIMER_REAL, 0)
            numbers.zero_()
            sums.zero_()
            workers.launch_owned(*arguments, cache=cache)
            assert (sums.numpy() == 6).all()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert interrupted > 250  # Python drops what comes while it frees an object


def test_an_interrupt_is_interrupted(monkeypatch: pytest.MonkeyPatch, on_cpu: None) -> None:
    """Who is left in a launch is waited for by the next one."""
    workers, cache = Workers("cpu", 2), LaunchCache()
    numbers = wp.zeros(2, dtype=wp.int32, device="cpu")
    sums = wp.zeros((2, 1), dtype=wp.int32, device="cpu")
    arguments = (add_up_together, 2, 1, workers.barrier, numbers, sums)
    workers.launch_owned(*arguments, cache=cache)
    start, came, go_on = LaunchCache.launch, threading.Event(), threading.Event()

    def late(cache: LaunchCache, worker: int, *given: Any) -> None:
        if worker == 0:
            came.wait()
            raise KeyboardInterrupt
        came.set()
        go_on.wait()
        start(cache, worker, *given)

    def interrupted(thread: Thread) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(LaunchCache, "launch", late)
        patch.setattr(Thread, "wait", interrupted)
        with pytest.raises(KeyboardInterrupt):
            workers.launch_owned(*arguments, cache=cache)
    threading.Timer(0.2, go_on.set).start()
    workers.launch_owned(*arguments, cache=cache)
    assert numbers.numpy().tolist() == [2, 6]  # the second worker was there one more time
    assert (sums.numpy() == 3 + 8).all()


def test_launches_from_several_threads_take_turns(on_cpu: None) -> None:
    """Each needs all workers."""
    workers = Workers("cpu", 3)

    def launch(n: int) -> np.ndarray:
        numbers = wp.zeros(3, dtype=wp.int32, device="cpu")
        sums = wp.zeros((3, n), dtype=wp.int32, device="cpu")
        workers.launch_owned(add_up_together, 3, n, workers.barrier, numbers, sums)
        return sums.numpy()

    launch(1)
    with ThreadPoolExecutor(4) as pool:
        for sums in pool.map(launch, [5] * 100):
            assert (sums == 6 * np.arange(1, 6)).all()


def test_one_keeps_what_several_kernels_take(on_cpu: None) -> None:
    workers, cache = Workers("cpu", 2), LaunchCache()
    visits = wp.zeros(10, dtype=wp.int32, device="cpu")
    owner = wp.zeros(10, dtype=wp.int32, device="cpu")
    for _ in range(2):
        workers.launch(count_visits, 10, visits, cache=cache)
        workers.launch_owned(note_worker, 10, owner, cache=cache)
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


class Named:
    """What is looked at of a kernel, or a module, that is loaded."""

    def __init__(self, name: str, module: Any = None) -> None:
        self.name, self.module, self.options = name, module, {OPTION: 0}


def kernels_in(*modules: str) -> list[Any]:
    """One for each name of a module."""
    made = {name: Named(name) for name in modules}
    return [Named(f"in {name}", made[name]) for name in modules]


def test_one_kernel_of_each_module_is_loaded_once(
    on_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    loaded: list[Any] = []
    told: list[tuple[Any, float]] = []
    monkeypatch.setattr(kernel_cache, "load", lambda kernel, device: loaded.append(kernel))
    workers, kernels = Workers("cpu", 2), kernels_in("a", "b", "b", "c", "d")
    workers.load(*kernels, on_loaded=lambda kernel, seconds: told.append((kernel, seconds)))
    assert sorted(kernel.module.name for kernel in loaded) == ["a", "b", "c", "d"]
    assert {kernel for kernel, _ in told} == set(loaded) and all(s >= 0.0 for _, s in told)
    workers.load(*kernels)
    assert len(loaded) == 4


def test_several_threads_load_at_once(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first kernels first."""
    inside: list[str] = []
    met: list[bool] = []
    both = threading.Event()

    def load(kernel: Any, device: wp.Device) -> None:
        inside.append(kernel.module.name)
        if len(inside) == 2:
            both.set()
        met.append(both.wait(10.0))

    monkeypatch.setattr(kernel_cache, "load", load)
    Workers("cpu", 2).load(*kernels_in(*"abcd"))
    assert met == [True] * 4 and set(inside[:2]) == {"a", "b"}


def test_one_thread_loads_in_turn(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: list[Any] = []
    monkeypatch.setattr(
        kernel_cache, "load", lambda *given: loaded.append((given[0], threading.current_thread()))
    )
    kernels = kernels_in(*"abcd")
    Workers("cpu", 1).load(*kernels)
    assert loaded == [(kernel, threading.current_thread()) for kernel in kernels]


@pytest.mark.parametrize("where", ["main", "other"])
def test_an_error_in_loading_is_raised(
    where: str, on_cpu: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When all threads have ended; what was to be loaded is tried again the next time."""
    meeting, loaded = threading.Barrier(2, timeout=60.0), []

    def load(kernel: Any, device: wp.Device) -> None:
        if kernel in kernels[:2]:
            meeting.wait()
        main = threading.current_thread() is threading.main_thread()
        if main == (where == "main"):
            raise InputError("no room")
        time.sleep(0.05)
        loaded.append(kernel)

    workers, kernels = Workers("cpu", 2), kernels_in(*"abcdef")
    with monkeypatch.context() as patch:
        patch.setattr(kernel_cache, "load", load)
        with pytest.raises(InputError, match="no room"):
            workers.load(*kernels)
    assert len(loaded) == 1
    monkeypatch.setattr(kernel_cache, "load", lambda kernel, device: loaded.append(kernel))
    workers.load(*kernels)
    assert len(loaded) == 7
