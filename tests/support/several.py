"""Several processes of one training, forked from this one, as torchrun would start them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

LIMIT = 200.0
"""Seconds after which they count as hung, on a busy machine."""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """How a process ended."""

    code: int
    """Its exit code; -9 where it was killed."""
    out: str
    err: str


def several(
    function: Callable[[int], int | None], folder: Path, n: int = 2, killed_after: int | None = None
) -> list[Ended]:
    """Call a function of its rank in processes of their own, one for each rank.

    Args:
        function: Its result is the exit code.
        folder: For what they print.
        n: How many.
        killed_after: The rank with whose end that of those is due that still run.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def one(rank: int) -> None:
        for number, name in ((1, "out"), (2, "err")):
            file = os.open(folder / f"{name}{rank}", os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
            os.dup2(file, number)
        sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(n), "LOCAL_RANK": str(rank)}
        os.environ |= {"LOCAL_WORLD_SIZE": str(n), "MASTER_ADDR": "127.0.0.1"}
        os.environ["MASTER_PORT"] = str(port)
        code = function(rank)
        sys.stdout.flush()
        os._exit(code or 0)

    context = multiprocessing.get_context("fork")
    started = [context.Process(target=one, args=(rank,)) for rank in range(n)]
    for process in started:
        process.start()
    if killed_after is not None:
        started[killed_after].join(LIMIT)
        for process in started:
            process.kill()
    ended = []
    for rank, process in enumerate(started):
        process.join(LIMIT)
        if process.exitcode is None:
            process.kill()
            process.join()
        assert process.exitcode is not None
        out, err = ((folder / f"{name}{rank}").read_text() for name in ("out", "err"))
        ended.append(Ended(code=process.exitcode, out=out, err=err))
    return ended
