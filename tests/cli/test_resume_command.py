"""Trainings that are stopped and resumed by the command."""

from __future__ import annotations

import json
import shlex
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from tests.support.tiny_fields import assert_same_state
from tests.support.tiny_runs import TINY, run, start
from tests.support.tiny_scenes import picture, save, write_transforms
from warpnerf.runs.checkpoint import load_checkpoint
from warpnerf.runs.run import Run

GROWING = (*TINY, "--steps", "210", "--voxels", "20000", "--keep", "checkpoint")
"""Grows before the first update after step 200, and trains on for a few steps."""


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "whole"
    code, _, err = run("train", *GROWING, "--output", folder)
    assert code == 0, err
    return folder


def begun(folder: Path, *signals: int, resumed: bool = False) -> tuple[int, str, str]:
    """A training that is sent signals when it is under way: how it ended."""
    words = ("--resume", folder) if resumed else (*GROWING, "--output", folder)
    process = start("train", *words)
    try:
        assert process.stdout is not None
        for line in process.stdout:  # a progress report: training is under way
            if "step " in line and "loss" in line:
                break
        for number in signals:
            process.send_signal(number)
        out, err = process.communicate(timeout=240)
    finally:
        process.kill()
    return process.returncode, out, err


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow),
    ],
)
def test_stopped_it_saves_and_says_how_to_go_on(tmp_path: Path, number: int, code: int) -> None:
    folder = tmp_path / "my run"
    returned, out, err = begun(folder, number)
    assert returned == code
    assert "Traceback" not in err
    assert len(out.splitlines()) == 1
    state = load_checkpoint(Run(folder).checkpoints[0])
    step = state.progress.step
    saved = f"stopped and saved after step {step}"
    assert out == f"{saved}; continue with: {Run(folder).resume_command}\n"
    code, _, err = run("eval", folder, "--threads", "1")  # the field so far
    assert code == 0, err


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_stopped_and_resumed_a_run_ends_as_if_it_had_not_been(
    uninterrupted: Path, tmp_path: Path, on_cpu: None
) -> None:
    folder = tmp_path / "my run"
    _, out, _ = begun(folder, signal.SIGINT)
    assert load_checkpoint(Run(folder).checkpoints[0]).grown == 0
    (folder / "metrics.json").write_text("{}")
    begun(folder, signal.SIGINT, resumed=True)
    assert not (folder / "metrics.json").exists()  # it was of another field
    command = shlex.split(out.strip().partition("continue with: ")[2])
    code, out, err = run(*command[1:])
    assert code == 0, err
    assert "resuming after step" in out
    for name in ("field.safetensors", "metrics.json"):
        assert (folder / name).read_bytes() == (uninterrupted / name).read_bytes()
    resumed, whole = (load_checkpoint(Run(f).checkpoints[0]) for f in (folder, uninterrupted))
    assert resumed.grown == 4
    same = replace(whole.progress, seconds=resumed.progress.seconds)
    assert_same_state(resumed, replace(whole, progress=same))
    assert reports(folder) == reports(uninterrupted)


def reports(folder: Path) -> list[tuple[int, float]]:
    lines = (folder / "log.jsonl").read_text().splitlines()
    return [(line["step"], line["loss"]) for line in map(json.loads, lines)]


@pytest.mark.ci
@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_asked_twice_it_ends_at_once_and_the_checkpoint_stays(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    code, out, err = begun(folder, signal.SIGINT, signal.SIGTERM, signal.SIGINT)
    assert code in (130, 143)
    assert "Traceback" not in out + err
    for path in Run(folder).checkpoints:
        load_checkpoint(path)
    assert not list(folder.glob(".*"))


def test_a_finished_run_is_resumed_to_its_figures(
    trained: tuple[Path, str], tmp_path: Path
) -> None:
    folder = shutil.copytree(trained[0], tmp_path / "run")
    before = (folder / "checkpoint-00000030.safetensors").stat().st_mtime_ns
    for name in ("metrics.json", "field.safetensors"):
        (folder / name).unlink()
    code, _, err = run("train", "--resume", folder)
    assert code == 0, err
    for name in ("metrics.json", "field.safetensors"):
        assert (folder / name).read_bytes() == (trained[0] / name).read_bytes()
    assert (folder / "checkpoint-00000030.safetensors").stat().st_mtime_ns == before


@pytest.mark.ci
def test_a_finished_run_keeps_its_field_alone(trained: tuple[Path, str], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    code, _, err = run("train", *TINY, "--steps", "30", "--output", folder)
    assert code == 0, err
    assert not list(folder.glob("checkpoint-*"))
    for name in ("field.safetensors", "metrics.json"):
        assert (folder / name).read_bytes() == (trained[0] / name).read_bytes()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for more in ((), ("--steps", "60")):
        code, _, err = run("train", "--resume", folder, *more)
        assert code == 2
        assert err.startswith(f"warpnerf: error: {folder} has finished and keeps its field alone")
        assert "--keep checkpoint" in err and len(err.splitlines()) == 1
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    (folder / "metrics.json").unlink()  # stopped before its views were looked at
    code, _, err = run("train", "--resume", folder)
    assert code == 0, err
    assert (folder / "metrics.json").read_bytes() == (trained[0] / "metrics.json").read_bytes()


@pytest.mark.ci
def test_a_finished_run_is_trained_for_longer(trained: tuple[Path, str], tmp_path: Path) -> None:
    folder = shutil.copytree(trained[0], tmp_path / "run")
    code, out, err = run("train", "--resume", folder, "--steps", "40")
    assert code == 0, err
    assert "steps 40 instead of 30: learning rates rise" in out
    config = json.loads((folder / "config.json").read_text())
    assert config["train"]["steps"] == 40
    assert [path.name for path in Run(folder).checkpoints] == [
        "checkpoint-00000040.safetensors",
        "checkpoint-00000030.safetensors",
    ]
    Run(folder).checkpoints[0].unlink()  # interrupted after config.json had been written
    whole = (folder / "field.safetensors").read_bytes()
    code, out, err = run("train", "--resume", folder)
    assert code == 0, err
    assert "resuming after step 30" in out
    assert (folder / "field.safetensors").read_bytes() == whole
    Run(folder).checkpoints[0].unlink()
    code, out, err = run("train", "--resume", folder, "--steps", "35")
    assert code == 0, err
    assert "steps 35, not 40, to which the run had been extended" in out
    assert "steps 35 instead of 30: learning rates rise" in out
    assert json.loads((folder / "config.json").read_text())["train"]["steps"] == 35


def test_other_threads_are_allowed_and_noted(trained: tuple[Path, str]) -> None:
    code, out, err = run("train", "--resume", trained[0], "--threads", "2")
    assert code == 0, err
    assert "threads 2 instead of 1" in out


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("--steps", "29"), "steps is 29"),
        (("--time-limit", "5"), "time_limit is 5.0"),
        (("--near", "0.1"), "march.near is 0.1"),
        (("--seed", "1"), "seed is 1"),
        (("--model", "sh"), "model"),
        (("--model-options", "width=48"), "model.width is 48"),
        (("--downscale", "8"), "--downscale does not go with --resume"),
        (("--downscale", "0"), "--downscale does not go with --resume"),
        (("--preset", "fast"), "--preset does not go with --resume"),
        (("--overwrite",), "--overwrite does not go with --resume"),
        (("--scaling", "None"), "--scaling cannot be None; leave it out"),
        (("--scaling=None",), "--scaling cannot be None; leave it out"),
        (("--output", "elsewhere"), "--output does not go with --resume"),
    ],
)
def test_what_would_change_a_resumed_run_is_refused(
    trained: tuple[Path, str], arguments: tuple[str, ...], says: str
) -> None:
    before = {path: path.stat().st_mtime_ns for path in trained[0].rglob("*")}
    code, _, err = run("train", "--resume", trained[0], *arguments)
    assert code == 2
    assert says in err
    assert "Traceback" not in err
    assert {path: path.stat().st_mtime_ns for path in trained[0].rglob("*")} == before


def test_another_scene_is_refused(trained: tuple[Path, str], tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "scene")
    for i, frame in enumerate(content["frames"]):
        Image.fromarray(picture(i, width=96, height=96)).save(
            tmp_path / "scene" / frame["file_path"]
        )
    content |= {"w": 96, "h": 96}
    save(tmp_path / "scene" / "transforms.json", content)
    code, _, err = run("train", tmp_path / "scene", "--resume", trained[0])
    assert code == 2
    assert "scene is not what the training to be resumed has seen" in err
