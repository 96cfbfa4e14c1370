"""`warpnerf runs`: what is listed of each run, and what --clean removes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_trainings import ball
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.runs.config import describe
from warpnerf.runs.listing import in_words, remove_checkpoints, runs_in, runs_table
from warpnerf.runs.lock import only_writer


def made(folder: Path, config: wn.TrainConfig, *, fraction: float, psnr: float | None) -> Path:
    """A run's folder, its tensors replaced by a few bytes."""
    folder.mkdir(parents=True)
    content = describe(ball(), "builtin:room", 1, 2.0, config, None, False)
    (folder / "config.json").write_text(json.dumps(content))
    reports = [{"step": 50, "fraction": 0.1}, {"step": 70, "fraction": fraction, "seconds": 125.0}]
    lines = [*map(json.dumps, reports), '{"step": 80, "fra']
    (folder / "log.jsonl").write_text("\n".join(lines))
    (folder / "checkpoint-00000070.safetensors").write_bytes(bytes(3_000_000))
    if fraction == 1.0:
        (folder / "field.safetensors").write_bytes(bytes(1_000_000))
    if psnr is not None:
        metrics = {"mean": {"psnr": psnr, "ssim": 0.9}}
        (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    fast = wn.PRESETS["fast"]
    made(tmp_path / "a", fast, fraction=1.0, psnr=31.416)
    made(tmp_path / "deep" / "b", replace(fast, seed=3), fraction=0.25, psnr=None)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text("{}")
    return tmp_path


def test_the_table(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["runs", str(folder)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["run", "scene", "steps", "done", "time", "PSNR", "SSIM", "disk", "configuration"],
        ["a", "builtin:room", "70", "100%", "2:05", "31.42", "0.9000", "4", "MB", "fast"],
        ["deep/b", "builtin:room", "70", "25%", "2:05", "3", "MB", "fast", "seed=3"],
    ]
    assert runs_table(runs_in(folder / "a"), folder / "a").splitlines()[1].startswith("a ")


@pytest.mark.parametrize("name", wn.PRESETS)
def test_a_configuration_in_words(name: str) -> None:
    config = wn.PRESETS[name]
    assert in_words(config) == name
    other = replace(config, alpha_min=0.321, grid=replace(config.grid, grow_at=(0.25, 0.5)))
    assert in_words(other) == f"{name} alpha_min=0.321 grid.grow_at=[0.25,0.5]"


@pytest.mark.parametrize(
    ("field", "said"),
    [
        (wn.Vm(), "fast field=vm"),
        (wn.Vm(density=8, appearance=8), "fast field=vm field.density=8 field.appearance=8"),
    ],
)
def test_another_storage_in_words(field: wn.Vm, said: str) -> None:
    assert in_words(replace(wn.PRESETS["fast"], field=field)) == said


def test_clean_leaves_fields_and_unfinished_runs(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["runs", str(folder), "--clean"]) == 0
    assert "a: checkpoints of 3 MB removed" in capsys.readouterr().out
    assert sorted(path.name for path in (folder / "a").glob("*.safetensors")) == [
        "field.safetensors"
    ]
    assert len(list((folder / "deep" / "b").glob("checkpoint-*"))) == 1


def test_a_run_that_is_trained_into_is_left_alone(folder: Path) -> None:
    (run,) = runs_in(folder / "a")
    with only_writer(run.folder), pytest.raises(InputError, match="is training into"):
        remove_checkpoints(run)
    assert len(list(run.folder.glob("checkpoint-*"))) == 1


@pytest.mark.parametrize("place", ["none", "a/log.jsonl", "empty"])
def test_where_there_are_none(folder: Path, place: str, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "empty").mkdir()
    assert main(["runs", str(folder / place)]) == 2
    assert "name " in capsys.readouterr().err


def test_damaged_files_are_no_obstacle(folder: Path) -> None:
    (folder / "a" / "metrics.json").write_bytes(np.random.default_rng(0).bytes(99))
    (folder / "a" / "log.jsonl").write_text("\n\n[1]\n")
    (run,) = runs_in(folder / "a")
    assert (run.step, run.metrics, run.is_finished) == (0, {}, False)
