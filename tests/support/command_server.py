"""Runs the command in forks of a process that has run it once before; see ``cli_process``.

Each request is a line of JSON on standard input, each answer one on standard output.
"""

from __future__ import annotations

import gc
import json
import os
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

sys.path.insert(0, os.fspath(Path(__file__).parents[2]))

from tests.support.compiling import compile_as_tests_do
from warpnerf.cli.main import main
from warpnerf.cli.start import start


def redirect(out: str, err: str) -> None:
    """Let the standard streams of this process be files, and nothing that can be read."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC
    for number, path in ((0, os.devnull), (1, out), (2, err)):
        file = os.open(path, flags if number else os.O_RDONLY)
        os.dup2(file, number)
        os.close(file)
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", errors="backslashreplace", buffering=1, closefd=False)


def code_of(child: int, limit: float | None) -> int | None:
    """How a child ended, as subprocess says it; None: it was ended after ``limit`` seconds."""
    end = None if limit is None else time.monotonic() + limit
    while True:
        found, status = os.waitpid(child, os.WNOHANG if end is not None else 0)
        if found:
            return os.waitstatus_to_exitcode(status)
        if end is not None and time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return None
        time.sleep(0.005)


def keep_precompiled_headers() -> None:
    """In a child, which may read its parent's, but is not to remove them when it ends."""
    if "warp" not in sys.modules:
        return
    try:
        for folder in sys.modules["warp._src.context"].runtime._pch_dirs.values():
            folder._finalizer.detach()
    except (AttributeError, KeyError):  # another version of Warp: the child does without
        sys.modules["warp"].config.use_precompiled_headers = False


def serve() -> int:
    """Answer requests until there are no more; in a child, its exit code."""
    requests, answers = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    redirect(os.devnull, os.devnull)
    first: dict[str, Any] = json.loads(requests.readline())
    code: int | None = main(first["arguments"])  # what it loads and compiles, children have
    print(json.dumps({"code": code}), file=answers, flush=True)
    gc.freeze()  # else each child, when it ends, takes a second to go through all that is there
    for line in requests:
        asked = json.loads(line)
        child = os.fork()
        if not child:
            requests.close()
            answers.close()
            os.environ.clear()
            os.environ.update(asked["env"])
            os.chdir(asked["cwd"])
            tempfile.tempdir = None  # is asked of the variables again
            keep_precompiled_headers()
            redirect(asked["out"], asked["err"])
            sys.argv = ["warpnerf", *asked["arguments"]]
            return start()
        print(json.dumps({"code": code_of(child, asked["limit"])}), file=answers, flush=True)
    return 0


if __name__ == "__main__":
    compile_as_tests_do()
    sys.exit(serve())
