"""Memory and CPU cores that this process may use."""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import os
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError, require_whole

MOST_PER_CORE = 16
"""Threads for each core. More than one gain nothing, but are there to try out another machine's."""
CONTAINER_LIMITS = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)
"""Where Linux says how much a container may use: control groups of version 2, and of version 1."""
CONTAINER_USES = (
    (Path("/sys/fs/cgroup/memory.current"), Path("/sys/fs/cgroup/memory.stat")),
    (
        Path("/sys/fs/cgroup/memory/memory.usage_in_bytes"),
        Path("/sys/fs/cgroup/memory/memory.stat"),
    ),
)
"""Likewise, what it uses, and how much of that are files, which make room when it is requested."""
LARGE_PAGE = 2 << 20
"""Bytes of a large page."""
MOUNTS = Path("/proc/mounts")
"""Where Linux says which file system a folder is in."""
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

    It has its share of the machine and the container where torchrun has started several processes.
    None where the system does not tell.
    """
    of_all = [limit for limit in (_machine(), *map(_container, CONTAINER_LIMITS)) if limit]
    limits = [limit // processes_here() for limit in of_all]
    return min((*limits, *filter(None, [_own()])), default=None)


def zero_bytes(n_bytes: int) -> np.ndarray:
    """[n_bytes] uint8 of pages that take no memory until something is written to them."""
    return np.zeros(n_bytes, np.uint8)


def processes_here() -> int:
    """How many processes torchrun has started on this machine; 1 where it has started none."""
    return max(1, int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def available_memory() -> int | None:
    """Bytes of ``usable_memory`` that are free, or taken by files that would make room.

    None where the system does not tell.
    """
    left = [_free(), _own_left(), *map(_container_left, CONTAINER_LIMITS, CONTAINER_USES)]
    known = [max(0, n_bytes) for n_bytes in (*left, usable_memory()) if n_bytes is not None]
    return min(known, default=None)


def lies_in_memory(folder: Path) -> bool:
    """Whether files of a folder take memory instead of room on a disk, as in Linux's tmpfs."""
    try:
        words = [line.split() for line in MOUNTS.read_text().splitlines()]
    except OSError:
        return False
    kinds = {Path(place): kind for _, place, kind, *_ in words}
    folder = folder.resolve()
    mounted = next((path for path in (folder, *folder.parents) if path in kinds), None)
    return mounted is not None and kinds[mounted] in ("tmpfs", "ramfs")


def _free() -> int | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return next(int(line.split()[1]) << 10 for line in lines if "MemAvailable:" in line)
    except (OSError, ValueError, StopIteration):
        return None


def _container_left(limit: Path, uses: tuple[Path, Path]) -> int | None:
    total = _container(limit)
    try:
        used = int(uses[0].read_text())
        words = dict(line.split()[:2] for line in uses[1].read_text().splitlines())
        files = sum(int(words.get(name, 0)) for name in ("inactive_file", "active_file"))
    except (OSError, ValueError):
        return total
    return None if total is None else total - used + files


def _own_left() -> int | None:
    limit = _own()
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (OSError, ValueError):
        return limit
    return None if limit is None else limit - pages * os.sysconf("SC_PAGE_SIZE")


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


def require_threads(threads: int) -> None:
    """Raise InputError unless so many threads can share this machine's cores."""
    require_whole("threads", threads, 1)
    if threads > MOST_PER_CORE * (cores := usable_cores()):
        raise InputError(
            f"threads must be at most {MOST_PER_CORE * cores} on {cores} usable cores, not "
            f"{threads}: they wait for each other awake; use {cores}."
        )


def _share(files: tuple[Path, ...]) -> int | None:
    try:
        quota, period = (int(word) for file in files for word in file.read_text().split())
    except (OSError, ValueError):  # not there, or "max"
        return None
    return None if quota < 0 else quota // period


def prefer_large_pages(address: int, n_bytes: int) -> None:
    """Request huge pages of 2 MB, where the system has such (Linux), for memory not yet written.

    Reading what is scattered over many pages takes less time where they are large: there are fewer
    of them to look up.

    Args:
        address: Where the memory begins.
        n_bytes: Its length.
    """
    advice, page = getattr(mmap, "MADV_HUGEPAGE", None), mmap.PAGESIZE
    begin, end = -(-address // page) * page, (address + n_bytes) // page * page
    if advice is None or end - begin < LARGE_PAGE:
        return
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).madvise(ctypes.c_void_p(begin), ctypes.c_size_t(end - begin), advice)


def release_free_memory() -> None:
    """Return freed memory to the system, where the C library keeps it for itself (glibc)."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
