"""Runs a case in a fork of this process, and judges how it ended."""

from __future__ import annotations

import fcntl
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.command_server import code_of, redirect
from warpnerf.checks import InputError

LIMIT = 60.0
"""Seconds after which a case hangs."""

LONGEST = 1500
"""Characters of a refusal; paths in it may be long."""


@dataclass(kw_only=True)
class Case:
    """One hostile input."""

    words: list[str] = field(default_factory=list)
    """Of the command; empty where ``call`` is."""
    call: Callable[[], object] | None = None
    """Python, instead of the command."""
    said: str = ""
    """What is tried, in words."""
    written: tuple[str, ...] = ("out", "out.json", "out.png")
    """Names in the case's folder to which it may write."""
    env: dict[str, str] = field(default_factory=dict)
    limits: dict[int, int] = field(default_factory=dict)
    """Of the process, by ``resource``'s numbers; under these the system may refuse, too: exit code
    1."""

    def __str__(self) -> str:
        """For a report."""
        words = " ".join(repr(w) if len(w) < 80 else f"{w[:60]!r}..({len(w)})" for w in self.words)
        more = [f"{k}={v}" for k, v in self.env.items()] + [f"limits {self.limits}"] * bool(
            self.limits
        )
        return " ".join(filter(None, (*more, words, self.said)))


def _listing(folder: Path, written: tuple[str, ...]) -> dict[str, tuple[int, int, int]]:
    """All in a folder but what may be written: permissions, size, time of the last change."""
    found = {}
    skip = {folder / name for name in written} | {folder / "tmp"}
    for path in sorted(folder.rglob("*")):
        if not any(path == place or place in path.parents for place in skip):
            status = path.lstat()
            is_folder = path.is_dir() and not path.is_symlink()
            time_of = 0 if is_folder else status.st_mtime_ns
            found[str(path)] = (status.st_mode, 0 if is_folder else status.st_size, time_of)
    return found


def outcome(case: Case, folder: Path, limit: float = LIMIT) -> str | None:
    """Run a case in its folder.

    Args:
        case: What to run.
        folder: Where; what lies in it may not change, but for what the case may write.
        limit: Seconds.

    Returns:
        What is wrong with how it ended; None: nothing.
    """
    (folder / "tmp").mkdir(exist_ok=True)
    before = _listing(folder, case.written)
    pipes = [os.pipe(), os.pipe()]  # a limit of files' sizes is none of theirs
    for end, _ in pipes:
        fcntl.fcntl(end, fcntl.F_SETPIPE_SZ, 1 << 20)
        os.set_blocking(end, False)
    sys.stdout.flush()
    sys.stderr.flush()
    begin = time.monotonic()
    child = os.fork()
    if not child:
        _in_child(case, folder, *(f"/proc/self/fd/{write}" for _, write in pipes))
    code = code_of(child, limit)
    seconds = time.monotonic() - begin
    told = []
    for end, write in pipes:
        os.close(write)
        with os.fdopen(end, errors="replace") as stream:
            told.append(stream.read())
    after = _listing(folder, case.written)
    if code is None:
        return f"hangs: not ended after {seconds:.0f} s"
    if after != before:
        changed = sorted({*before.items()} ^ {*after.items()})
        return f"changed outside of its output: {changed[0][0]}"
    return judged(code, *told, codes=(1, 2) if case.limits else (2,))


def judged(code: int, out: str, err: str, codes: tuple[int, ...] = (2,)) -> str | None:
    """What is wrong with how a command ended; None: nothing."""
    if "Traceback" in out + err:
        return f"traceback: {_last(err) or _last(out)}"
    if code == 0:
        return None
    lines = [line for line in err.splitlines() if not line.startswith("Warp CUDA warning")]
    if code not in codes:
        return f"exit code {code}: {_last(err) or _last(out)}"
    refusals = [line for line in lines if not line.startswith("warpnerf: warning: ")]
    if len(refusals) != 1:
        return f"{len(refusals)} lines for a sentence: {err[:300]!r}"
    (sentence,) = refusals
    ends = sentence.endswith((".", "`")) or " with: warpnerf train --resume " in sentence
    if not sentence.startswith("warpnerf: error: ") or not ends:
        return f"no sentence: {sentence[:300]!r}"
    if len(sentence) > LONGEST or not sentence.isprintable():
        return f"{len(sentence)} characters, or such as steer a terminal: {sentence[:120]!r}"
    if " object at 0x" in sentence or sentence.endswith(("..", ".,.")):
        return f"no sentence for people: {sentence[:300]!r}"
    return None


def _last(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    frames = [line.strip() for line in lines if line.lstrip().startswith('File "')]
    where = next((f for f in reversed(frames) if "/warpnerf/" in f), "")
    return f"{lines[-1][:200]} [{where[-90:]}]" if lines else ""


def _in_child(case: Case, folder: Path, out: str, err: str) -> None:
    """Run a case; ends this process."""
    code = 70
    try:
        os.chdir(folder)
        os.environ.update(case.env)
        os.environ["TMPDIR"] = str(folder / "tmp")
        tempfile.tempdir = None
        redirect(out, err)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        for what, most in case.limits.items():
            resource.setrlimit(what, (most, resource.getrlimit(what)[1]))
        code = _called(case.call) if case.call is not None else _commanded(case.words)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 70
    except BaseException:
        traceback.print_exc()
    finally:
        try:
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            os._exit(code)


def _commanded(words: list[str]) -> int:
    from warpnerf.cli.start import start

    sys.argv = ["warpnerf", *words]
    return start()


def _called(call: Callable[[], object]) -> int:
    """As the command has it: 2 after an InputError, whose sentence is printed."""
    try:
        call()
    except InputError as error:
        print(f"warpnerf: error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if error.filename is None:
            raise
        return 0  # the system's word on a path that was given
    return 0


def fresh(folder: Path, *bases: Path) -> Path:
    """A folder for a case, with copies of what it begins with."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for base in bases:
        shutil.copytree(base, folder / base.name, symlinks=True)
    return folder
