"""The command as people run it: what it says, leaves behind, and exits with."""

from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.support import cli_process
from tests.support.tiny_runs import TINY, run, start
from tests.support.tiny_scenes import save, write_transforms
from warpnerf.cli import train
from warpnerf.cli.configured import STEPS_OF_TIMED
from warpnerf.cli.main import main
from warpnerf.presets import PRESETS
from warpnerf.runs.checkpoint import load_checkpoint
from warpnerf.runs.run import Run
from warpnerf.training.photograph_errors import PhotographErrors
from warpnerf.training.trainer import Trainer


def test_help_names_every_option() -> None:
    assert run("--help")[0] == 0
    code, out, _ = run("train", "--help")
    assert code == 0
    options = ["output", "steps", "time-limit", "scaling", "content-distance", "near", "downscale"]
    more = ["device", "threads", "seed", "preset", "voxels", "resume", "checkpoint-every"]
    more += ["model", "model-options", "loss", "overwrite", "eval-views"]
    for option in [*options, *more]:
        assert f"--{option}" in out
    code, out, _ = run("eval", "--help")
    assert code == 0
    for option in ("scene", "split", "lpips", "json"):
        assert f"--{option}" in out


def test_version() -> None:
    process = start("--version")
    out, _ = process.communicate(timeout=240)
    assert process.returncode == 0
    assert out.startswith("warpnerf ")


@pytest.mark.ci
def test_photographs_that_do_not_fit_are_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def psnr(self: object, names: list[str]) -> dict[str, float]:
        return {name: 12.0 if name == names[3] else 25.0 for name in names}

    monkeypatch.setattr(PhotographErrors, "psnr", psnr)
    command = ["train", *TINY, "--steps", "2", "--voxels", "512", "--eval-views", "none"]
    assert main([*command, "--output", str(tmp_path / "run")]) == 0
    out = capsys.readouterr().out
    assert re.search(r"warning: photograph that the field does not explain: \S+ \(12.0 dB\)", out)


def test_exposures_that_were_fitted_are_said(tmp_path: Path) -> None:
    outcome = cli_process.train(
        cli_process.make_scene(tmp_path), "--appearance", "affine", "--steps", "60", folder=tmp_path
    )
    assert outcome.code == 0, outcome.err
    says = (
        r"exposures: where the scene is grey, \S+ is \d\.\d\d times as bright, \S+ \d\.\d\d times"
    )
    assert re.search(says, outcome.out)
    assert "cc_psnr" in json.loads((outcome.run / "metrics.json").read_text())["mean"]
    outcome = cli_process.train(
        tmp_path / "scene", "--appearance", "none", "--overwrite", folder=tmp_path
    )
    assert outcome.code == 0 and not re.search(says, outcome.out)


def test_training_leaves_a_whole_run(trained: tuple[Path, str]) -> None:
    folder, out = trained
    assert "content distance" in out
    assert {path.name for path in folder.iterdir()} == {
        "config.json",
        "log.jsonl",
        "curves.png",
        "checkpoint-00000030.safetensors",
        "field.safetensors",
        "metrics.json",
        "test",
        "test.png",
    }
    assert out.splitlines()[-1] == f"look at {folder / 'test.png'}"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert len(list((folder / "test").glob("*.png"))) == len(metrics["images"])
    reports = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert reports[-1]["step"] == 30
    assert reports[-1]["fraction"] == 1.0
    config = json.loads((folder / "config.json").read_text())
    assert (config["scene"], config["downscale"]) == ("builtin:room-sparse", 8)


@pytest.mark.ci
@pytest.mark.parametrize(("views", "looked_at"), [("1", 1), ("none", None)])
def test_fewer_views_are_looked_at(views: str, looked_at: int | None, tmp_path: Path) -> None:
    small = "16" if views == "none" else "8"  # too small for SSIM
    options = ("--steps", "2", "--output", str(tmp_path / "run"), "--eval-views", views)
    code, out, err = run("train", "builtin:room-sparse", "--downscale", small, *options)
    assert code == 0, err
    written = {path.name for path in (tmp_path / "run").iterdir()}
    assert "field.safetensors" in written
    if looked_at is None:
        assert "metrics.json" not in written and out.splitlines()[-1].startswith("wrote ")
    else:
        metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
        assert len(metrics["images"]) == looked_at
        assert f"of {looked_at} views" in out


def test_eval_repeats_the_figures(trained: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = trained
    target = tmp_path / "figures.json"
    code, out, err = run("eval", folder, "--json", target, "--threads", "1")
    assert code == 0, err
    figures = json.loads(target.read_text())
    assert list(figures) == ["split", "mean", "floaters", "images"]
    for row in (figures["mean"], *figures["images"]):
        assert np.isfinite([row["psnr"], row["ssim"]]).all()
    assert figures == json.loads((folder / "metrics.json").read_text())
    assert f"{figures['mean']['psnr']:.2f}" in out


@pytest.mark.parametrize("name", ["config.json", "metrics.json", "field.safetensors"])
def test_eval_does_not_replace_what_the_run_keeps(trained: tuple[Path, str], name: str) -> None:
    file = trained[0] / name
    before = file.read_bytes()
    code, _, err = run("eval", trained[0], "--split", "train", "--json", file)
    assert code == 2 and f"--json {file}: is another file, which would be replaced; choose" in err
    assert file.read_bytes() == before


def test_eval_with_lpips(trained: tuple[Path, str], tmp_path: Path) -> None:
    weights = tmp_path / "weights.safetensors"
    code, _, err = run("eval", trained[0], "--lpips", weights)
    assert code == 2
    assert str(weights) in err and "LPIPS" in err
    assert "Traceback" not in err


def test_eval_of_the_training_views(trained: tuple[Path, str], tmp_path: Path) -> None:
    target = tmp_path / "figures.json"
    code, _, err = run("eval", trained[0], "--split", "train", "--json", target)
    assert code == 0, err
    names = {image["name"] for image in json.loads(target.read_text())["images"]}
    held_out = json.loads((trained[0] / "metrics.json").read_text())["images"]
    assert names
    assert not names & {image["name"] for image in held_out}


def test_a_run_is_not_written_over_unasked(trained: tuple[Path, str]) -> None:
    folder, _ = trained
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    code, _, err = run("train", *TINY, "--steps", "1", "--output", folder)
    assert code == 2
    assert "--overwrite" in err
    assert f"--resume {folder}" in err
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_overwrite_replaces_a_run(tmp_path: Path) -> None:
    (tmp_path / "test").mkdir()
    older = {"scene": "builtin:room", "downscale": 8, "content_distance": 1.0, "train": {}}
    (tmp_path / "config.json").write_text(json.dumps(older))
    for name in ("log.jsonl", "metrics.json", "test/old.png"):
        (tmp_path / name).write_text("older")
    code, _, err = run("train", *TINY, "--steps", "3", "--output", tmp_path, "--overwrite")
    assert code == 0, err
    lines = (tmp_path / "log.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [3]
    assert not (tmp_path / "test" / "old.png").exists()
    assert json.loads((tmp_path / "metrics.json").read_text())["images"]


def test_a_time_limit_takes_the_place_of_the_presets_steps(tmp_path: Path) -> None:
    few = replace(PRESETS["fast"], steps=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "PRESETS", {**PRESETS, "fast": few})
        begun = []
        patch.setattr(train, "_begin", lambda *a: begun.append(a[3]) or 0)
        for given in (
            "--time-limit 9",
            "--time-limit 9 --steps 7",
            "",
            "--preset quality --steps 7",
        ):
            options = ["--output", str(tmp_path / "a"), *given.split()]
            assert main(["train", "builtin:room", *options]) == 0
    assert [config.steps for config in begun] == [STEPS_OF_TIMED, 7, 2, 7]
    assert [config.time_limit for config in begun] == [9.0, 9.0, None, None]


def test_files_that_are_no_run_are_never_touched(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("mine")
    assert run("train", *TINY, "--output", tmp_path)[0] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("/nowhere/at/all",), "/nowhere/at/all"),
        (("builtin:palace",), "builtin:palace"),
        ((*TINY, "--device", "cuda:9"), "cuda:9"),
        ((*TINY, "--time-limit", "-3"), "time_limit"),
        (("builtin:room", "--downscale", "0"), "downscale"),
        ((*TINY, "--scaling", "cubic"), "scaling"),
        ((*TINY, "--stesp", "3"), "--steps"),
        (("",), "empty"),
    ],
)
def test_bad_input_gets_a_sentence(tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    code, out, err = run("train", *arguments, "--output", tmp_path / "run")
    assert code == 2
    assert says in out + err
    assert "Traceback" not in out + err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("options", [("--device", "cuda:9"), ("--threads", "100000")])
def test_a_machine_that_is_not_there_is_refused_before_photographs_are_read(
    tmp_path: Path, options: tuple[str, str]
) -> None:
    code, out, err = run("train", *TINY, *options, "--output", tmp_path / "run")
    assert code == 2
    assert "reading" not in out
    assert options[1] in err


def test_a_bad_scene_leaves_nothing(tmp_path: Path) -> None:
    content = write_transforms(tmp_path / "scene")
    content["frames"][2]["transform_matrix"] = [[1, 0], [0, 1]]
    save(tmp_path / "scene" / "transforms.json", content)
    code, _, err = run("train", tmp_path / "scene", "--output", tmp_path / "run")
    assert code == 2
    assert err.strip().splitlines()[-1].startswith("warpnerf: error: ")
    assert "transform_matrix" in err
    assert "Traceback" not in err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", ["missing", "empty", "config", "field"])
def test_eval_of_a_bad_run(trained: tuple[Path, str], tmp_path: Path, damage: str) -> None:
    run_folder = tmp_path / "run"
    if damage != "missing":
        run_folder.mkdir()
    if damage in ("config", "field"):
        config = (trained[0] / "config.json").read_text()
        (run_folder / "config.json").write_text(config[:30] if damage == "config" else config)
        (run_folder / "field.safetensors").write_bytes(b"no field")
    code, _, err = run("eval", run_folder)
    assert code == 2
    assert str(run_folder) in err
    assert "Traceback" not in err


def test_a_new_run_wants_a_scene(tmp_path: Path) -> None:
    for arguments in ((), ("--output", tmp_path / "run")):
        code, _, err = run("train", *arguments)
        assert code == 2
        assert "SCENE" in err and "--resume" in err


def test_a_run_is_named_by_scene_and_time(tmp_path: Path) -> None:
    options = ("--downscale", "16", "--steps", "1", "--eval-views", "none")
    done = cli_process.run("train", "builtin:room-sparse", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (folder,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"room-sparse-\d{4}-\d\d-\d\d-\d{6}", folder.name)
    assert f"wrote runs/{folder.name}: " in done.stdout
    assert f"training into runs/{folder.name}\nreading" in done.stdout


@pytest.mark.ci
@pytest.mark.parametrize(("bad_step", "kept"), [(1, "Nothing was saved"), (4, "Step 3 is saved")])
def test_what_is_not_finite_ends_the_run(
    tmp_path: Path,
    bad_step: int,
    kept: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    update = Trainer.update

    def spoiled(trainer: Trainer) -> None:
        update(trainer)
        if trainer.steps_done == bad_step:
            trainer.storage.values.fill_(float("nan"))  # type: ignore[attr-defined]

    monkeypatch.setattr(Trainer, "update", spoiled)
    folder = tmp_path / "run"
    only = ("--content-distance", "2")  # no short training before it
    arguments = ("train", *TINY, *only, "--output", str(folder), "--checkpoint-every", "1e-9")
    assert main([*arguments]) == 1
    err = capsys.readouterr().err
    assert f"not finite after step {bad_step}" in err
    assert kept in err
    assert "Traceback" not in err
    for path in Run(folder).checkpoints:
        assert load_checkpoint(path).progress.step < bad_step


def test_a_folder_that_is_trained_into_is_left_alone(trained: tuple[Path, str]) -> None:
    folder = trained[0]
    with Run(folder).only_writer():
        for options in (("--resume", folder), (*TINY, "--output", folder, "--overwrite")):
            code, _, err = run("train", *options)
            assert code == 2 and f"process {os.getpid()} is training into this folder" in err
    assert (folder / "field.safetensors").exists()


@pytest.mark.ci
def test_a_training_that_nobody_reads_goes_on(tmp_path: Path) -> None:
    process = start("train", *TINY, "--steps", "30", "--output", tmp_path / "run")
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline().startswith("reading")
    process.stdout.close()
    err = process.stderr.read()
    assert process.wait(timeout=240) == 0, err
    assert "Traceback" not in err and "Broken pipe" not in err
    assert (tmp_path / "run" / "metrics.json").exists()


def test_streams_that_are_closed_take_nothing_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in ``warpnerf train ... >&- 2>&-``."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    monkeypatch.setattr(train, "_begin", lambda *_: 7 if sys.stdout and sys.stderr else 0)
    assert main(["train", "builtin:room", "--output", str(tmp_path / "a")]) == 7
    assert main(["train", "--none"]) == 2


def test_what_is_odd_is_said_in_training(tmp_path: Path) -> None:
    options = ("--steps", "3", "--content-distance", "5000", "--output", tmp_path / "run")
    code, out, err = run("train", *TINY, *options)
    assert code == 0, err
    assert "warning: the content distance 5000 is " in out
