"""How kernels are compiled for tests: quickly what no user runs, and nothing by two processes at
once."""

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, wraps
from pathlib import Path
from typing import Any

import warp as wp

from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import Workers

try:
    import fcntl
except ImportError:  # Windows: each compiles for itself
    fcntl = None  # type: ignore[assignment]

OPTION = "optimization_level"
FLOAT64 = "warpnerf_kernels_float64"
"""Where modules of kernels are that no training runs."""
LOCKS = Path(
    os.environ.setdefault(
        "WARPNERF_TESTS_LOCKS", str(Path(tempfile.gettempdir()) / "warpnerf-tests-locks")
    )
)
"""The same for all processes of the tests, also for those with temporary files elsewhere."""


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


_optimises = True


@contextmanager
def not_optimising() -> Iterator[None]:
    """Meanwhile no kernel is optimised on the CPU: for what launches many a few times each."""
    global _optimises
    before, _optimises = _optimises, False
    try:
        yield
    finally:
        _optimises = before


@cache
def unoptimised(kernel: wp.Kernel) -> wp.Kernel:
    """The same kernel in a module of its own that is not optimised: compiled in a fifth of the
    time, for tests that launch it a few times."""
    key = re.sub(r"\W", "_", kernel.key)  # a module may have several
    module = wp.Module(f"{kernel.module.name}_{key}_unoptimised", None)
    module.options.update({**kernel.module.options, OPTION: 0})
    return wp.Kernel(kernel.func, key=kernel.key, module=module, options=kernel.options)


def compiled(workers: Workers, kernel: wp.Kernel) -> wp.Kernel:
    """What is loaded and launched in place of a kernel."""
    if workers.device.is_cuda or kernel.module.options.get(OPTION) == 0:
        return kernel
    if _optimises and not kernel.func.__module__.startswith(FLOAT64):
        return kernel
    return unoptimised(kernel)


def compile_as_tests_do() -> None:
    """From now on in this process.

    Kernels in float64 are for checking what is computed, and are launched a few times: they are not
    optimised. Those that train are as users have them, but in ``not_optimising``.
    """
    load, load_all, launch = kernel_cache.load, Workers.load, Workers._launch

    @wraps(load)
    def load_alone(kernel: wp.Kernel, device: wp.Device) -> None:
        with one_at_a_time(kernel.module.name):
            load(kernel, device)

    @wraps(load_all)
    def load_quickly(workers: Workers, *kernels: wp.Kernel, **options: Any) -> None:
        load_all(workers, *(compiled(workers, kernel) for kernel in kernels), **options)

    @wraps(launch)
    def launch_quickly(workers: Workers, kernel: wp.Kernel, *given: Any) -> None:
        launch(workers, compiled(workers, kernel), *given)

    kernel_cache.load = load_alone
    Workers.load = load_quickly  # type: ignore[method-assign]
    Workers._launch = launch_quickly  # type: ignore[method-assign]
