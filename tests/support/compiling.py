"""How kernels are compiled for tests: quickly what no user runs, and nothing by two processes at
once."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path

import warp as wp

from warpnerf.runtime.parallel import Workers

try:
    import fcntl
except ImportError:  # Windows: each compiles for itself
    fcntl = None  # type: ignore[assignment]

OPTION = "optimization_level"
NOT_FOR_USERS = ("warpnerf_kernels_float64", "warpnerf_kernels.launch.scalar")
"""Modules of kernels that no training runs on the CPU: those in float64, and the plain form."""
LOCKS = Path(tempfile.gettempdir()) / "warpnerf-tests-locks"


@contextmanager
def one_at_a_time(name: str) -> Iterator[None]:
    """While no other process of the tests is here with that name; who waited finds what it made."""
    if fcntl is None:
        yield
        return
    LOCKS.mkdir(exist_ok=True)
    with (LOCKS / f"{os.getuid()}-{name}").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def compile_as_tests_do() -> None:
    """From now on in this process.

    Kernels in float64 and plain ones are for checking what is computed, and are launched a few
    times: they are not optimised, which halves the time that they take. Those that train on the CPU
    are as users have them.
    """
    load = Workers.load

    @wraps(load)
    def quickly(workers: Workers, kernel: wp.Kernel) -> None:
        if kernel in workers._loaded:
            return
        if kernel.func.__module__.startswith(NOT_FOR_USERS) and not workers.device.is_cuda:
            kernel.module.options[OPTION] = 0
        with one_at_a_time(kernel.module.name):
            load(workers, kernel)

    Workers.load = quickly  # type: ignore[method-assign]
