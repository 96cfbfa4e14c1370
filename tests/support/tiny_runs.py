"""Tiny trainings by the command, and what they print."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.support import cli_process

TINY = ("builtin:room-sparse", "--downscale", "8", "--threads", "1")


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "warpnerf", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(*arguments: str | Path) -> tuple[int, str, str]:
    done = cli_process.run(*arguments)
    return done.returncode, done.stdout, done.stderr
