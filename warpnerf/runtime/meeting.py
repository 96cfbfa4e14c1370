"""Barrier and exchange of processes of one machine, by counters in memory that all of them share.

It takes microseconds where messages through a socket take a millisecond.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from mmap import mmap
from threading import Lock

import numpy as np

from warpnerf.runtime.process import is_alive

LINE = 8
"""Numbers of a cache line: each process writes lines of its own."""
SPIN = 2e-3
"""Seconds that a process spins before it sleeps between looks."""
LOOK_EVERY = 1e-4
CHECK_EVERY = 0.1
"""Seconds from one check that the others live to the next."""


def meeting_bytes(count: int) -> int:
    """Memory that so many processes need, all zero."""
    return 8 * LINE * 3 * count


class Meeting:
    """Where processes wait for each other, and tell each other a few numbers."""

    def __init__(self, memory: mmap, rank: int, process_ids: Sequence[int]) -> None:
        """Nobody has come yet.

        Args:
            memory: Of ``meeting_bytes``.
            rank: Which process this is.
            process_ids: Of all, by rank.
        """
        lines = np.frombuffer(memory, np.int64)[: LINE * 3 * len(process_ids)]
        lines = lines.reshape(3, len(process_ids), LINE)
        self._come = lines[0, :, 0]
        self._numbers = lines[1:].view(np.float64)
        self._rank = rank
        self._process_ids = process_ids
        self._times = 0
        self._lock = Lock()

    def wait(self, patience: float) -> None:
        """Barrier: return once all have come; what each has written before, all can read.

        Args:
            patience: Seconds until who has not come counts as hung.

        Raises:
            RuntimeError: A process has ended, or does not come.
        """
        self._times += 1
        self._fence()
        self._come[self._rank] = self._times
        began = time.monotonic()
        checked = began
        while (self._come < self._times).any():
            now = time.monotonic()
            if now - began < SPIN:
                os.sched_yield()
                continue
            time.sleep(LOOK_EVERY)
            if now - checked >= CHECK_EVERY:
                self._require_others(now - began < patience)
                checked = now
        self._fence()

    def exchange(self, numbers: Sequence[float], patience: float) -> np.ndarray:
        """Tell all others a few numbers, at most LINE; a barrier, too.

        Args:
            numbers: Of this process.
            patience: As of ``wait``.

        Returns:
            [n_processes, n] those of all.

        Raises:
            RuntimeError: As of ``wait``.
        """
        # Whoever is a meeting ahead writes to the other half; nobody is two ahead.
        half = self._numbers[(self._times + 1) % 2, :, : len(numbers)]
        half[self._rank] = numbers
        self.wait(patience)
        return half.copy()

    def _require_others(self, in_time: bool) -> None:
        for rank in np.flatnonzero(self._come < self._times).tolist():
            lives = is_alive(self._process_ids[rank])
            if self._come[rank] >= self._times:  # it may have come, and ended, meanwhile
                continue
            if not lives:
                raise RuntimeError(f"process {rank} has ended")
            if not in_time:
                raise RuntimeError(f"process {rank} does not come")

    def _fence(self) -> None:
        """Keep what is written before from being seen after what is written later, and likewise
        what is read: by acquiring a lock after it has been released."""
        for _ in range(2):
            with self._lock:
                pass
