"""The command in a process of its own: ended after some minutes, and watched for what it writes.

Starting one takes seconds of processor time: the imports, Warp, and kernels that are read. On
Linux it is therefore a fork of a process that has trained once, with its own streams, folder,
variables and exit code; with a prelude, with variables besides those of this process, and where a
GPU is, which no fork may use, it is a new one.
"""

from __future__ import annotations

import ctypes
import functools
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.support.compiling import one_at_a_time
from tests.support.tiny_scenes import save, write_transforms

LIMIT = 240.0
"""Seconds after which a command counts as hung, on a busy machine that compiles kernels too."""

TINY = ("--steps", "2", "--threads", "1", "--voxels", "512")
"""Options of a training that ends at once."""

Change = Callable[[dict[str, Any]], object]


def make_scene(folder: Path, change: Change | None = None) -> Path:
    """Four images of 16 x 12 pixels around the origin; the first is the test view.

    ``change`` is given the content of transforms.json, to change it in place.
    """
    content = write_transforms(folder / "scene", 4, scale=2)
    if change is not None:
        change(content)
        save(folder / "scene" / "transforms.json", content)
    return folder / "scene"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What a command did."""

    code: int
    out: str
    err: str
    run: Path
    """The folder that it was told to write to."""


class Server:
    """Forks commands; one for each process of the tests, from the first command on."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="commands-")
        here = Path(self._folder.name)
        self._out, self._err = here / "out", here / "err"
        self._process = subprocess.Popen(
            [sys.executable, "-P", Path(__file__).with_name("command_server.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "TMPDIR": self._folder.name},  # what it compiles with stays there
        )
        scene = make_scene(here)
        assert self._ask(arguments=["train", str(scene), "--output", str(here / "run"), *TINY]) == 0

    def _ask(self, **request: Any) -> int | None:
        assert self._process.stdin is not None and self._process.stdout is not None
        print(json.dumps(request), file=self._process.stdin, flush=True)
        code: int | None = json.loads(self._process.stdout.readline())["code"]
        return code

    def run(
        self, arguments: list[str], cwd: Path, env: Mapping[str, str], limit: float | None
    ) -> subprocess.CompletedProcess[str]:
        files = {"out": str(self._out), "err": str(self._err)}
        given = {"cwd": str(cwd), "env": dict(env), "limit": limit}
        code = self._ask(arguments=arguments, **files, **given)
        if code is None:
            raise subprocess.TimeoutExpired(arguments, limit or 0.0)
        out, err = self._out.read_text(), self._err.read_text()
        return subprocess.CompletedProcess(arguments, code, out, err)

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()
        self._folder.cleanup()


@functools.cache
def _can_fork() -> bool:
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return sys.platform == "linux"
    return False


_server: Server | None = None


def close_server() -> None:
    """Let the process that forks commands end, where there is one."""
    global _server
    if _server is not None:
        _server.close()
    _server = None


def run(
    *arguments: str | Path,
    cwd: Path | None = None,
    env: Mapping[str, str] | None = None,
    limit: float | None = LIMIT,
    prelude: str = "",
) -> subprocess.CompletedProcess[str]:
    """Run the command.

    Args:
        arguments: Of the command.
        cwd: Where to run it; None: where this process is.
        env: All of its variables; None: those of this process.
        limit: Seconds; None: as long as it takes.
        prelude: Python that is run first, in a new process.
    """
    global _server
    words = [str(word) for word in arguments]
    if not prelude and env is None and _can_fork():
        if _server is None:
            with one_at_a_time("commands"):  # the first compiles
                _server = Server()
        return _server.run(words, cwd or Path.cwd(), os.environ, limit)
    program = ["-m", "warpnerf"]
    if prelude:
        program = [
            "-c",
            f"{prelude}\nimport sys, warpnerf.cli.main\nsys.exit(warpnerf.cli.main.main())",
        ]
    return subprocess.run(
        [sys.executable, *program, *words],
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=limit,
    )


def command(
    *arguments: str | Path,
    folder: Path,
    env: Mapping[str, str] | None = None,
    limit: float | None = LIMIT,
    prelude: str = "",
) -> Outcome:
    """Run the command in a folder, in which nothing may change but its subfolder "run".

    Temporary files go there too, so that what is left of them shows.

    Args:
        arguments: Of the command.
        folder: Where to run it.
        env: Variables besides those of this process.
        limit: Seconds; None: as long as it takes.
        prelude: Python that is run first, in the command's process.
    """
    (folder / "tmp").mkdir(exist_ok=True)
    found = _listing(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TMPDIR", str(folder / "tmp"))
        variables = None if env is None else {**os.environ, **env}
        done = run(*arguments, cwd=folder, env=variables, limit=limit, prelude=prelude)
    assert _listing(folder) == found, "wrote outside its output folder"
    return Outcome(code=done.returncode, out=done.stdout, err=done.stderr, run=folder / "run")


def train(scene: str | Path, *options: str | Path, folder: Path, **how: Any) -> Outcome:
    """Train two steps of a tiny grid into the folder "run"."""
    return command(
        "train", scene, "--output", folder / "run", *TINY, *options, folder=folder, **how
    )


def assert_refused(outcome: Outcome, *says: str) -> None:
    """One sentence with all these words, exit code 2, and nothing left behind."""
    said = outcome.out + outcome.err
    assert outcome.code == 2, said
    sentence = _own_lines(outcome.err)
    assert len(sentence) == 1, said
    assert sentence[0].startswith("warpnerf: error: ") and sentence[0].endswith("."), said
    for words in says:
        assert words in sentence[0]
    assert len(sentence[0]) < 600
    assert "Traceback" not in said
    assert not os.path.lexists(outcome.run)


def assert_trained(outcome: Outcome, *warnings: str) -> None:
    """A whole run, with a line of warning for each of these words and no other."""
    said = outcome.out + outcome.err
    assert outcome.code == 0, said
    assert not _own_lines(outcome.err), _own_lines(outcome.err)
    assert (outcome.run / "metrics.json").is_file()
    assert len(list((outcome.run / "test").glob("*.png"))) == 1
    lines = [line for line in outcome.out.splitlines() if "warning" in line]
    assert len(lines) == len(warnings), said
    for words in warnings:
        assert any(words in line for line in lines), said


def _own_lines(err: str) -> list[str]:
    """Without the line that Warp's library writes where there is no CUDA driver."""
    return [line for line in err.splitlines() if not line.startswith("Warp CUDA warning")]


def _listing(folder: Path) -> dict[str, tuple[int, int]]:
    """All that is in a folder but the run: type and permissions, and time of the last change."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_relative_to(folder / "run"):
            continue
        status = path.lstat()
        found[str(path)] = (status.st_mode, 0 if path.is_dir() else status.st_mtime_ns)
    return found
