"""Runs of photographs without poses: their posed scene comes, stays and goes with the run.

COLMAP's answer is made up, as in tests/support/fake_colmap.py.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.fake_colmap import Colmap, listing, photographs
from warpnerf.checks import InputError
from warpnerf.cli import train as command
from warpnerf.cli.evaluate import eval_command
from warpnerf.cli.render import RenderOptions, render_command
from warpnerf.runs import files as run_files
from warpnerf.runs.lock import only_writer
from warpnerf.runs.run import Run
from warpnerf.scenes.formats.load import load_scene
from warpnerf.sfm import pose as module
from warpnerf.sfm import worker
from warpnerf.training.trainer import Trainer


@pytest.fixture(autouse=True)
def colmap(monkeypatch: pytest.MonkeyPatch) -> Colmap:
    made_up = Colmap()
    made_up.lens |= {"w": 16, "h": 12, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0}
    monkeypatch.setattr(module, "estimate", made_up)
    monkeypatch.setattr(module, "require_pycolmap", lambda: None)
    monkeypatch.setattr(worker, "is_installed", lambda: True)
    return made_up


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """The folder of a run of 12 photographs."""
    train(photographs(tmp_path / "old", 12, times=2), tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture
def others(tmp_path: Path) -> Path:
    """Eight photographs."""
    return photographs(tmp_path / "others", 8, times=2)


def train(source: Path | str, output: Path, **options: Any) -> None:
    tiny = {"steps": ("2",), "threads": ("1",), "grid.voxels": ("512",)}
    chosen = command.TrainOptions(scene=str(source), output=output, keep="checkpoint", **options)
    assert command.train_command(chosen, tiny) == 0


def interrupted(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


def images_of(run: Path) -> int:
    """Photographs of the scene that a run can be measured on."""
    assert eval_command(run, threads=1, split="all") == 0
    return len(load_scene(Run(run).read_config().scene).views)


def test_an_old_run_is_whole_until_the_new_one_begins(
    tmp_path: Path, old: Path, others: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = listing(old)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(command, "_read", interrupted)
        train(others, old, overwrite=True)
    assert before.items() <= listing(old).items() and images_of(old) == 12
    assert command.train_command(command.TrainOptions(resume=old)) == 0
    colmap.job = {}
    train(others, old, overwrite=True)
    assert not colmap.job  # the poses were there
    assert images_of(old) == 8 and len(list((old / "scene" / "images").iterdir())) == 8
    assert not (old / "next").exists() and not (old / "previous").exists()


def test_its_scene_is_put_aside_with_it(
    old: Path, others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (old / "scene" / "images" / "mine.txt").write_text("mine")
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "run", interrupted)
        train(others, old, overwrite=True)
    assert images_of(old / "previous") == 12
    assert len(load_scene(Run(old).read_config().scene).views) == 8
    train("builtin:room-sparse", old, overwrite=True, downscale=8)
    assert not (old / "previous").exists()
    left = [path for path in (old / "scene").rglob("*") if path.is_file()]
    assert left == [old / "scene" / "images" / "mine.txt"]


def test_the_same_photographs_serve_both_runs(
    tmp_path: Path, old: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    colmap.job = {}
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Trainer, "run", interrupted)
        train(tmp_path / "old", old, overwrite=True)
    assert not colmap.job
    assert listing(old / "scene") == listing(old / "previous" / "scene")
    assert images_of(old / "previous") == 12
    train(tmp_path / "old", old, overwrite=True)
    assert images_of(old) == 12 and not (old / "previous").exists()


@pytest.mark.parametrize("inside", ["transforms.json", "sparse/0"])
def test_a_new_run_of_a_file_in_the_run_s_scene_keeps_it(old: Path, inside: str) -> None:
    (old / "scene" / "sparse" / "0").mkdir(parents=True, exist_ok=True)
    run_files.set_aside(old, in_use=old / "scene" / inside)
    assert len(load_scene(old / "scene").views) == 12


def test_a_scene_in_the_place_of_older_runs_is_refused(old: Path) -> None:
    before = listing(old)
    with pytest.raises(InputError, match=r"lies in .*previous, which makes room"):
        run_files.set_aside(old, in_use=old / "previous" / "scene")
    assert listing(old) == before


def test_poses_for_a_run_that_never_began_go_with_the_next(
    tmp_path: Path, others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(command, "_read", interrupted)
        train(others, tmp_path / "run")
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["next"]
    train("builtin:room-sparse", tmp_path / "run", downscale=8)
    assert not {"next", "scene"} & {path.name for path in (tmp_path / "run").iterdir()}


def test_a_run_can_be_moved_with_its_scene(tmp_path: Path, old: Path) -> None:
    assert json.loads((old / "config.json").read_text())["scene"] == "scene"
    moved = old.rename(tmp_path / "moved")
    assert images_of(moved) == 12
    assert command.train_command(command.TrainOptions(resume=moved)) == 0
    assert render_command(moved, RenderOptions(stills="test", output=tmp_path / "pictures")) == 0


def test_masks_come_with_the_scene(tmp_path: Path, others: Path) -> None:
    masks = photographs(tmp_path / "masks", 8, times=2)
    train(others, tmp_path / "run", masks=masks)
    masks.rename(tmp_path / "elsewhere")
    assert Run(tmp_path / "run").read_config().masks is None
    assert images_of(tmp_path / "run") == 8


@pytest.mark.skipif(sys.platform == "win32", reason="nothing is locked there")
def test_nobody_else_begins_while_poses_are_estimated_and_scenes_read(
    tmp_path: Path, others: Path, colmap: Colmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def locked(real: Any) -> Any:
        def call(*arguments: Any) -> Any:
            message = "is training into this folder"
            with pytest.raises(InputError, match=message), only_writer(tmp_path / "run"):
                pass
            seen.append(real)
            return real(*arguments)

        return call

    monkeypatch.setattr(module, "estimate", locked(colmap))
    monkeypatch.setattr(command, "_read", locked(command._read))
    train(others, tmp_path / "run")
    assert len(seen) == 2


def test_interrupted_while_poses_are_estimated_nothing_is_left(
    tmp_path: Path, others: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "estimate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train(others, tmp_path / "runs" / "new")
    assert list(tmp_path.iterdir()) == [others]
