"""Whose process this is: the command's own, or one that uses the package as a library.

What a whole process shares is set in the command's only: how much Warp says, the folder of its
cache, standard error, how threads of OpenMP wait.
"""

from __future__ import annotations

import os
from pathlib import Path

_own = False


def make_own() -> None:
    """Call this process the command's own, before anything is loaded that uses OpenMP.

    Its threads, of FLIP and of torch, would spin between two short tasks, and take the cores from
    those that have work. A policy of the user's stays.
    """
    global _own
    _own = True
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def is_own() -> bool:
    """Whether it is."""
    return _own


def is_alive(process: int) -> bool:
    """Whether a process runs on this machine; true where that cannot be found out.

    Args:
        process: Its number.
    """
    if os.name != "posix":  # where the call would end it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # another user's
        return True
    try:
        stat = Path(f"/proc/{process}/stat").read_bytes()
    except OSError:  # no Linux
        return True
    return stat.rpartition(b")")[2].split()[:1] != [b"Z"]  # a zombie, which nobody waited for
