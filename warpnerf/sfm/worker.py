"""The process in which COLMAP works: started, listened to, and ended with this one."""

from __future__ import annotations

import importlib.util
import json
import os
import queue
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, TextIO

from warpnerf.checks import require_extra
from warpnerf.scenes.files import printable

COUNTED = {"features": "descriptors", "matches": "two_view_geometries"}
"""Stages in which COLMAP does not say how far it is, and the tables that it fills."""

POLL = 0.3
"""Seconds from one look at these to the next."""


def estimate(job: dict[str, Any], on_report: Callable[[str, int, int], None]) -> dict[str, Any]:
    """Run ``sfm.mapping`` on a job in a process of its own.

    Whatever ends this function, an interrupt too, ends the process.

    Args:
        job: What ``mapping.run`` takes.
        on_report: Called with a stage's name, what is done of it, and of how much.

    Returns:
        What ``mapping.run`` returns.

    Raises:
        ChildProcessError: The process failed, or was ended.
    """
    with tempfile.TemporaryFile("w+", encoding="utf-8", errors="replace") as words:
        process = subprocess.Popen(
            [sys.executable, "-m", "warpnerf.sfm.mapping"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=words,
            text=True,
            encoding="utf-8",
            env=os.environ | {"PYTHONPATH": _path()},
            start_new_session=True,  # Ctrl-C in a terminal is for this process to handle
        )
        assert process.stdin is not None and process.stdout is not None
        lines: queue.Queue[str] = queue.Queue()
        listener = threading.Thread(target=_listen, args=(process.stdout, lines), daemon=True)
        listener.start()
        try:
            with suppress(BrokenPipeError):  # it has ended already
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()
            stage, done, of = "", 0, 0
            while True:
                try:
                    line = lines.get(timeout=POLL)
                except queue.Empty:
                    if stage in COUNTED:
                        done = min(max(done, _rows(job, COUNTED[stage])), of)
                        on_report(stage, done, of)
                    continue
                if not line:
                    break
                content = json.loads(line)
                if "result" in content:
                    return dict(content["result"])
                stage, done, of = content["stage"], content["done"], content["of"]
                on_report(stage, done, of)
            process.wait()
        finally:
            process.kill()
            process.wait()
            listener.join()
            process.stdout.close()
            with suppress(BrokenPipeError):
                process.stdin.close()
        words.seek(0)
        last = [line for line in words.read().splitlines() if line.strip()][-1:]
        raise ChildProcessError(_why(process.returncode, last))


def _why(code: int, last: list[str]) -> str:
    """Why COLMAP ended before it was done: a sentence, of its exit code and its last words."""
    if code < 0:
        return (
            f"COLMAP was ended by signal {-code}, as where memory runs out; use a smaller "
            "--max-image-size, or fewer photographs."
        )
    said = "".join(f": {printable(line[:300])}" for line in last)
    return f"COLMAP failed{said}; use other photographs, or another --mapper."


def _listen(stream: TextIO, lines: queue.Queue[str]) -> None:
    """Put each line into a queue, and at the end of the stream an empty one."""
    for line in stream:
        lines.put(line)
    lines.put("")


def _rows(job: dict[str, Any], table: str) -> int:
    """Rows of a table of COLMAP's database so far; 0 where that cannot be found out just now.

    Not for the process that has COLMAP itself: two copies of SQLite in one process undo each
    other's locks.
    """
    database = Path(job["work"]) / "database.db"
    try:
        with closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as opened:
            return int(opened.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        return 0


def is_installed() -> bool:
    """Whether pycolmap is there."""
    return importlib.util.find_spec("pycolmap") is not None


def require_pycolmap() -> None:
    """Raise InputError where pycolmap is not there.

    Raises:
        InputError: It is not installed.
    """
    require_extra("pycolmap", "sfm", "estimating poses")


def _path() -> str:
    """PYTHONPATH with this package's own place, wherever it was imported from."""
    place = str(Path(__file__).parents[2])
    return os.pathsep.join([place, *filter(None, [os.environ.get("PYTHONPATH")])])
