"""Compiled kernels on disk: where Warp keeps them, and what if it cannot or they are damaged.

Warp compiles a kernel once and reads it from its cache ever after. It does not check what it reads,
and a flipped bit in machine code ends in a crash or in wrong numbers; so a file SHA256SUMS lies
beside each compiled module here, in the format of the tool ``sha256sum``. A cache that cannot be
written, made, or believed is left by the command for a temporary one, once in a process and with a
warning. In a process that is not its own (``runtime.process``) an error says so, and Warp stays as
it is.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import hashlib
import logging
import os
import shutil
import sys
import tempfile
import threading
import warnings
import weakref
from collections.abc import Iterator
from pathlib import Path

import warp as wp

from warpnerf.checks import InputError
from warpnerf.runtime import process

SUMS = "SHA256SUMS"
COMPILED = (".o", ".cubin", ".ptx", ".meta")
CUDA_BLOCK = 64
"""Threads of a block on CUDA. A batch has few rays, and small blocks spread them over the GPU."""
ROOM = 16 << 20
"""Bytes that are free where a kernel is compiled: several times what the largest leaves there."""
NO_DRIVER = b"Could not find or load the NVIDIA CUDA driver"
"""In the line that Warp prints where there is no GPU. Who requests one is told in a sentence."""

WAY_OUT = (
    "make the cache writable, delete what is damaged in it, or set WARP_CACHE_PATH to another "
    "folder"
)

_log = logging.getLogger("warpnerf")
_changing = threading.Lock()
"""Held for a moment by who changes what is noted here."""
_loading: weakref.WeakKeyDictionary[wp.Module, threading.Lock] = weakref.WeakKeyDictionary()
"""Warp would load a module twice where two threads request it, and free the code of one of them.
Different modules are compiled, and loaded, by several threads at once."""
_temporary: Path | None = None
_said = False
_started = False


def _unlock() -> None:
    """Nobody loads in a process that was just forked, whoever did in the one that it comes from."""
    global _changing
    _changing = threading.Lock()
    _loading.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unlock)


class DamagedKernelError(Exception):
    """A compiled kernel is not what was written."""


def start() -> None:
    """Start Warp: for the command without a banner.

    Raises:
        InputError: Its cache cannot be made, nor for the command a temporary folder.
    """
    global _started
    if _started:
        return
    if process.is_own():
        wp.config.log_level = wp.LOG_ERROR
    with _without_lines(NO_DRIVER) if process.is_own() else contextlib.nullcontext():
        try:
            wp.init()
        except OSError as error:
            _leave_cache(error)
            wp.init()
    _started = True


@contextlib.contextmanager
def _without_lines(unwanted: bytes) -> Iterator[None]:
    """Leave lines out of what is written to standard error meanwhile, by C code as well."""
    try:
        sys.stderr.flush()
        kept = os.dup(2)
    except (OSError, AttributeError, ValueError):  # there is none
        yield
        return
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            for line in file:
                if unwanted not in line:
                    os.write(2, line)


def load(kernel: wp.Kernel, device: wp.Device) -> None:
    """Compile a kernel's module for a device, or fetch it from the cache. Any thread may ask.

    Raises:
        InputError: The cache cannot be used, nor for the command a temporary folder be made.
    """
    module = kernel.module
    with _changing:
        loading = _loading.setdefault(module, threading.Lock())
    with loading:
        cache = wp.config.kernel_cache_dir
        try:
            _load(module, device)
        except Exception as error:  # whatever came of it: Warp raises plain exceptions
            if type(error).__name__.startswith("WarpCodegen"):  # the kernel is wrong
                raise
            module.unload()  # forgets that it failed
            with _changing:
                if wp.config.kernel_cache_dir == cache:  # else another thread has left it
                    _leave_after(error)
            try:
                _load(module, device)
            except OSError as again:
                raise _nowhere(cache, error, again) from None


def _leave_after(error: Exception) -> None:
    """Leave the cache where it may be to blame; raise the error where it is not."""
    told = isinstance(error, OSError | DamagedKernelError)
    if _temporary is not None or not (told or process.is_own()):
        raise error
    _leave_cache(error)


def _load(module: wp.Module, device: wp.Device) -> None:
    block_dim = threads_of_a_block(device)
    folder = Path(wp.config.kernel_cache_dir) / module.get_module_identifier(block_dim)
    _verify(folder)
    if not _is_compiled(folder, device):
        _require_room(folder.parent)
        _say_once()
    module.load(device, block_dim=block_dim)
    _seal(folder)


def _require_room(cache: Path) -> None:
    """Raise OSError on a full disk: the compiler would end the process."""
    if not cache.is_dir():
        return
    disk = shutil.disk_usage(cache)
    if disk.total and disk.free < ROOM:  # some network's disks know neither
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(cache))


def threads_of_a_block(device: wp.Device) -> int:
    """What a module is compiled for, and its kernels are launched with."""
    return CUDA_BLOCK if device.is_cuda else 1


def is_compiled(kernel: wp.Kernel, device: wp.Device) -> bool:
    """Whether a kernel's module is in the cache for a device, as far as names of files tell."""
    name = kernel.module.get_module_identifier(threads_of_a_block(device))
    return _is_compiled(Path(wp.config.kernel_cache_dir) / name, device)


def _is_compiled(folder: Path, device: wp.Device) -> bool:
    pattern = f"*.sm{device.arch}*.*" if device.is_cuda else "*.o"
    return any(path.suffix in COMPILED for path in folder.glob(pattern))


def _say_once() -> None:
    """Say what takes so long, once in a process."""
    global _said
    with _changing:
        said, _said = _said, True
    if not said:
        _log.info("compiling kernels (once; later runs start at once)")


def _leave_cache(error: Exception) -> None:
    """Use a temporary folder from now on, which is removed when the process ends.

    Raises:
        InputError: The process is not the command's own, or no such folder can be made.
    """
    global _temporary
    cache = wp.config.kernel_cache_dir
    if not process.is_own():
        raise InputError(
            f"the cache of compiled kernels {cache} cannot be used ({error}); {WAY_OUT}."
        ) from error
    try:
        _temporary = Path(tempfile.mkdtemp(prefix="warpnerf-kernels-"))
    except OSError as again:
        raise _nowhere(cache, error, again) from None
    atexit.register(shutil.rmtree, _temporary, ignore_errors=True)
    wp.config.kernel_cache_dir = str(_temporary)
    warnings.warn(
        f"the cache of compiled kernels {cache} cannot be used ({error}), so kernels are compiled "
        f"into a temporary folder, for this time only; {WAY_OUT}",
        RuntimeWarning,
        stacklevel=2,
    )


def _nowhere(cache: str, error: Exception, again: OSError) -> InputError:
    return InputError(
        f"kernels cannot be compiled: the cache {cache} cannot be used ({error}), nor a temporary "
        f"folder ({again}); set WARP_CACHE_PATH to a folder that can be written."
    )


def _verify(folder: Path) -> None:
    """Raise DamagedKernelError where a file is not as it was when it was sealed."""
    try:
        sums = (folder / SUMS).read_text()
    except FileNotFoundError:  # not compiled yet, or by another program
        return
    except (OSError, ValueError) as error:
        raise DamagedKernelError(f"{SUMS} in {folder.name} cannot be read") from error
    now = _sums(folder)
    for line in sums.splitlines():
        digest, _, name = line.partition("  ")
        if (folder / name).exists() and now.get(name) != digest:
            raise DamagedKernelError(f"{folder.name} in it is damaged")


def _seal(folder: Path) -> None:
    """Note the checksums of what is there, if it is there and can be written to."""
    new = folder / f"{SUMS}.{os.getpid()}.{threading.get_ident()}"
    try:
        text = "".join(f"{digest}  {name}\n" for name, digest in _sums(folder).items())
        if not (folder / SUMS).exists() or (folder / SUMS).read_text() != text:
            new.write_text(text)
            new.replace(folder / SUMS)
    except OSError:
        with contextlib.suppress(OSError):  # a read-only file system refuses even that
            new.unlink(missing_ok=True)


def _sums(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
        if path.suffix in COMPILED
    }
