"""Logs besides log.jsonl, and the picture of the training's curves."""

from __future__ import annotations

import csv
import json
import sys
import types
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

from tests.support.cli_process import command, make_scene
from tests.support.faulty_saves import new_run, run_with, state_of
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.runs.logs import read_reports
from warpnerf.runs.run import Run
from warpnerf.training.state import Progress

PICTURE = np.zeros((4, 4, 3), np.uint8)
FEW = ("--steps", "30", "--threads", "1", "--voxels", "512")


def report(step: int, **changes: Any) -> Progress:
    return replace(state_of(1).progress, step=step, seconds=step / 10, **changes)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "log.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_begins_with_what_a_resumed_run_has(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    for step in (25, 50):
        run.log(report(step))
    log = run.open_log("csv")
    run.write_to(log, report(75, test_psnr=21.5))
    run.log(report(75, test_psnr=21.5))
    log.close({"psnr": 20.0})
    assert [row["step"] for row in rows(tmp_path)] == ["25", "50", "75"]
    assert [row["test_psnr"] for row in rows(tmp_path)] == ["", "", "21.5"]
    assert float(rows(tmp_path)[2]["loss"]) == report(75).loss
    run.rewind_log(50)
    run.open_log("csv")
    assert [row["step"] for row in rows(tmp_path)] == ["25", "50"]


def test_scalars_for_tensorboard(tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    run = new_run(tmp_path)
    log = run.open_log("tensorboard")
    run.write_to(log, report(25, loss=0.25, test_psnr=21.5))
    log.close({"ssim": 0.5})
    (file,) = (tmp_path / "tensorboard").iterdir()
    content = file.read_bytes()
    for tag in (b"train/loss", b"train/psnr", b"train/seconds", b"test/psnr", b"final/ssim"):
        assert tag in content


def test_a_log_is_replaced_with_its_run(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1)
    events = tmp_path / "tensorboard" / "events.out.tfevents.1.host"
    events.parent.mkdir()
    mine = tmp_path / "tensorboard" / "notes.txt"
    for path in (events, mine, tmp_path / "log.csv", tmp_path / "curves.png"):
        path.write_text("older")
    new_run(tmp_path)
    older = tmp_path / "previous"
    names = ("tensorboard/" + events.name, "log.csv", "curves.png")
    assert all((older / name).is_file() for name in names)
    run.save_checkpoint(state_of(2))
    assert not older.exists() and mine.read_text() == "older"
    assert not events.exists() and not (tmp_path / "log.csv").exists()


class FakeRun:
    def __init__(self, **options: Any) -> None:
        self.options, self.logged, self.summary = options, [], {}
        self.finished = False

    def log(self, values: dict[str, float], step: int) -> None:
        self.logged.append((step, values))

    def finish(self) -> None:
        self.finished = True


def test_weights_and_biases(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[FakeRun] = []
    fake = types.ModuleType("wandb")
    monkeypatch.setattr(
        fake, "init", lambda **o: begun.append(FakeRun(**o)) or begun[-1], raising=False
    )
    monkeypatch.setitem(sys.modules, "wandb", fake)
    run = new_run(tmp_path / "my run")
    run.log(report(25))
    log = run.open_log("wandb")
    run.write_to(log, report(50, test_psnr=21.5))
    log.close({"ssim": 0.5})
    (theirs,) = begun
    assert theirs.options["project"] == "warpnerf" and theirs.options["name"] == "my run"
    assert theirs.options["config"]["train"]["steps"] == 4000
    assert [step for step, _ in theirs.logged] == [25, 50]
    assert theirs.logged[1][1]["test/psnr"] == 21.5 and "test/psnr" not in theirs.logged[0][1]
    assert theirs.summary == {"final/ssim": 0.5} and theirs.finished

    def refused(**options: Any) -> None:
        raise RuntimeError("api_key not\nconfigured")

    monkeypatch.setattr(fake, "init", refused)
    with pytest.raises(InputError, match=r"\(api_key not configured\); log in by `wandb login`"):
        run.open_log("wandb")


@pytest.mark.parametrize(("kind", "package"), [("tensorboard", "tensorboardX"), ("wandb", "wandb")])
def test_a_missing_package_is_named_before_anything_is_read(
    kind: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert main(["train", "builtin:room", "--log", kind]) == 2
    err = capsys.readouterr().err
    assert f'--log {kind} needs {package}: pip install "warpnerf[{kind}]".' in err


def test_reports_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    assert read_reports(path) == []
    whole = '{"step": 1, "seconds": 0.5, "loss": 0.1, "psnr": 12.0}'
    path.write_text(f'{whole}\n[1]\n{{"step": 2}}\n{whole[:20]}')
    (found,) = read_reports(path)
    assert found["seen"] == 1.0 and found["test_psnr"] is None
    Run(tmp_path).draw_curves("room")
    assert iio.imread(tmp_path / "curves.png").std() > 10


def test_curves_are_of_whole_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, drawn = new_run(tmp_path), []
    run.log(report(25, loss=0.4, psnr=20.0, seen=0.1))
    monkeypatch.setattr("warpnerf.runs.run.curves", lambda *given: drawn.append(given) or PICTURE)
    run.draw_curves("room")
    ((points, title),) = drawn
    assert title == "room: 25 steps in 2 s"
    assert points[0].loss == pytest.approx(0.04) and points[0].psnr == pytest.approx(30.0)


def test_the_command_logs_and_draws(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    options = ("--log", "csv", "--eval-every", "10", "--output", "run")
    done = command("train", scene, *FEW, *options, folder=tmp_path)
    assert done.code == 0, done.err
    found = read_reports(done.run / "log.jsonl")
    assert [row["step"] for row in rows(done.run)] == [str(entry["step"]) for entry in found]
    assert found[-1]["test_psnr"] is not None
    assert f"test PSNR {found[-1]['test_psnr']:.2f}" in done.out
    assert iio.imread(done.run / "curves.png").shape == (760, 1200, 3)
    plain = command("train", scene, *FEW, "--output", "run", "--overwrite", folder=tmp_path)
    assert plain.code == 0, plain.err
    assert read_reports(done.run / "log.jsonl")[-1]["loss"] == found[-1]["loss"]
    assert not (done.run / "log.csv").exists()


def test_test_views_have_to_be_there(tmp_path: Path) -> None:
    scene = make_scene(tmp_path)
    options = ("--split", "all", "--eval-every", "10", "--output", "run")
    done = command("train", scene, *FEW, *options, folder=tmp_path)
    assert done.code == 2 and "eval_every is 10, but scene has no test views" in done.err
    assert not done.run.exists()


@pytest.mark.parametrize(
    "changes",
    [
        *({"step": "5"}, {"step": -1}, {"step": True}, {"seconds": "x"}, {"seconds": None}),
        *({"loss": []}, {"psnr": 1e300}, {"seen": 0.0}, {"seen": float("nan")}, {"test_psnr": {}}),
    ],
)
def test_a_line_that_is_no_report_is_left_out(changes: dict[str, object], tmp_path: Path) -> None:
    good = {"step": 5, "seconds": 1.0, "loss": 0.1, "psnr": 20.0}
    lines = [json.dumps(good), json.dumps(good | changes), "[1]", "{"]
    (tmp_path / "log.jsonl").write_text("\n".join(lines))
    (found,) = read_reports(tmp_path / "log.jsonl")
    assert found["step"] == 5 and found["seen"] == 1.0
