"""A process that is forked has no threads but the one that forked; it launches all the same."""

import multiprocessing
import signal
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.runtime.test_parallel import add_up_together
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import LaunchCache, Workers

pytestmark = pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="this system does not fork"
)

SECONDS = 60
"""After which a child counts as one that waits for ever, and is ended."""


def in_a_fork(task: Callable[[], Any]) -> Any:
    """What a task returns in a forked process."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def run() -> None:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)  # ends it also amid a launch
        signal.alarm(SECONDS)
        sender.send(task())

    child = context.Process(target=run)
    child.start()
    sender.close()
    child.join()
    assert child.exitcode == 0, "the forked process failed, or waits for ever"
    return receiver.recv()


def sums(workers: Workers, cache: LaunchCache | None = None) -> list[int]:
    """One launch in which all workers wait for each other."""
    numbers = wp.zeros(workers.count, dtype=wp.int32, device="cpu")
    out = wp.zeros((workers.count, 1), dtype=wp.int32, device="cpu")
    workers.launch_owned(
        add_up_together, workers.count, 1, workers.barrier, numbers, out, cache=cache
    )
    return list(out.numpy()[:, 0].tolist())


def test_workers_from_before_a_fork(on_cpu: None) -> None:
    workers, cache = Workers("cpu", 3), LaunchCache()
    assert sums(workers, cache) == [6, 6, 6]
    assert in_a_fork(lambda: [sums(workers, cache), sums(workers)]) == [[6, 6, 6]] * 2
    assert in_a_fork(lambda: in_a_grandchild(workers)) == [6, 6, 6]
    assert sums(workers, cache) == [6, 6, 6]  # and the parent continues


def in_a_grandchild(workers: Workers) -> Any:
    sums(workers)
    return in_a_fork(lambda: sums(workers))


def test_a_fork_amid_a_launch(on_cpu: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another thread of the parent launches, or loads, just then; in the child nobody does."""
    workers = Workers("cpu", 2)
    sums(workers)
    launch, came, go_on = wp.launch, threading.Event(), threading.Event()

    def late(*given: Any, **options: Any) -> Any:
        came.set()
        go_on.wait()
        return launch(*given, **options)

    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", late)
        caller = threading.Thread(target=sums, args=(workers,))
        caller.start()
        came.wait()
    try:
        with kernel_cache._changing, kernel_cache._loading[add_up_together.module]:
            assert in_a_fork(lambda: [sums(workers), sums(Workers("cpu", 2))]) == [[3, 3]] * 2
    finally:
        go_on.set()
        caller.join()


@pytest.mark.slow  # compiles for seconds
def test_torch_operations_in_a_fork(on_cpu: None) -> None:
    """As a DataLoader's workers call them, whose parent has done so before."""
    torch = pytest.importorskip("torch")
    from warpnerf.rendering.operation import workers_of
    from warpnerf.torch import render_rays

    def rendered() -> Any:
        raw = torch.ones(4, 4, 4, 4, requires_grad=True)
        origins = torch.tensor([[0.1, 0.2, -2.0], [0.0, 0.1, -2.0]])
        directions = torch.tensor([[0.0, 0.0, 1.0]]).repeat(2, 1)
        rays = render_rays(raw, origins, directions, ((-1, -1, -1), (1, 1, 1)), step=0.1)
        (gradient,) = torch.autograd.grad(rays.rgb.sum(), raw)
        return rays.rgb.detach().numpy(), gradient.numpy()

    workers_of.cache_clear()
    expected = rendered()
    for ours, theirs in zip(in_a_fork(rendered), expected, strict=True):
        assert np.array_equal(ours, theirs) and np.abs(ours).max() > 0
