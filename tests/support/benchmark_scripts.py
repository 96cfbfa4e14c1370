"""Scripts of benchmarks/, run as anybody runs them."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def run(script, output, *options):
    command = [sys.executable, str(ROOT / "benchmarks" / script), "--output", str(output)]
    # The packages beside the benchmarks, whether any are installed or not.
    path = os.pathsep.join([str(ROOT), str(ROOT / "kernels")])
    done = subprocess.run(
        [*command, *options],
        capture_output=True,
        text=True,
        timeout=240,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    record = json.loads(output.read_text())
    assert str(output) in done.stdout
    for field in ("cpu", "cores", "threads", "device", "python", "warp", "torch", "date"):
        assert record["machine"][field]
    assert script in record["machine"]["command"]
    return record, done.stdout


def is_interval(figures):
    return 0 < figures["low"] <= figures["median"] <= figures["high"]
