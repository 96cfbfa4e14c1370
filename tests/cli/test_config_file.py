"""A run, repeated or varied from its config.json."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

import warpnerf as wn
from tests.model.test_config_options import trained
from warpnerf.cli.configured import STEPS_OF_TIMED
from warpnerf.cli.main import main


@pytest.mark.ci
def test_a_run_is_repeated_from_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = "builtin:room-sparse --downscale 8 --threads 1 --steps 20 --grid.voxels 512 --model rgb"
    assert main(["train", *tiny.split(), "--output", str(tmp_path / "a")]) == 0
    file = tmp_path / "a" / "config.json"
    assert main(["train", "--config", str(file), "--output", str(tmp_path / "b")]) == 0
    for name in ("field.safetensors", "metrics.json", "config.json"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / name).read_bytes()
    begin = wn.TrainConfig(steps=20, threads=1, model=wn.Rgb(), grid=wn.GridConfig(voxels=512))
    scene, _, downscale, masks, _, config, _, _ = trained(
        monkeypatch, "--config", file, "--output", tmp_path / "c", "--model", "sh", "--seed", "3"
    )
    assert (scene, downscale, masks) == ("builtin:room-sparse", 8, None)
    assert config == replace(begin, model=wn.SphericalHarmonics(), seed=3)
    scene, _, downscale, _, _, config, _, _ = trained(
        monkeypatch,
        *("builtin:room", "--config", file, "--output", tmp_path / "c"),
        *("--downscale", "2", "--time-limit", "9"),
    )
    assert (scene, downscale, config.steps) == ("builtin:room", 2, STEPS_OF_TIMED)


def written(folder: Path, **changed: Any) -> Path:
    """A run's config.json that trained on a folder beside it."""
    folder.mkdir()
    train_config = json.loads(json.dumps(asdict(wn.TrainConfig())))
    named = {"model": "rgb", "field": "dense", "sampler": "march"}
    train_config |= {part: {"name": name} for part, name in named.items()}
    tree = {"scene": "scene", "downscale": 2, "content_distance": 1.0, "train": train_config}
    (folder / "config.json").write_text(json.dumps(tree | changed))
    return folder / "config.json"


def test_a_files_scene_and_masks_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    masks = tmp_path / "masks"
    file = written(tmp_path / "run", masks=str(masks))
    for folder in (masks, tmp_path / "run" / "scene"):
        folder.mkdir()
    line = ("--config", file, "--output", tmp_path / "out")
    found = trained(monkeypatch, *line)
    assert found[0] == str(tmp_path / "run" / "scene") and found[2:4] == (2, masks)
    other = trained(monkeypatch, tmp_path / "other", *line)
    assert other[0] == str(tmp_path / "other") and other[2:4] == (2, None)


@pytest.mark.parametrize(
    ("change", "line", "says"),
    [
        (
            {"train": {"stesp": 3}},
            "",
            "train.stesp is no field of a training, the nearest is steps",
        ),
        (
            {"train": {"grid": {"voxel": 3}}},
            "",
            "train.grid.voxel is no field of a training, the nearest is grid.voxels",
        ),
        ({"train": {"optim": {"decay": -1}}}, "", "optim.decay must be a finite number above 0"),
        ({"train": {"steps": "many"}}, "", "config.json: expected `int`"),
        ({"train": 3}, "", "config.json: "),
        ({"scene": None}, "", "config.json: "),
        ({}, "", "scene: the scene that the run was trained on is no longer there"),
        ({}, "x --preset fast", "--preset does not go with --config: "),
        ({}, "x --resume y", "--config does not go with --resume: "),
        ({}, "x --optim.decay fast", "--optim.decay must be a number, not 'fast'."),
    ],
)
def test_a_file_that_does_not_fit_is_refused_and_nothing_is_written(
    tmp_path: Path, change: dict[str, Any], line: str, says: str, capsys: Any
) -> None:
    file = written(tmp_path / "run", **change)
    output = tmp_path / "out"
    resumed = [] if "--resume" in line else ["--output", str(output)]
    assert main(["train", "--config", str(file), *line.split(), *resumed]) == 2
    out, err = capsys.readouterr()
    assert not out and len(err.splitlines()) == 1
    assert says in err
    assert not output.exists()


def test_a_file_that_is_none_is_refused(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "bad.json").write_text("{")
    for name, says in (("none.json", "does not exist"), ("bad.json", "is not valid JSON")):
        assert main(["train", "--config", str(tmp_path / name), "--output", "out"]) == 2
        err = capsys.readouterr().err
        assert name in err and says in err and len(err.splitlines()) == 1
