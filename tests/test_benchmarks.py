"""The benchmarks run, check their two sides against each other, and write complete records."""

import json
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent


def run(script, output, *options):
    command = [sys.executable, str(ROOT / "benchmarks" / script), "--output", str(output)]
    # In the folder that holds both packages, whether they are installed or not.
    code = "import runpy, sys; sys.path[:0] = sys.argv.pop(1).split(':'); sys.argv = sys.argv[1:]; "
    code += "runpy.run_path(sys.argv[0], run_name='__main__')"
    path = f"{ROOT / 'benchmarks'}:{ROOT}:{ROOT / 'kernels'}"
    done = subprocess.run(
        [sys.executable, "-c", code, path, *command[1:], *options],
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    record = json.loads(output.read_text())
    assert str(output) in done.stdout
    for field in ("cpu", "cores", "threads", "device", "python", "warp", "torch", "date"):
        assert record["machine"][field]
    assert script in record["machine"]["command"]
    return record


def test_gradient_scaling(tmp_path):
    options = ("--pairs", "2", "--repeats", "1", "--grid", "8")
    record = run("gradient_scaling.py", tmp_path / "record.json", *options)
    assert record["n_samples"] == 300_000
    assert record["grid"] == 8
    assert [result["name"] for result in record["results"]] == [
        "render_backward",
        "render_train",
        "control",
        "torch backward",
        "operation alone",
    ]
    for result in record["results"]:
        assert result["pairs"] == 2
        assert result["with_us"] > 0 and result["backward_us"] > 0
        difference, share = result["difference_us"], result["share_of_backward"]
        assert difference["low"] <= difference["median"] <= difference["high"]
        assert abs(share["median"] * result["backward_us"] - difference["median"]) < 1e-6
    assert "instructions_per_sample" in record


def test_throughput(tmp_path):
    options = ("--grids", "8", "--rays", "64", "--steps", "16", "--rounds", "2")
    record = run("throughput.py", tmp_path / "record.json", "--threads", "1", "2", *options)
    assert len(record["cases"]) == 4
    for case in record["cases"]:
        assert case["rounds"] == 2
        assert 0 < case["n_samples"] <= 64 * 16
        assert [choice["threads"] for choice in case["torch_choices"]] == [1, 2][: case["threads"]]
        assert all(max(d.values()) < 1e-4 for d in case["differences"])
        for field in ("warpnerf_ms", "warpnerf_zeroing_ms", "torch_ms", "ratio"):
            low, middle, high = case[field]
            assert 0 < low <= middle <= high
    rows = record["memory"]
    assert [row["n_samples"] for row in rows] == [64 * 8, 64 * 16, 64 * 32]
    assert len({row["warpnerf_bytes"] for row in rows}) == 1
    assert rows[0]["torch_bytes"] < rows[1]["torch_bytes"] < rows[2]["torch_bytes"]
