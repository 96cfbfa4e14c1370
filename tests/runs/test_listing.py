"""`warpnerf runs`: what is listed of each run, and what --clean removes."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import warpnerf as wn
from tests.support.tiny_trainings import ball
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.runs import files, listing
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
        metrics = {"mean": {"psnr": psnr, "ssim": 0.9}, "images": [{"name": "a"}, {"name": "b"}]}
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


def test_the_table(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["runs", str(folder)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines == [
        ["run", "scene", "steps", "done", "time", "views", "PSNR", "SSIM", "disk", "configuration"],
        ["a", "builtin:room", "70", "100%", "2:05", "2", "31.42", "0.9000", "4", "MB", "fast"],
        ["deep/b", "builtin:room", "70", "25%", "2:05", "3", "MB", "fast", "seed=3"],
    ]
    assert runs_table(runs_in(folder / "a"), folder / "a").splitlines()[1].startswith("a ")
    monkeypatch.chdir(folder / "a")
    assert runs_table(runs_in(Path()), Path()).splitlines()[1].startswith("a ")


def test_figures_of_training_views_are_told_from_those_of_test_views(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = folder / "a" / "metrics.json"
    file.write_text(json.dumps({"split": "train", **json.loads(file.read_text())}))
    assert main(["runs", str(folder)]) == 0
    assert "2:05  2 train  31.42" in capsys.readouterr().out


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
    (folder / "a" / "visibility.safetensors").write_bytes(bytes(2_000_000))
    assert main(["runs", str(folder), "--clean"]) == 0
    assert "a: checkpoints and what exports keep removed, 5 MB\n" in capsys.readouterr().out
    assert sorted(path.name for path in (folder / "a").glob("*.safetensors")) == [
        "field.safetensors"
    ]
    assert len(list((folder / "deep" / "b").glob("checkpoint-*"))) == 1


def test_a_run_that_is_trained_into_is_left_alone(folder: Path) -> None:
    (run,) = runs_in(folder / "a")
    with only_writer(run.folder), pytest.raises(InputError, match="is training into"):
        remove_checkpoints(run)
    assert len(list(run.folder.glob("checkpoint-*"))) == 1


def test_clean_goes_on_past_a_run_that_is_trained_into(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(folder / "z", wn.PRESETS["fast"], fraction=1.0, psnr=None)
    with only_writer(folder / "a"):
        assert main(["runs", str(folder), "--clean"]) == 0
    out = capsys.readouterr().out
    assert f"left alone: {folder / 'a'}: process" in out and "z: checkpoints and what" in out
    assert len(list((folder / "a").glob("checkpoint-*"))) == 1


def test_a_checkpoint_tells_the_step_before_the_first_report(folder: Path) -> None:
    for name in ("a", "deep/b"):
        (folder / name / "checkpoint-00000075.safetensors").write_bytes(b"")
    (folder / "a" / "log.jsonl").unlink()
    assert [run.step for run in runs_in(folder)] == [75, 75]
    (folder / "deep/b" / "checkpoint-00000075.safetensors").unlink()
    assert [run.step for run in runs_in(folder)] == [75, 70]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes")
def test_a_pipe_is_not_waited_for(folder: Path) -> None:
    for name in ("log.jsonl", "metrics.json"):
        (folder / "a" / name).unlink()
        os.mkfifo(folder / "a" / name)
    assert runs_in(folder)[0].step == 70 and not runs_in(folder)[0].metrics


def test_files_may_go_meanwhile(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A training that saves a checkpoint removes older ones."""
    (run,) = runs_in(folder / "a")
    (checkpoint,) = run.folder.glob("checkpoint-*")
    gone = run.folder / "checkpoint-00000060.safetensors"
    monkeypatch.setattr(files, "checkpoints", lambda place: [checkpoint, gone])
    walked = [(str(run.folder), [], [path.name for path in (gone, checkpoint)])]
    monkeypatch.setattr(listing.os, "walk", lambda place: walked)
    assert runs_in(run.folder)[0].n_bytes == 3_000_000
    assert remove_checkpoints(run) == 3_000_000


def test_a_run_that_was_begun_anew_meanwhile_keeps_its_checkpoints(folder: Path) -> None:
    (run,) = runs_in(folder / "a")
    (run.folder / "field.safetensors").unlink()
    assert remove_checkpoints(run) == 0
    assert len(list(run.folder.glob("checkpoint-*"))) == 1


def test_what_a_run_replaces_is_part_of_it(folder: Path) -> None:
    made(folder / "a" / "previous", wn.PRESETS["fast"], fraction=1.0, psnr=None)
    a, b = runs_in(folder)
    assert (a.folder.name, b.folder.name) == ("a", "b") and a.n_bytes > 8_000_000
    (previous,) = runs_in(folder / "a" / "previous")
    with only_writer(folder / "a"), pytest.raises(InputError, match="is training into"):
        remove_checkpoints(previous)


def test_photographs_that_lie_elsewhere_take_no_room(folder: Path) -> None:
    (folder / "photos").mkdir()
    (folder / "photos" / "0.jpg").write_bytes(bytes(5_000_000))
    (folder / "a" / "scene").mkdir()
    before = runs_in(folder / "a")[0].n_bytes
    os.link(folder / "photos" / "0.jpg", folder / "a" / "scene" / "0.jpg")
    assert runs_in(folder / "a")[0].n_bytes == before
    (folder / "photos" / "0.jpg").unlink()
    assert runs_in(folder / "a")[0].n_bytes == before + 5_000_000


def test_scenes_have_the_names_of_their_folders(folder: Path) -> None:
    record = {"made_of": {"source": "/home/me/garden.v2"}, "written": []}
    (folder / "a" / "scene").mkdir()
    (folder / "a" / "scene" / "pose.json").write_text(json.dumps(record))
    config = json.loads((folder / "a" / "config.json").read_text()) | {"scene": "scene"}
    (folder / "a" / "config.json").write_text(json.dumps(config))
    assert " garden.v2 " in runs_table(runs_in(folder), folder).splitlines()[1]


@pytest.mark.skipif(os.name != "posix", reason="names that others do not allow")
def test_names_do_not_break_the_table(folder: Path) -> None:
    (folder / "a").rename(folder / "a\nb")
    assert '"a\\nb"' in runs_table(runs_in(folder), folder).splitlines()[1]


def test_runs_whose_configuration_is_damaged_are_named(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "a" / "config.json").write_text("{")
    assert main(["runs", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "cannot be read: 1 run (" in out and "config.json: is not valid JSON" in out
    assert main(["runs", str(folder / "a")]) == 2
    assert "holds no run that can be read: " in capsys.readouterr().err


@pytest.mark.parametrize("place", ["none", "a/log.jsonl", "empty"])
def test_where_there_are_none(folder: Path, place: str, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "empty").mkdir()
    assert main(["runs", str(folder / place)]) == 2
    assert "name " in capsys.readouterr().err


def test_damaged_files_are_no_obstacle(folder: Path) -> None:
    (folder / "a" / "metrics.json").write_bytes(np.random.default_rng(0).bytes(99))
    (folder / "a" / "log.jsonl").write_text("\n\n[1]\n")
    (run,) = runs_in(folder / "a")
    assert (run.step, run.metrics, run.is_finished) == (70, {}, False)


def test_a_folder_that_is_named_as_a_checkpoint_is_left_alone(tmp_path: Path) -> None:
    run = made(tmp_path / "a", wn.PRESETS["fast"], fraction=1.0, psnr=None)
    (run / "checkpoint-00000080.safetensors").mkdir()
    assert main(["runs", str(tmp_path), "--clean"]) == 0
    assert [path.name for path in run.glob("checkpoint-*")] == ["checkpoint-00000080.safetensors"]
