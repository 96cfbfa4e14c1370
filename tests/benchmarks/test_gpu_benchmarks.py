"""What is prepared for a GPU runs without one as far as it can."""

import json
import sys
import time

import pytest

from tests.support.benchmark_scripts import ROOT

sys.path.insert(0, str(ROOT / "benchmarks"))

import cuda_compiling
import on_gpu


def job(name: str, code: str, seconds: float = 60.0) -> on_gpu.Job:
    return on_gpu.Job(name, [sys.executable, "-c", code], seconds)


def test_jobs_run_one_after_another_and_failures_stop_none(tmp_path, capsys):
    wanted = [
        job("first", "print('figures')"),
        job("failing", "raise SystemExit(3)"),
        job("slow", "import time; time.sleep(60)", seconds=0.1),
        job("last", "import os; print(os.environ['WARP_CACHE_PATH'])"),
    ]
    on_gpu.run_all(wanted, tmp_path, time.perf_counter() + 60.0)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [one["exit_code"] for one in summary.values()] == [0, 3, on_gpu.TIMED_OUT, 0]
    assert (tmp_path / "first.txt").read_text() == "figures\n"
    assert (tmp_path / "last.txt").read_text() == f"{tmp_path / 'kernels'}\n"
    capsys.readouterr()
    on_gpu.run_all(wanted, tmp_path, time.perf_counter() + 60.0)
    again = [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()]
    assert again == ["failing", "slow"]


def test_nothing_begins_once_time_is_up(tmp_path):
    on_gpu.run_all([job("late", "print()")], tmp_path, time.perf_counter())
    assert not (tmp_path / "late.txt").exists()


def test_scripts_and_options_of_jobs_exist(tmp_path):
    for one in on_gpu.jobs("lego", "cuda:0", tmp_path):
        script = one.command[1]
        assert script == "-m" or (ROOT / "benchmarks" / script).exists()
        assert "cuda:0" in one.command and one.seconds > 0


@pytest.mark.parametrize("kind", ["object", "bounded", "unbounded"])
@pytest.mark.parametrize("preset", ["fast", "quality"])
def test_kernels_are_those_of_cuda(preset, kind):
    names = {kernel.key.rpartition("__")[2] for kernel in cuda_compiling.kernels(preset, kind)}
    assert {"render_train", "render_forward", "sample_pixels", "camera_rays"} <= names
    assert ("propose_forward" in names) == (kind == "unbounded")
