"""``warpnerf check`` and ``warpnerf warmup`` as people run them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from warpnerf.cli.main import main
from warpnerf.config import TrainConfig
from warpnerf.model.models import Rgb
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.storage_kinds import Hash
from warpnerf.training import warmup
from warpnerf.training.warmup import CompiledKernel
from warpnerf.verification import verify as checks
from warpnerf.verification.verify import Result

WITHOUT_TORCH = """
import sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "torch":
            raise ImportError("torch is not installed")
sys.meta_path.insert(0, Finder())
from warpnerf.cli.main import main
from warpnerf.verification import verify
if FEWER:
    verify.VIEW_DEPENDENT, checks = (), verify._checks
    kept = "differences, plain", "gather", "training twice"
    verify._checks = lambda workers: [
        check for check in checks(workers) if any(words in check[0] for words in kept)
    ]
sys.exit(main(sys.argv[1:]))
"""


@pytest.mark.slow
@pytest.mark.timeout(1000)  # all of it compiles for minutes where the machine is busy
@pytest.mark.parametrize("fewer", [pytest.param(True, id="some"), pytest.param(False, id="all")])
def test_check_needs_neither_torch_nor_the_tests(fewer: bool, tmp_path: Path, on_cpu: None) -> None:
    program = WITHOUT_TORCH.replace("FEWER", str(fewer))
    done = subprocess.run(
        [sys.executable, "-c", program, "check", "--threads", "2", "--json", "c.json"],
        cwd=tmp_path,
        env=os.environ,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    said = json.loads((tmp_path / "c.json").read_text())
    assert said["passed"]
    lines = done.stdout.splitlines()
    names = [check["name"] for check in said["checks"]]
    assert [line for line in lines if line.startswith("passed")] == [f"passed  {n}" for n in names]
    assert all(sum(name in line for line in lines) >= 2 for name in names)  # in the table, too
    assert lines[-1].startswith("all checks passed on cpu in ")


@pytest.mark.parametrize(("error", "code"), [(1e-9, 0), (1e-3, 1), (float("nan"), 1)])
def test_one_failure_is_a_failure(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: float,
    code: int,
) -> None:
    def some(device: str, threads: Any, on_result: Any) -> list[Result]:
        results = [
            Result(name="one", error=0.0, tolerance=0.0),
            Result(name="two", error=error, tolerance=1e-6, note="why" if code else ""),
        ]
        for result in results:
            on_result(result)
        return results

    monkeypatch.setattr(checks, "verify", some)
    assert main(["check"]) == code
    out = capsys.readouterr().out
    assert ("FAILED  two" in out) == ("1 of 2 checks failed" in out) == ("two: why" in out) == code


def test_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ("/", str(tmp_path)):
        assert main(["check", "--json", folder]) == 2
        assert "is a folder; name a file." in capsys.readouterr().err
    assert main(["check", "--json", str(tmp_path / "none" / "c.json")]) == 2
    assert "its folder does not exist" in capsys.readouterr().err
    for command in ("check", "warmup"):
        assert main([command, "--device", "cuda:97"]) == 2
        assert "cuda:97" in capsys.readouterr().err


@pytest.mark.slow  # compiles for two presets
def test_warmup_says_what_it_did(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warmup, "_contractions", lambda config: ("none",))
    assert main(["warmup", "--model", "rgb"]) == 0
    capsys.readouterr()
    assert main(["warmup", "--model", "rgb"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "adam step: in the cache" in lines
    assert "0 of them compiled now" in lines[-1]
    assert not any("compiling" in line for line in lines)


def test_warmup_is_for_what_training_will_be_given(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found: list[TrainConfig] = []

    def warm_up(device: str, shown: Any, configs: list[TrainConfig]) -> list[CompiledKernel]:
        found.extend(configs)
        return []

    monkeypatch.setattr(warmup, "warm_up", warm_up)
    options = ["--model", "rgb", "--field", "hash", "--sampler", "resampled"]
    assert main(["warmup", *options]) == 0
    assert [(c.model, c.field, c.sampler) for c in found] == [(Rgb(), Hash(), Resampled())] * 2
    assert main(["warmup", "--field", "octree"]) == 2
    assert "field must be one of dense, " in capsys.readouterr().err
