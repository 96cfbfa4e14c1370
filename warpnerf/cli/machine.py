"""The commands that are about the machine: ``warpnerf check`` and ``warpnerf warmup``."""

from __future__ import annotations

import os
import time
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from warpnerf.checks import InputError, cannot_write
from warpnerf.cli.arguments import Settings
from warpnerf.cli.configured import configured
from warpnerf.config import TrainConfig
from warpnerf.presets import DEFAULT_PRESETS, PRESETS
from warpnerf.runtime.memory import require_threads

if TYPE_CHECKING:
    from warpnerf.training.warmup import CompiledKernel
    from warpnerf.verification.verify import Result

FAILED = 1


def check_command(device: str = "cpu", threads: int | None = None, json: Path | None = None) -> int:
    """Check gradients and determinism on this machine; exit with 1 if a check fails.

    Args:
        device: cpu, cuda, cuda:1, ...
        threads: CPU threads; by default one per usable core.
        json: Also write the results to this file.
    """
    require_writable(json, ("passed", "checks"))
    from warpnerf.runtime.terminal import print_table
    from warpnerf.verification.verify import report, verify

    def shown(result: Result) -> None:
        word = "passed" if result.passed else "FAILED"
        print(f"{word}  {result.name}", flush=True)

    start = time.perf_counter()
    results = verify(device, threads, on_result=shown)
    seconds = time.perf_counter() - start
    print()
    print_table(
        ("check", "error", "tolerance", ""),
        [
            (r.name, f"{r.error:.1e}", f"{r.tolerance:.0e}", "ok" if r.passed else "FAILED")
            for r in results
        ],
        bad=[not r.passed for r in results],
    )
    failed = [result for result in results if not result.passed]
    for result in failed:
        if result.note:
            print(f"{result.name}: {result.note}")
    said = f"{len(failed)} of {len(results)} checks failed" if failed else "all checks passed"
    print(f"{said} on {device} in {seconds:.1f} s", flush=True)
    if json is not None:
        write_json(json, report(results, device, seconds))
    return FAILED if failed else 0


def warmup_command(
    device: str = "cpu",
    model: str | None = None,
    model_options: Settings = (),
    field: str | None = None,
    sampler: str | None = None,
) -> int:
    """Compile all kernels that training and evaluation with fast and quality need.

    Args:
        device: Where they are to run: cpu, cuda, cuda:1, ...
        model: As training will be given: deferred, per_sample, sh, or rgb.
        model_options: As training will be given.
        field: As training will be given: dense, vm, or hash.
        sampler: As training will be given: auto, march, or resampled.
    """
    from warpnerf.training.warmup import warm_up

    def shown(kernel: CompiledKernel) -> None:
        how = f"compiled in {kernel.seconds:.1f} s" if kernel.compiled else "in the cache"
        print(f"{kernel.name}: {how}", flush=True)

    start = time.perf_counter()
    presets = [PRESETS[name] for name in DEFAULT_PRESETS]
    named = {"model": model, "field": field, "sampler": sampler}
    given = {name: (kind,) for name, kind in named.items() if kind is not None}
    configs = [configured(preset, given, model_options) for preset in presets]
    kernels = warm_up(device, shown, configs)
    compiled = sum(kernel.compiled for kernel in kernels)
    seconds = time.perf_counter() - start
    print(
        f"{len(kernels)} kernels are ready, {compiled} of them compiled now, after {seconds:.1f} s"
    )
    return 0


def require_writable(path: Path | None, written: Collection[str], kept: Path | None = None) -> None:
    """Refuse what --json names before anything is computed.

    What is replaced is what this command has written before, and nothing else: not a run, nor a
    scene.

    Args:
        path: What it names; None: nothing.
        written: Names that the objects have which the command writes.
        kept: A file that has them too, and is not replaced.

    Raises:
        InputError: It is a folder, a file in none or in one of others', or of something else.
    """
    if path is None:
        return
    if path.is_dir():
        raise InputError(f"--json {path}: is a folder; name a file.")
    if not path.parent.is_dir():
        raise InputError(f"--json {path}: its folder does not exist; make it first.")
    if not os.access(path.parent if path.is_file() or not path.exists() else path, os.W_OK):
        raise InputError(f"--json {path}: its folder cannot be written to; choose another one.")
    if not path.exists() or path.stat().st_size == 0:
        return
    try:
        content = msgspec.json.decode(path.read_bytes())
    except (msgspec.DecodeError, OSError):
        content = None
    ours = isinstance(content, dict) and set(written) <= content.keys()
    if not ours or (kept is not None and kept.exists() and path.samefile(kept)):
        raise InputError(
            f"--json {path}: is another file, which would be replaced; choose another name."
        )


def write_json(path: Path, text: str) -> None:
    """Write what --json names, whole or not at all.

    Raises:
        InputError: It cannot be written.
    """
    from warpnerf.writing import write_atomically

    try:
        write_atomically(path, text.encode())
    except OSError as error:
        raise cannot_write(f"--json {path}", error) from error


def require_machine(config: TrainConfig) -> None:
    """Refuse a device or threads that this machine has not, before photographs are posed or read.

    Raises:
        InputError: It has not.
    """
    if config.threads is not None:
        require_threads(config.threads)
    if config.device != "cpu":  # else Warp need not be loaded yet
        from warpnerf.runtime.parallel import Workers

        Workers(config.device)
