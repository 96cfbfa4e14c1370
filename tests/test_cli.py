"""The command as people run it: what it says, leaves behind, and exits with."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_scenes import save, write_transforms

TINY = ("builtin:room", "--downscale", "8", "--threads", "1")


def start(*arguments: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "warpnerf", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(*arguments: str | Path) -> tuple[int, str, str]:
    process = start(*arguments)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A tiny run, and what it printed."""
    folder = tmp_path_factory.mktemp("runs") / "room"
    code, out, err = run("train", *TINY, "--steps", "30", "--output", folder)
    assert code == 0, err
    return folder, out


def test_help_names_every_option() -> None:
    assert run("--help")[0] == 0
    code, out, _ = run("train", "--help")
    assert code == 0
    options = ["output", "steps", "time-limit", "scaling", "content-distance", "near", "downscale"]
    for option in [*options, "device", "threads", "seed", "preset", "voxels"]:
        assert f"--{option}" in out
    code, out, _ = run("eval", "--help")
    assert code == 0
    for option in ("scene", "split", "json"):
        assert f"--{option}" in out


def test_version() -> None:
    code, out, _ = run("--version")
    assert code == 0
    assert out.startswith("warpnerf ")


def test_training_leaves_a_whole_run(trained: tuple[Path, str]) -> None:
    folder, out = trained
    assert "content distance" in out
    assert {path.name for path in folder.iterdir()} == {
        "config.json",
        "log.jsonl",
        "field.safetensors",
        "metrics.json",
        "test",
    }
    metrics = json.loads((folder / "metrics.json").read_text())
    assert len(list((folder / "test").glob("*.png"))) == len(metrics["images"])
    reports = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert reports[-1]["step"] == 30
    assert reports[-1]["fraction"] == 1.0
    config = json.loads((folder / "config.json").read_text())
    assert (config["scene"], config["downscale"]) == ("builtin:room", 8)


def test_eval_repeats_the_figures(trained: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = trained
    target = tmp_path / "figures.json"
    code, out, err = run("eval", folder, "--json", target, "--threads", "1")
    assert code == 0, err
    figures = json.loads(target.read_text())
    assert list(figures) == ["mean", "images"]
    for row in (figures["mean"], *figures["images"]):
        assert np.isfinite([row["psnr"], row["ssim"]]).all()
    assert figures == json.loads((folder / "metrics.json").read_text())
    assert f"{figures['mean']['psnr']:.2f}" in out


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
        ((*TINY, "--steps", "0"), "steps"),
        ((*TINY, "--near", "nan"), "near"),
        ((*TINY, "--near", "-1"), "near"),
        ((*TINY, "--content-distance", "0"), "content_distance"),
        ((*TINY, "--time-limit", "-3"), "time_limit"),
        (("builtin:room", "--downscale", "0"), "downscale"),
        ((*TINY, "--scaling", "cubic"), "scaling"),
        ((*TINY, "--stesp", "3"), "--steps"),
    ],
)
def test_bad_input_gets_a_sentence(tmp_path: Path, arguments: tuple[str, ...], says: str) -> None:
    code, out, err = run("train", *arguments, "--output", tmp_path / "run")
    assert code == 2
    assert says in out + err
    assert "Traceback" not in out + err
    assert not (tmp_path / "run").exists()


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


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT for one process there")
def test_ctrl_c_keeps_the_field(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    process = start("train", *TINY, "--steps", "100000", "--output", folder)
    try:
        assert process.stdout is not None
        for line in process.stdout:  # a progress report: training is under way
            if "step " in line and "loss" in line:
                break
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "field.safetensors" in out + err
    assert "Traceback" not in err
    code, _, err = run("eval", folder, "--threads", "1")
    assert code == 0, err
