"""A run whose field is saved: what goes wrong afterwards, and how it is resumed."""

from __future__ import annotations

import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.support.faulty_saves import (
    KILLED,
    Faults,
    calls_of,
    disk_full,
    in_child,
    killed,
    run_with,
    state_of,
)
from tests.support.tiny_scenes import ring, write_blender
from tests.training.test_determinism import small_scene
from warpnerf.checks import InputError
from warpnerf.cli.train import train_command
from warpnerf.cli.train_options import TrainOptions
from warpnerf.config import TrainConfig
from warpnerf.runs import pictures
from warpnerf.runs.run import Run

TINY = {"steps": ("2",), "threads": ("1",), "grid.voxels": ("512",), "model": ("rgb",)}


def train(folder: Path, **options: Any) -> int:
    chosen = TrainOptions(scene="builtin:room-sparse", output=folder, downscale=8, **options)
    return train_command(chosen, TINY)


def resume(folder: Path, *, given: dict[str, tuple[str, ...]] | None = None, **options: Any) -> int:
    return train_command(TrainOptions(resume=folder, **options), given or {})


def test_a_full_disk_after_the_field_is_saved_begins_nothing_again(tmp_path: Path) -> None:
    run = run_with(tmp_path, 5)
    run.save_field(state_of(5).field, keep_checkpoints=False)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError) as error:
        patch.setattr(pictures, "write_png", lambda *_: disk_full("write"))
        run.evaluate(state_of(5).field, small_scene(), "train")
    way_on = f"the field is saved; continue with: {run.resume_command}"
    assert str(error.value).endswith(f"make room or give access; {way_on}")
    assert run.way_on() == way_on


@pytest.mark.ci
@pytest.mark.parametrize("during", ["save_field", "draw_curves"])
def test_stopped_while_it_finishes_it_says_that_the_field_is_saved(
    during: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    real = getattr(Run, during)

    def stopped(run: Run, *arguments: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        real(run, *arguments)

    folder = tmp_path / "run"
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with monkeypatch.context() as patch:
            patch.setattr(Run, during, stopped)
            assert train(folder) == 130
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == f"stopped; the field is saved; continue with: {Run(folder).resume_command}"
    assert resume(folder) == 0
    assert (folder / "metrics.json").exists()


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_field_alone_is_trained_no_longer_whether_it_was_looked_at_or_not(tmp_path: Path) -> None:
    assert train(tmp_path / "run", eval_views="none") == 0
    before = files_of(tmp_path)
    for views in ("all", "none"):
        with pytest.raises(InputError, match="keeps its field alone, from which no training"):
            resume(tmp_path / "run", given={"steps": ("3",)}, eval_views=views)
    idle: dict[str, Any] = {"log": "csv", "eval_every": 1, "view": True, "keep": "checkpoint"}
    for name, value in idle.items():
        option = name.replace("_", "-")
        with pytest.raises(InputError, match=f"^--{option} would do nothing: .*; leave it out"):
            resume(tmp_path / "run", **{name: value})
    assert files_of(tmp_path) == before
    assert resume(tmp_path / "run", given={"steps": ("2",)}) == 0
    assert (tmp_path / "run" / "metrics.json").exists()


@pytest.mark.ci
@pytest.mark.parametrize(
    ("object", "named", "other"),
    [
        (False, "dense", "vm"),
        pytest.param(True, "vm", "dense", marks=pytest.mark.slow),  # compiles another field
    ],
)
def test_what_auto_stood_for_may_be_named_when_views_are_left_to_look_at(
    object: bool, named: str, other: str, tmp_path: Path
) -> None:
    scene = "builtin:room-sparse"
    if object:
        scene = str(tmp_path / "scene")
        for split, n in (("train", 4), ("test", 1)):
            write_blender(Path(scene), split, ring(n, radius=3.0))
            for path in Path(scene, split).glob("*.png"):
                pixels = np.full((18, 24, 4), 255, np.uint8)
                v, u = np.mgrid[:18, :24]
                pixels[..., 3] *= np.hypot(v - 8.5, u - 11.5) < 4.0
                Image.fromarray(pixels).save(path)
    folder = tmp_path / "run"
    options = TrainOptions(
        scene=scene, output=folder, downscale=1 if object else 8, eval_views="none"
    )
    assert train_command(options, TINY | {"field": ("auto",)}) == 0
    with pytest.raises(InputError, match=f"^field.* {other}"):
        resume(folder, given={"field": (other,)})
    assert resume(folder, given={"field": (named,)}) == 0
    assert (folder / "metrics.json").exists()


@pytest.mark.parametrize(
    ("ended_by", "raised", "says"),
    [
        (
            {"time_limit": 0.3},
            ("steps", "200000"),
            "^time_limit is 0.3, .*raise --time-limit above",
        ),
        (
            {"time_limit": 0.3},
            ("time_limit", "0.3000001"),
            "^time_limit is 0.3000001, .*--time-limit abo",
        ),
        ({"steps": 2}, ("time_limit", "1e4"), "^steps is 2, .*raise --steps above 2"),
    ],
)
def test_a_limit_that_did_not_end_the_training_is_not_raised_alone(
    ended_by: dict[str, float], raised: tuple[str, str], says: str, tmp_path: Path
) -> None:
    limits = {"steps": 100000, "time_limit": 1e3} | ended_by
    words = {name: (str(value),) for name, value in limits.items()}
    options = TrainOptions(
        scene="builtin:room-sparse", output=tmp_path, downscale=8, keep="checkpoint"
    )
    assert train_command(options, TINY | words) == 0
    before = files_of(tmp_path)
    with pytest.raises(InputError, match=says):
        resume(tmp_path, given={raised[0]: (raised[1],)})
    assert files_of(tmp_path) == before


@pytest.mark.ci
def test_what_is_kept_is_remembered_when_it_is_resumed(tmp_path: Path) -> None:
    train(tmp_path, keep="checkpoint")

    def stopped(*_: Any) -> None:
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Run, "rewind_log", stopped)
        resume(tmp_path, keep="field")
    assert Run(tmp_path).checkpoints
    assert resume(tmp_path) == 0
    assert Run(tmp_path).read_config().keep == "field"
    assert [path.name for path in Run(tmp_path).results] == ["field.safetensors"]


def test_killed_while_it_is_extended_no_field_passes_for_the_longer_training(
    tmp_path: Path,
) -> None:
    longer = replace(TrainConfig(), steps=5000)

    def finished(name: str) -> Run:
        run = run_with(tmp_path / name, 5)
        run.save_field(state_of(5).field)
        return run

    counted = finished("counted")
    n_calls = len(calls_of(lambda: counted.extend(longer)))
    assert n_calls > 3

    def extended(run: Run, at: int) -> None:
        with pytest.MonkeyPatch.context() as patch:
            Faults(patch, killed).at = at
            run.extend(longer)

    for at in range(1, n_calls + 1):
        run = finished(f"run{at}")
        assert in_child(partial(extended, run, at)) == KILLED
        steps = run.read_config().train.steps
        has_field = (run.folder / "field.safetensors").exists()
        assert steps == 4000 or not has_field
        assert run.load_state()[0].progress.step == 5
