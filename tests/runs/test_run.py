"""The folder of a run: what is kept in it, replaced, refused and removed."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from tests.support.faulty_saves import (
    Faults,
    disk_full,
    new_run,
    require_old_or_new,
    run_with,
    state_of,
)
from tests.support.tiny_fields import assert_same_state
from tests.training.test_determinism import small_scene
from warpnerf.checks import InputError
from warpnerf.runs.run import Run
from warpnerf.training.state import Progress, TrainingState


def steps_in(run: Run) -> list[str]:
    return [path.name for path in run.checkpoints]


def test_a_run_is_put_aside_until_the_next_has_saved_something(tmp_path: Path) -> None:
    run_with(tmp_path, 8, 9)
    picture = json.loads((tmp_path / "config.json").read_text())["pictures"][0]
    (tmp_path / "test" / picture).write_bytes(b"")
    (tmp_path / "notes.txt").write_text("mine")
    run = new_run(tmp_path)
    assert run.checkpoints == [] and list((tmp_path / "test").iterdir()) == []
    assert f"the run before is in {tmp_path / 'previous'}" in run.way_on()
    with pytest.raises(InputError, match="no checkpoint to resume from; the run before is in"):
        run.load_state()
    with pytest.raises(InputError, match=r"nothing was saved; the run before is in .*previous"):
        run.load_field("cpu", 1)
    require_old_or_new(tmp_path / "previous", 9, 9)
    new_run(tmp_path)  # once more, without having saved anything
    require_old_or_new(tmp_path / "previous", 9, 9)
    run.save_checkpoint(state_of(1))
    assert not (tmp_path / "previous").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_the_last_two_are_kept(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1, 20, 300, 4000)
    assert steps_in(run) == ["checkpoint-00004000.safetensors", "checkpoint-00000300.safetensors"]
    run = run_with(tmp_path, 99_999_999, 100_000_000)
    assert steps_in(run) == ["checkpoint-100000000.safetensors", "checkpoint-99999999.safetensors"]
    assert run.last_step == 10**8


def test_a_damaged_checkpoint_is_passed_over_with_a_note(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1, 2)
    newest = run.checkpoints[0]
    newest.write_bytes(newest.read_bytes()[:-1])
    state, notes = run.load_state()
    assert_same_state(state, state_of(1))
    assert len(notes) == 1 and str(newest) in notes[0]
    _, notes = run.load_field("cpu", 1)
    assert len(notes) == 1 and str(newest) in notes[0]
    # Resumed before it, and interrupted before it too: it must not push a good one out.
    run.save_checkpoint(replace(state_of(1), progress=replace(state.progress, step=1)))
    assert steps_in(run) == ["checkpoint-00000001.safetensors"]


def test_damaged_throughout_it_is_refused(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1, 2)
    for path in run.checkpoints:
        path.write_bytes(b"")
    with pytest.raises(InputError, match="is damaged"):
        run.load_state()
    with pytest.raises(InputError, match="is damaged"):
        run.load_field("cpu", 1)


def test_nothing_saved_is_said_so(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    with pytest.raises(InputError, match=r"holds no checkpoint.*--overwrite"):
        run.load_state()
    with pytest.raises(InputError, match="holds no field"):
        run.load_field("cpu", 1)


def test_reports_of_steps_to_be_done_again_are_dropped(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    run.rewind_log(0)  # no log yet
    progress: Progress = state_of(1).progress
    for step in (25, 50, 75):
        run.log(replace(progress, step=step))
    path = tmp_path / "log.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines) + lines[0][:20])  # cut off by a crash
    run.rewind_log(60)
    assert path.read_text() == "".join(lines[:2])
    run.log(replace(progress, step=75))
    assert path.read_text() == "".join(lines)


def test_a_taken_folder_names_both_ways_out(tmp_path: Path) -> None:
    run_with(tmp_path, 1)
    with pytest.raises(InputError, match=r"--resume .*--overwrite"):
        Run.require_free(tmp_path, overwrite=False)
    Run.require_free(tmp_path, overwrite=True)
    new_run(tmp_path)  # the one before is kept in previous/, and cannot be gone on with
    with pytest.raises(InputError, match=r"holds a run already; replace it by --overwrite"):
        Run.require_free(tmp_path, overwrite=False)


def test_a_run_that_saved_nothing_is_begun_anew(tmp_path: Path) -> None:
    run = new_run(tmp_path)
    with pytest.MonkeyPatch.context() as patch, pytest.raises(InputError) as error:
        Faults(patch, disk_full).at = 2
        run.save_checkpoint(state_of(1))
    assert "No space left on device; make room or give access, and begin again" in str(error.value)
    assert str(error.value).endswith("nothing was saved yet.")
    Run.require_free(tmp_path, overwrite=False)
    new_run(tmp_path)


def test_a_full_disk_at_the_start_leaves_what_was_there(tmp_path: Path) -> None:
    for folder in (tmp_path / "new", tmp_path):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "write", lambda *_: disk_full("write"))
            says = r"cannot be written: No space left .*; make room there, or name another place"
            with pytest.raises(InputError, match=says), Run(folder).only_writer():
                pass
        assert not any(tmp_path.iterdir())


def test_the_command_to_resume_is_quoted() -> None:
    assert Run("my runs/room").resume_command == "warpnerf train --resume 'my runs/room'"


def test_a_state_of_the_same_step_replaces_it(tmp_path: Path) -> None:
    run = run_with(tmp_path, 5)
    state = state_of(5)
    changed: TrainingState = replace(state, plan=replace(state.plan, reach=1.0))
    run.save_checkpoint(changed)
    assert_same_state(run.load_state()[0], changed)


def test_only_what_the_run_wrote_is_ever_removed(tmp_path: Path) -> None:
    run = run_with(tmp_path, 5)
    own = [tmp_path / "test" / f"{n}.png" for n in range(2)]
    names = [path.name for path in own]
    config = tmp_path / "config.json"
    content = json.loads(config.read_text())
    assert content["pictures"] and all(name.endswith(".png") for name in content["pictures"])
    config.write_text(json.dumps(content | {"pictures": names}))
    mine = [tmp_path / "test" / "mine.png", tmp_path / "notes.txt"]
    for path in [*own, *mine]:
        path.write_bytes(b"")
    new_run(tmp_path).save_checkpoint(state_of(9))
    assert all(path.exists() for path in mine)
    assert not any(path.exists() for path in own)
    assert not (tmp_path / "previous").exists()
    assert steps_in(run) == ["checkpoint-00000009.safetensors"]


def test_pictures_of_the_version_before_are_those_in_the_folder(tmp_path: Path) -> None:
    run_with(tmp_path, 5)
    config, picture = tmp_path / "config.json", tmp_path / "test" / "view.png"
    content = json.loads(config.read_text())
    del content["pictures"]
    config.write_text(json.dumps(content))
    picture.write_bytes(b"")
    new_run(tmp_path)
    assert not picture.exists() and (tmp_path / "previous" / "test" / "view.png").exists()


def test_what_a_failed_beginning_leaves_can_be_begun_in(tmp_path: Path) -> None:
    (tmp_path / "test").mkdir()
    (tmp_path / ".lock").write_text("1\n")
    Run.require_free(tmp_path, overwrite=False)
    (tmp_path / "test" / "mine.png").write_bytes(b"")
    with pytest.raises(InputError, match="holds other files"):
        Run.require_free(tmp_path, overwrite=True)


def test_pictures_have_a_folder_whatever_became_of_it(tmp_path: Path) -> None:
    run = run_with(tmp_path, 5)
    (tmp_path / "test").rmdir()
    run.evaluate(state_of(5).field, small_scene(), "train")
    assert any((tmp_path / "test").iterdir())
