"""What there is of the machine to use: memory, cores."""

from __future__ import annotations

import contextlib
import ctypes
import os
from pathlib import Path

CONTAINER_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Where Linux says how much a container may use: control groups of version 2, and of version 1."""
CORE_LIMITS = (
    (Path("/sys/fs/cgroup/cpu.max"),),
    (
        Path("/sys/fs/cgroup/cpu/cpu.cfs_quota_us"),
        Path("/sys/fs/cgroup/cpu/cpu.cfs_period_us"),
    ),
)
"""Likewise, how many microseconds of all cores together it may use in how many."""


def usable_memory() -> int | None:
    """Bytes that this process can hope for: the machine's, its container's or its own limit's.

    None where the system does not tell.
    """
    limits = [limit for limit in (_machine(), *map(_container, CONTAINER_LIMITS), _own()) if limit]
    return min(limits, default=None)


def _machine() -> int | None:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None


def _container(limit: Path) -> int | None:
    try:
        return int(limit.read_text())
    except (OSError, ValueError):  # not there, or "max"
        return None


def _own() -> int | None:
    try:
        import resource
    except ImportError:
        return None
    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if soft == resource.RLIM_INFINITY else soft


def usable_cores() -> int:
    """Cores that this process may run on, or as many whole ones as its container has time of."""
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    return max(1, min([cores, *(share for share in map(_share, CORE_LIMITS) if share is not None)]))


def _share(files: tuple[Path, ...]) -> int | None:
    try:
        quota, period = (int(word) for file in files for word in file.read_text().split())
    except (OSError, ValueError):  # not there, or "max"
        return None
    return None if quota < 0 else quota // period


def give_back() -> None:
    """Return freed memory to the system, where the C library keeps it for itself (glibc)."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
