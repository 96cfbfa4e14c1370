"""Commands of ours in processes of their own, which end with the process that started them.

Run as a module, this is the first thing that such a process does.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from warpnerf.writing import open_to_append

IS_CHILD = "WARPNERF_CHILD"
"""Environment variable that is set in such processes."""

DEATH_SIGNAL = 1
"""``PR_SET_PDEATHSIG`` of Linux: what a process is sent when its parent has ended."""


def start(arguments: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """Start ``warpnerf`` with these arguments, in a session of its own.

    So Ctrl-C in a terminal does not reach it. On Linux it gets SIGTERM when the thread that calls
    this has ended, however that came, which for a training means to save and to stop.

    Args:
        arguments: Words of the command line.
        log: What it prints is appended to this file.

    Raises:
        OSError: The file cannot be written to or is a link, or there is no room for a process.
    """
    words = [sys.executable, "-m", "warpnerf.runtime.child", str(os.getpid()), *arguments]
    with open_to_append(log) as file:
        return subprocess.Popen(
            words,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            env={**os.environ, IS_CHILD: "1"},
        )


def is_child() -> bool:
    """Whether this process was started so: who stops all processes, and the parent which passes
    that on, both send it a signal."""
    return IS_CHILD in os.environ


def _become(parent: int, arguments: Sequence[str]) -> None:
    """Become the command."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGTERM)
        if os.getppid() != parent:  # it ended before
            sys.exit(128 + signal.SIGTERM)
    os.execv(sys.executable, [sys.executable, "-m", "warpnerf", *arguments])


if __name__ == "__main__":
    _become(int(sys.argv[1]), sys.argv[2:])
