"""Saves of runs that fail: at each system call the disk is full, or the process is killed."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.support.tiny_fields import assert_same_state, tiny_state
from tests.training.test_determinism import small_scene
from warpnerf.config import TrainConfig
from warpnerf.runs.run import Run

CALLS = ("open", "write", "fsync", "close", "replace", "unlink", "mkdir", "rmdir")
"""The system calls, by their names in ``os``, that a save may make."""

KILLED = 9

state_of = cache(tiny_state)


class Faults:
    """Counts the system calls of a save, and lets one of them go wrong."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act: Callable[[str], None]) -> None:
        self.calls: list[str] = []
        self.at: int | None = None
        self.written = b""
        self._act = act
        for name in CALLS:
            monkeypatch.setattr(os, name, self._counted(name, getattr(os, name)))

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            self.calls.append(name)
            if len(self.calls) == self.at:
                if name == "write":  # fails half way
                    real(arguments[0], arguments[1][: len(arguments[1]) // 2])
                self._act(name)
            result = real(*arguments, **options)
            if name == "write":
                self.written += bytes(arguments[1][:result])
            return result

        return call


def disk_full(name: str) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def killed(name: str) -> None:
    os._exit(KILLED)


def new_run(folder: Path) -> Run:
    run = Run(folder)
    run.create(small_scene(), "builtin:room", 1, 2.0, TrainConfig())
    return run


def run_with(folder: Path, *steps: int) -> Run:
    """A run that has saved these steps."""
    run = new_run(folder)
    for step in steps:
        run.save_checkpoint(state_of(step))
    return run


def temporary(folder: Path) -> list[Path]:
    return list(folder.rglob(".*"))


def calls_of(act: Callable[[], Any]) -> list[str]:
    """The system calls that something makes when all goes well."""
    with pytest.MonkeyPatch.context() as patch:
        faults = Faults(patch, disk_full)
        act()
    return faults.calls


def in_child(act: Callable[[], Any]) -> int:
    """Run something in a process of its own; its exit status."""
    child = os.fork()
    if child == 0:
        try:
            act()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def require_old_or_new(folder: Path, old: int, new: int) -> None:
    """What can be read, to resume from and to render, is one of two steps, whole."""
    state, notes = Run(folder).load_state()
    assert state.progress.step in (old, new)
    assert notes == []
    assert_same_state(state, state_of(state.progress.step))
    field, _ = Run(folder).load_field("cpu", 1)
    expected = state_of(state.progress.step).field.storage.values.numpy()
    assert (field.storage.values.numpy() == expected).all()
