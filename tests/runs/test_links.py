"""A run writes and removes only what lies in its own folder, by no link."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import msgspec
import pytest

from tests.support.faulty_saves import run_with, state_of
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.runs.lock import only_writer
from warpnerf.sfm.scene_files import Record, remove_written
from warpnerf.writing import open_to_append

FILES = (".lock", "config.json", "log.jsonl", "metrics.json", "test.png", "field.safetensors")
LATER = ("checkpoint-00000010.safetensors", "test/view.png", "previous/config.json")
MORE = ("log.csv", "curves.png")
FOLDERS = ("test", "previous", "previous/test", "scene", "next", "next/scene", "scene/images")


def begun(folder: Path) -> Path:
    """The folder of a run, and beside it what a link may lead to."""
    for inner in ("run/test", "run/previous", "run/next", "elsewhere"):
        (folder / inner).mkdir(parents=True, exist_ok=True)
    return folder / "run"


@pytest.mark.parametrize("name", [*FILES, *LATER, *MORE])
@pytest.mark.parametrize("dangling", [False, True])
def test_a_link_in_place_of_a_file_is_refused(tmp_path: Path, name: str, dangling: bool) -> None:
    run, target = begun(tmp_path), tmp_path / "elsewhere" / "file"
    if not dangling:
        target.write_text("precious")
    (run / name).symlink_to(target)
    with pytest.raises(InputError, match=f"{name} is a link, .* remove the link"), only_writer(run):
        pass
    assert target.read_text() == "precious" if not dangling else not target.exists()


@pytest.mark.parametrize("name", [*FOLDERS, "tensorboard"])
def test_a_link_in_place_of_a_folder_is_refused(tmp_path: Path, name: str) -> None:
    run = begun(tmp_path)
    (run / name).parent.mkdir(exist_ok=True)
    if (run / name).exists():
        (run / name).rmdir()
    (run / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match=f"{name} is a link"), only_writer(run):
        pass


@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() == 0, reason="root may look anywhere")
def test_a_folder_that_may_not_be_looked_into(tmp_path: Path) -> None:
    run = begun(tmp_path)
    run.chmod(0o600)
    with pytest.raises(InputError, match=r"run cannot be written: .*give access"), only_writer(run):
        pass


def test_a_name_that_is_too_long(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"), only_writer(tmp_path / ("x" * 300)):
        pass


@pytest.mark.parametrize("name", [*FILES, *LATER, *MORE])
def test_a_pipe_is_not_waited_for(tmp_path: Path, name: str) -> None:
    run = begun(tmp_path)
    os.mkfifo(run / name)
    with pytest.raises(InputError, match=f"{name} is neither a file nor"), only_writer(run):
        pass


def test_what_is_not_the_run_s_may_be_a_link(tmp_path: Path) -> None:
    run = begun(tmp_path)
    for name in ("photographs", "test/notes.txt", "weights.safetensors"):
        (run / name).symlink_to(tmp_path / "elsewhere")
    (tmp_path / "by_link").symlink_to(run)
    for folder in (run, tmp_path / "by_link"):
        with only_writer(folder):
            pass


def test_a_copy_by_hard_links_stays_as_it_is(tmp_path: Path) -> None:
    """When the run is resumed from a checkpoint."""
    run = run_with(tmp_path / "run", 1)
    run.log(state_of(1).progress)
    run.open_log("csv")
    shutil.copytree(run.folder, tmp_path / "copy", copy_function=os.link)
    before = {path: path.read_bytes() for path in (tmp_path / "copy").glob("*") if path.is_file()}
    run.rewind_log(1)
    run.log(state_of(2).progress)
    run.write_to(run.open_log("csv"), state_of(2).progress)
    run.save_checkpoint(state_of(2))
    assert {path.name for path in before} >= {"log.jsonl", "log.csv", "config.json"}
    assert all(path.read_bytes() == content for path, content in before.items())


@pytest.mark.parametrize("name", ["log.jsonl", "log.csv"])
def test_a_link_that_comes_during_a_training_is_not_followed(tmp_path: Path, name: str) -> None:
    run, precious = run_with(tmp_path / "run", 1), tmp_path / "precious"
    log = run.open_log("csv")
    precious.write_text("precious")
    (run.folder / name).unlink(missing_ok=True)
    (run.folder / name).symlink_to(precious)
    with pytest.raises(InputError, match=f"cannot be written: {name} is a link"):
        run.log(state_of(2).progress)
        run.write_to(log, state_of(2).progress)
    assert precious.read_text() == "precious"


def test_nobody_is_waited_for_who_would_read_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "log")
    with pytest.raises(OSError, match="log"):
        open_to_append(tmp_path / "log")


def test_measures_are_not_added_through_a_link(tmp_path: Path) -> None:
    run, precious = run_with(tmp_path / "run", 1), tmp_path / "precious"
    precious.write_text('{"mean": {}}')
    (run.folder / "metrics.json").symlink_to(precious)
    assert main(["eval", str(run.folder), "--measures"]) == 2
    assert precious.read_text() == '{"mean": {}}'


def test_a_record_removes_no_folder_elsewhere(tmp_path: Path) -> None:
    scene, other = tmp_path / "scene", tmp_path / "other"
    for folder in (scene / "images", other / "empty", tmp_path / "next to it"):
        folder.mkdir(parents=True)
    (scene / "images" / "a.png").write_bytes(b"a")
    names = ["images/a.png", f"{other}/empty/b.png", "../next to it/c.png"]
    record = msgspec.convert({"made_of": {}, "written": names}, Record)
    remove_written(scene, record)
    assert (other / "empty").is_dir() and (tmp_path / "next to it").is_dir()
    assert not (scene / "images").exists() and scene.is_dir()
