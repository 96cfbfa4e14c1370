"""Multithreading on the CPU: a Warp launch runs on one core, several threads overlap launches.

Each worker gets a contiguous share of the items that depends on nothing but their number and the
number of workers. What a worker adds to, it owns; so no two race, and results are the same bits
whatever else the machine is doing.
"""

from __future__ import annotations

import os
import threading
import time
import weakref
from collections.abc import Callable
from functools import partial
from queue import SimpleQueue
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.cpu import barrier

from warpnerf.checks import InputError
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.memory import require_threads, usable_cores, zero_bytes

NODES = 1 << 20
RAYS = 1 << 13
"""Items per launch on the CPU, of little and of much work each: a fraction of a second, because
signals such as Ctrl-C wait for a launch to end."""
COMPILED_AT_ONCE = 8
"""Kernels, by as many threads: each takes some hundred megabytes meanwhile."""


class LaunchCache:
    """What kernels were launched with, in the form that they take: kept for their next launch.

    Converting arguments takes several times as long as a launch does, and threads do it one after
    the other. An argument is converted again where it is another object than last time; so what may
    change in place are the contents of arrays and the fields of structs.
    """

    def __init__(self) -> None:
        """Nothing is kept yet."""
        self._commands: dict[tuple[wp.Kernel, int], tuple[wp.Launch, list[Any]]] = {}

    def launch(
        self, worker: int, kernel: wp.Kernel, n: int, arguments: list[Any], device: wp.Device
    ) -> None:
        """Launch a kernel for one of the workers, on the CPU."""
        # Taken out while it changes: what is interrupted then is converted again.
        command, last = self._commands.pop((kernel, worker), (None, []))
        if command is None:
            command = wp.launch(kernel, n, inputs=arguments, device=device, record_cmd=True)
        else:
            for index, argument in enumerate(arguments):
                if argument is not last[index]:
                    command.set_param_at_index(index, argument)
            if n != last[-1]:
                command.set_dim(n)
        self._commands[kernel, worker] = command, [*arguments, n]
        command.launch()


class Thread:
    """Does what it is given, one thing after the other, until it is given None.

    Whoever waits for it may be interrupted at any point, and wait again. Futures of the standard
    library can be left locked by that.
    """

    def __init__(self) -> None:
        """Start it."""
        self._error: BaseException | None = None
        self._tasks: SimpleQueue[Any] = SimpleQueue()
        self._news: SimpleQueue[object] = SimpleQueue()
        threading.Thread(target=self._work, daemon=True).start()

    def give(self, task: Callable[[], None] | None) -> None:
        """Have something done."""
        self._tasks.put(task)

    def wait(self) -> BaseException | None:
        """Until all that it was given is done; returns what some of it raised."""
        question = object()
        self._tasks.put(question)
        while self._news.get() is not question:  # but one that somebody no longer waits for
            pass
        error, self._error = self._error, None
        return error

    def _work(self) -> None:
        while (task := self._tasks.get()) is not None:
            if not callable(task):
                self._news.put(task)
                continue
            try:
                task()
            except BaseException as error:
                self._error = error
            del task  # and what it holds


def _end(threads: list[Thread]) -> None:
    for thread in threads:
        thread.give(None)


class Workers:
    """The threads that launch kernels on one device. A CUDA device needs, and gets, just one."""

    def __init__(
        self,
        device: str = "cpu",
        threads: int | None = None,
        zeros: Callable[[int], np.ndarray] = zero_bytes,
    ) -> None:
        """Open a device.

        Args:
            device: As Warp names it: cpu, cuda, cuda:1.
            threads: CPU threads; None: one per core that this process may use.
            zeros: Gives memory of so many bytes to gradients on the CPU, [n] uint8.

        Raises:
            InputError: The device does not exist on this machine, or Warp's cache cannot be made.
        """
        if threads is not None:
            require_threads(threads)
        kernel_cache.start()
        try:
            if device.startswith("cuda") and not wp.is_cuda_available():
                raise ValueError("no CUDA driver")
            self.device = wp.get_device(device)
        except Exception as error:
            found = ", ".join(str(d) for d in wp.get_devices())
            raise InputError(
                f"device {device!r} is not available on this machine (found: {found}); "
                "use --device cpu."
            ) from error
        self.count = 1 if self.device.is_cuda else (threads or usable_cores())
        self.zeros = zeros
        self._others: list[Thread] = []
        weakref.finalize(self, _end, self._others)
        self._begin()
        _all_workers.add(self)
        self.barrier = wp.zeros(barrier.SIZE, dtype=wp.int32, device="cpu")
        """Where they wait for each other in a launch on the CPU; see cpu.barrier."""
        self._attendance = self.barrier.numpy()
        self._loaded: set[Any] = set()

    def _begin(self) -> None:
        """No thread is there yet, and nobody launches: also so in a process that was forked."""
        self._others.clear()
        self._launching = threading.Lock()
        self._in_launch = False  # whether somebody may be in one

    def launch(
        self,
        kernel: wp.Kernel,
        n: int,
        *arguments: Any,
        at_once: int = NODES,
        cache: LaunchCache | None = None,
    ) -> None:
        """Run kernel(first, *arguments) over items 0..n-1, shared out over the workers.

        Args:
            kernel: Its thread index counts from the `first` that it is given.
            n: Number of items.
            arguments: The rest of the kernel's arguments.
            at_once: Items of a launch: NODES, RAYS, or as many fewer as an item has nodes.
            cache: What launches before have left, and those to come will find, on the CPU.
        """
        self._launch(kernel, n, lambda worker: arguments, at_once, cache)

    def launch_owned(
        self,
        kernel: wp.Kernel,
        n: int,
        *arguments: Any,
        rays: int = 1,
        cache: LaunchCache | None = None,
    ) -> None:
        """Run kernel(first, worker, *arguments) over items of much work each.

        It writes to what a worker owns. A kernel whose workers wait for each other has an item for
        each of them.

        Args:
            kernel: As for ``launch``; it is also told the worker's number.
            n: Number of items.
            arguments: The rest of the kernel's arguments.
            rays: That an item works on.
            cache: As for ``launch``.
        """
        at_once = max(1, RAYS // rays)
        self._launch(kernel, n, lambda worker: (worker, *arguments), at_once, cache)

    def load(
        self,
        *kernels: wp.Kernel,
        on_loaded: Callable[[wp.Kernel, float], None] = lambda kernel, seconds: None,
    ) -> None:
        """Compile kernels, or fetch them from the cache, once: else every thread would.

        Several are compiled at a time, each by one thread: those of much work should come first.

        Args:
            kernels: Which ones. Of those that share a module one is loaded.
            on_loaded: Called with each that is, one at a time, and how many seconds that took; from
                any thread.
        """
        modules = {kernel.module: kernel for kernel in kernels if kernel not in self._loaded}
        waiting, telling = iter(modules.values()), threading.Lock()

        def load_waiting() -> None:
            try:
                for kernel in waiting:
                    start = time.perf_counter()
                    kernel_cache.load(kernel, self.device)
                    seconds = time.perf_counter() - start
                    with telling:
                        on_loaded(kernel, seconds)
            except BaseException:
                list(waiting)  # nobody begins with another
                raise

        cores = usable_cores() if self.device.is_cuda else self.count
        others = [Thread() for _ in range(1, min(cores, len(modules), COMPILED_AT_ONCE))]
        errors: list[BaseException | None] = []
        try:
            for other in others:
                other.give(load_waiting)
            try:
                load_waiting()
            finally:
                errors += [other.wait() for other in others]
            if any(errors):
                raise next(filter(None, errors))
        finally:
            _end(others)
            del errors  # as in _launch
        self._loaded.update(kernels)

    def _launch(
        self,
        kernel: wp.Kernel,
        n: int,
        arguments: Callable[[int], tuple[Any, ...]],
        at_once: int,
        cache: LaunchCache | None,
    ) -> None:
        if n == 0:
            return
        if kernel not in self._loaded:
            self.load(kernel)
        if self.device.is_cuda:
            block = kernel_cache.threads_of_a_block(self.device)
            wp.launch(kernel, n, inputs=[0, *arguments(0)], device=self.device, block_dim=block)
            return

        def share(worker: int) -> None:
            begin, end = (n * w // self.count for w in (worker, worker + 1))
            try:
                for first in range(begin, end, at_once):
                    if self._attendance[barrier.CANCELLED]:
                        return
                    size, inputs = min(at_once, end - first), [first, *arguments(worker)]
                    if cache is not None:
                        cache.launch(worker, kernel, size, inputs, self.device)
                    else:
                        wp.launch(kernel, size, inputs=inputs, device=self.device)
            except BaseException:
                self._attendance[barrier.CANCELLED] = 1
                raise

        # Workers that wait for each other must all be in the same launch. So there is one at a
        # time, and it ends when none is left in it.
        with self._launching:
            if self._in_launch:  # where an interrupt was interrupted
                self._cancel()
            self._others.extend(Thread() for _ in range(1 + len(self._others), self.count))
            self._in_launch = True
            self._attendance[:] = 0
            try:
                for worker, other in enumerate(self._others, 1):
                    other.give(partial(share, worker))
                share(0)
                errors = [other.wait() for other in self._others]
            except BaseException:
                self._cancel()
                raise
            self._in_launch = False
        try:
            if any(errors):
                raise next(filter(None, errors))
        finally:
            del errors  # else what is raised holds this frame, and this frame what is raised

    def _cancel(self) -> None:
        """Let nobody wait for a worker that does not come, and wait until all have left."""
        self._attendance[barrier.CANCELLED] = 1
        for other in self._others:
            other.wait()
        self._in_launch = False


_all_workers: weakref.WeakSet[Workers] = weakref.WeakSet()


def _begin_again() -> None:
    """Let workers start new threads: a forked process has no thread but the one that forked."""
    for workers in list(_all_workers):
        workers._begin()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_begin_again)
