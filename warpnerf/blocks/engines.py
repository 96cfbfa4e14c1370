"""Where jobs run: in processes of this machine, or on the workers of a Ray cluster."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import time
import uuid
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from warpnerf.checks import InputError, require_extra
from warpnerf.runtime import child
from warpnerf.runtime.memory import usable_cores

LOST = -9
"""Exit code of a job whose worker is gone."""

POLL = 0.2
"""Seconds from one look of a worker at its training to the next."""

STOPPING = 60.0
"""Seconds that trainings have to save and to stop."""

CONNECT_SECONDS = 5.0
"""To reach the address of a cluster."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """A training that an engine is given."""

    arguments: Sequence[str]
    """Words after ``warpnerf``."""
    log: Path
    """Absolute; what the training prints is appended."""


class Engine(Protocol):
    """Runs trainings, some at a time."""

    slots: int
    """How many at a time."""
    threads: int
    """CPU threads of each."""

    def start(self, work: Work) -> Any:
        """Begin a training; returns what the other methods take."""

    def ended(self, started: Any) -> int | None:
        """Its exit code, negative where its worker was lost; None: it has not ended."""

    def stop(self, started: Iterable[Any]) -> None:
        """Have trainings save and stop; returns when they have."""

    def close(self) -> None:
        """Give back what it holds."""


class LocalEngine:
    """Processes of this machine."""

    def __init__(self, workers: int | None, threads: int | None) -> None:
        """Divide the cores.

        Args:
            workers: Trainings at a time; None: 1.
            threads: CPU threads of each; None: as many as there are cores for it.
        """
        self.slots = 1 if workers is None else workers
        self.threads = max(1, usable_cores() // self.slots) if threads is None else threads

    def start(self, work: Work) -> subprocess.Popen[bytes]:
        """Begin a training, in a process."""
        return child.start(work.arguments, work.log)

    def ended(self, started: subprocess.Popen[bytes]) -> int | None:
        """Its exit code; that of a signal is negative."""
        return started.poll()

    def stop(self, started: Iterable[subprocess.Popen[bytes]]) -> None:
        """Send SIGTERM to all, and wait."""
        processes = list(started)
        for process in processes:
            process.send_signal(signal.SIGTERM)
        for process in processes:
            process.wait()

    def close(self) -> None:
        """It holds nothing."""


class RayEngine:
    """Workers of a Ray cluster, whose machines see the same files."""

    def __init__(self, address: str | None, workers: int | None, threads: int | None) -> None:
        """Connect to a cluster.

        Args:
            address: HOST:PORT of its head, or auto; None: Ray is started on this machine.
            workers: Trainings at a time; None: as many as its cores allow.
            threads: CPU threads, and so cores, of each; None: two, or all of a smaller machine.

        Raises:
            InputError: Ray is missing, or no cluster of its version is there.
        """
        require_extra("ray", "scale", "--engine ray")
        import ray

        if address is not None and address != "auto":
            _require_reachable(address)
        try:
            ray.init(address=address, log_to_driver=False, include_dashboard=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            why = " ".join(str(error).split())[:200].rstrip(".")
            raise InputError(
                f"--address {address or 'of a new Ray'}: no Ray can be used there ({why}); start "
                "one by ray start --head, of the same version, or leave the option out."
            ) from None
        self._ray = ray
        self._stop: Path | None = None
        cores = int(ray.cluster_resources().get("CPU", 1))
        largest = largest_machine(ray.nodes())
        if threads is not None and threads > largest:
            ray.shutdown()
            raise InputError(
                f"--threads {threads}: no machine of the cluster has so many cores, and none would "
                f"ever train; give {largest} at the most."
            )
        self.threads = min(2, largest) if threads is None else threads
        self.slots = max(1, cores // self.threads) if workers is None else workers
        # The engine looks after lost jobs itself: another attempt has to wait for the last one.
        self._run = ray.remote(num_cpus=self.threads, max_retries=0)(run_on_worker)

    def start(self, work: Work) -> Any:
        """Queue a training; Ray gives it to a worker with enough cores."""
        if self._stop is None:
            self._stop = work.log.with_name(f".stop-{uuid.uuid4().hex}")
        return self._run.remote(list(work.arguments), str(work.log), str(self._stop))

    def ended(self, started: Any) -> int | None:
        """Its exit code; LOST where its worker is gone."""
        done, _ = self._ray.wait([started], timeout=0)
        if not done:
            return None
        try:
            return int(self._ray.get(started))
        except self._ray.exceptions.RayError:
            return LOST

    def stop(self, started: Iterable[Any]) -> None:
        """Have the workers tell them, and wait."""
        waiting = list(started)
        if waiting and self._stop is not None:
            self._stop.touch()
            self._ray.wait(waiting, num_returns=len(waiting), timeout=STOPPING)
            self._stop.unlink(missing_ok=True)

    def close(self) -> None:
        """Leave the cluster; one that was started here ends."""
        self._ray.shutdown()


def largest_machine(nodes: Iterable[dict[str, Any]]) -> int:
    """Cores of the largest machine that is up, at least 1.

    Args:
        nodes: Of ``ray.nodes``.
    """
    cores = [int(node["Resources"].get("CPU", 0)) for node in nodes if node["Alive"]]
    return max([1, *cores])


def run_on_worker(arguments: list[str], log: str, stop: str) -> int:
    """Run a training on a worker.

    Args:
        arguments: Words after ``warpnerf``.
        log: See ``Work``.
        stop: A file; once it is there the training is told to save and to stop. Ray has no way to
            say so that leaves a worker's processes the time for it.

    Returns:
        The training's exit code.
    """
    process = child.start(arguments, Path(log))
    told = False
    while process.poll() is None:
        if not told and os.path.exists(stop):  # noqa: PTH110, whose way out raises
            process.terminate()
            told = True
        time.sleep(POLL)
    return process.returncode


def _require_reachable(address: str) -> None:
    """Raise InputError where nobody listens at HOST:PORT: Ray itself would look for long."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        with socket.create_connection((host, int(port)), CONNECT_SECONDS):
            return
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(
            f"--address {address}: no Ray is there ({error}); give HOST:PORT of the head of a "
            "cluster, which ray start --head prints, or auto."
        ) from None
