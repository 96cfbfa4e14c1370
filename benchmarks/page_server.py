"""The page of `warpnerf view`, as the command serves it."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def served(run: Path, device: str) -> Iterator[int]:
    """The port at which the command serves a run."""
    command = [sys.executable, "-m", "warpnerf", "view", str(run), "--port", "0"]
    process = subprocess.Popen(
        [*command, "--device", device], stdout=subprocess.PIPE, text=True, env=os.environ
    )
    try:
        assert process.stdout is not None
        address = next(line for line in process.stdout if line.startswith("look at"))
        yield int(address.split(";")[0].rpartition(":")[2])
    finally:
        process.terminate()
        process.wait()
