"""Processes that wait for each other in shared memory."""

from __future__ import annotations

import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from mmap import mmap
from multiprocessing.context import ForkProcess

import pytest

from warpnerf.runtime.meeting import Meeting, meeting_bytes
from warpnerf.runtime.process import is_alive

if sys.platform != "linux":
    pytest.skip("processes of these tests are forks", allow_module_level=True)

PATIENCE = 60.0


def forked(work: Callable[[], object]) -> ForkProcess:
    process = multiprocessing.get_context("fork").Process(target=lambda: os._exit(bool(work())))
    process.start()
    return process


def met(n: int, work: Callable[[Meeting, int], bool]) -> list[int]:
    """Exit codes of processes that do some work at a meeting of all: 1 where it says True."""
    memory, ids = mmap(-1, meeting_bytes(n)), mmap(-1, 8 * n)

    def one(rank: int) -> bool:
        while not all(id_of(ids, k) for k in range(n)):
            time.sleep(0.001)
        return work(Meeting(memory, rank, [id_of(ids, k) for k in range(n)]), rank)

    started = [forked(lambda rank=rank: one(rank)) for rank in range(n)]
    for rank, process in enumerate(started):
        ids[8 * rank : 8 * rank + 8] = (process.pid or 0).to_bytes(8, "little")
    for process in started:
        process.join(PATIENCE)
    return [process.exitcode or 0 for process in started]


def id_of(ids: mmap, rank: int) -> int:
    return int.from_bytes(ids[8 * rank : 8 * rank + 8], "little")


def test_all_learn_what_each_has_said_each_time() -> None:
    """However long each takes between two meetings."""

    def differs(meeting: Meeting, rank: int) -> bool:
        for turn in range(60):
            if (turn + rank) % 3 == 0:
                time.sleep(0.002)
            found = meeting.exchange([turn, 10.0 * turn + rank], PATIENCE)
            if found.tolist() != [[turn, 10.0 * turn + k] for k in range(3)]:
                return True
            if turn % 4 == 0:
                meeting.wait(PATIENCE)
        return False

    assert met(3, differs) == [0, 0, 0]


def test_nobody_goes_on_before_all_have_come() -> None:
    clock = mmap(-1, 8)

    def early(meeting: Meeting, rank: int) -> bool:
        if rank == 1:
            time.sleep(0.3)
            clock[0] = 1
        meeting.wait(PATIENCE)
        return clock[0] != 1

    assert met(2, early) == [0, 0]


@pytest.mark.parametrize(("ends", "said"), [(True, "process 1 has ended"), (False, "not come")])
def test_one_that_is_lost_is_noticed(ends: bool, said: str) -> None:
    """One that ended at once, though nobody has waited for it yet; one that hangs after a while."""

    def unnoticed(meeting: Meeting, rank: int) -> bool:
        if rank == 1:
            if not ends:
                time.sleep(1.5)
            return False
        try:
            meeting.wait(PATIENCE if ends else 0.3)
        except RuntimeError as error:
            return said not in str(error)
        return True

    began = time.monotonic()
    assert met(2, unnoticed) == [0, 0]
    assert time.monotonic() - began < PATIENCE


def test_a_zombie_is_not_alive() -> None:
    process = forked(lambda: None)
    assert process.pid is not None
    deadline = time.monotonic() + PATIENCE
    while is_alive(process.pid) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not is_alive(process.pid)
    os.kill(process.pid, 0)  # nobody has waited for it: its number is still its own
    process.join()
