"""The folder of a run, and that no failure at any point of a save costs what was saved before."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.tiny_fields import assert_same_state, tiny_state
from tests.training.test_determinism import small_scene
from warpnerf import writing
from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.runs.checkpoint import load_field
from warpnerf.runs.run import Run
from warpnerf.training.state import Progress, TrainingState

CALLS = ("open", "write", "fsync", "close", "replace", "unlink", "mkdir", "rmdir")
"""The system calls, by their names in ``os``, that a save may make."""

KILLED = 9

state_of = cache(tiny_state)


class Faults:
    """Counts the system calls of a save, and lets one of them go wrong."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, act: Callable[[str], None]) -> None:
        self.calls: list[str] = []
        self.at: int | None = None
        self.written = b""
        self._act = act
        for name in CALLS:
            monkeypatch.setattr(os, name, self._counted(name, getattr(os, name)))

    def _counted(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*arguments: Any, **options: Any) -> Any:
            self.calls.append(name)
            if len(self.calls) == self.at:
                if name == "write":  # fails half way
                    real(arguments[0], arguments[1][: len(arguments[1]) // 2])
                self._act(name)
            result = real(*arguments, **options)
            if name == "write":
                self.written += bytes(arguments[1][:result])
            return result

        return call


def disk_full(name: str) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def killed(name: str) -> None:
    os._exit(KILLED)


def new_run(folder: Path) -> Run:
    run = Run(folder)
    run.create(small_scene(), "builtin:room", 1, 2.0, TrainConfig())
    return run


def run_with(folder: Path, *steps: int) -> Run:
    """A run that has saved these steps."""
    run = new_run(folder)
    for step in steps:
        run.save_checkpoint(state_of(step))
    return run


def steps_in(run: Run) -> list[str]:
    return [path.name for path in run.checkpoints]


def temporary(folder: Path) -> list[Path]:
    return list(folder.rglob(".*"))


def calls_of(act: Callable[[], Any]) -> list[str]:
    """The system calls that something makes when all goes well."""
    with pytest.MonkeyPatch.context() as patch:
        faults = Faults(patch, disk_full)
        act()
    return faults.calls


def in_child(act: Callable[[], Any]) -> int:
    """Run something in a process of its own; its exit status."""
    child = os.fork()
    if child == 0:
        try:
            act()
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.fixture(autouse=True)
def several_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "CHUNK", 3000)


def require_old_or_new(folder: Path, old: int, new: int) -> None:
    """What can be read, to resume from and to render, is one of two steps, whole."""
    state, notes = Run(folder).load_state()
    assert state.progress.step in (old, new)
    assert notes == []
    assert_same_state(state, state_of(state.progress.step))
    field, _ = Run(folder).load_field("cpu", 1)
    expected = state_of(state.progress.step).field.storage.values.numpy()
    assert (field.storage.values.numpy() == expected).all()


def test_all_of_a_save_goes_through_the_calls_that_fail_below(tmp_path: Path) -> None:
    run, state = run_with(tmp_path, 1, 2), state_of(3)
    with pytest.MonkeyPatch.context() as patch:
        faults = Faults(patch, disk_full)
        run.save_checkpoint(state)
    n_writes = faults.calls.count("write")
    assert n_writes > 5
    before, after = ["open", *n_writes * ["write"], "fsync", "close"], ["open", "fsync", "close"]
    assert faults.calls == [*before, "replace", *after, "unlink"]
    assert faults.written == run.checkpoints[0].read_bytes()


def test_a_full_disk_at_any_call_costs_nothing_that_was_saved(tmp_path: Path) -> None:
    counted = run_with(tmp_path / "counted", 1, 2)
    n_calls = len(calls_of(lambda: counted.save_checkpoint(state_of(3))))
    for at in range(1, n_calls + 1):
        run = run_with(tmp_path / f"run{at}", 1, 2)
        with pytest.MonkeyPatch.context() as patch:
            faults = Faults(patch, disk_full)
            faults.at = at
            with pytest.raises(
                InputError, match=r"run\d+ cannot be written: No space left"
            ) as full:
                run.save_checkpoint(state_of(3))
        assert f"continue after step {run.last_step} with: {run.resume_command}" in str(full.value)
        require_old_or_new(run.folder, 2, 3)
        assert temporary(run.folder) == []
        run.save_checkpoint(state_of(4))  # with room again
        require_old_or_new(run.folder, 4, 4)


def test_killed_at_any_call_an_old_or_the_new_checkpoint_is_whole(tmp_path: Path) -> None:
    run, state = run_with(tmp_path, 1, 2), state_of(3)
    n_calls = len(calls_of(lambda: run.save_checkpoint(state)))
    outcomes = []
    for at in range(1, n_calls + 1):
        old, new = 2 + at, 3 + at  # killed again and again, with no room to clean up between

        state = state_of(new)

        def save(at: int = at, state: TrainingState = state) -> None:
            with pytest.MonkeyPatch.context() as patch:
                Faults(patch, killed).at = at
                run.save_checkpoint(state)

        assert in_child(save) == KILLED
        require_old_or_new(tmp_path, old, new)
        outcomes.append(run.last_step == new)
        assert len(temporary(tmp_path)) <= 1
        run.save_checkpoint(state_of(new))
        assert temporary(tmp_path) == []
        assert len(run.checkpoints) == 2
    assert outcomes == sorted(outcomes)  # the old one up to some call, from there on the new one
    assert set(outcomes) == {False, True}


def test_killed_while_it_finishes_the_last_checkpoint_or_the_field_is_whole(tmp_path: Path) -> None:
    state = state_of(2)
    values = state.field.storage.values.numpy()
    counted = run_with(tmp_path / "counted", 1, 2)
    n_calls = len(calls_of(lambda: counted.save_field(state.field, keep_checkpoints=False)))
    assert n_calls > 8 and [path.name for path in counted.results] == ["field.safetensors"]
    outcomes = set()
    for at in range(1, n_calls + 1):
        run = run_with(tmp_path / f"run{at}", 1, 2)

        def save(run: Run = run, at: int = at) -> None:
            with pytest.MonkeyPatch.context() as patch:
                Faults(patch, killed).at = at
                run.save_field(state.field, keep_checkpoints=False)

        assert in_child(save) == KILLED
        field, notes = run.load_field("cpu", 1)
        assert not notes
        np.testing.assert_allclose(field.storage.values.numpy(), values, rtol=1e-3, atol=1e-6)
        if (run.folder / "field.safetensors").exists():
            load_field(run.folder / "field.safetensors", threads=1)
        else:
            require_old_or_new(run.folder, 1, 2)
        outcomes.add(len(run.checkpoints))
        run.save_field(state.field, keep_checkpoints=False)
        assert temporary(run.folder) == [] and run.checkpoints == []
    assert outcomes == {2, 1}


def test_killed_over_and_over_leaves_one_temporary_file(tmp_path: Path) -> None:
    run = run_with(tmp_path, 1, 2)

    def save() -> None:
        with pytest.MonkeyPatch.context() as patch:
            Faults(patch, killed).at = 5
            run.save_checkpoint(state_of(3))

    for _ in range(4):
        assert in_child(save) == KILLED
        assert len(temporary(tmp_path)) == 1
    require_old_or_new(tmp_path, 2, 2)


def test_interrupted_at_any_call_nothing_is_lost_or_left(tmp_path: Path) -> None:
    """By a second Ctrl-C."""

    def interrupt(name: str) -> None:
        raise KeyboardInterrupt

    run = run_with(tmp_path, 1, 2)
    n_calls = len(calls_of(lambda: run.save_checkpoint(state_of(3))))
    for at in range(1, n_calls + 1):
        with pytest.MonkeyPatch.context() as patch:
            Faults(patch, interrupt).at = at
            with pytest.raises(KeyboardInterrupt):
                run.save_checkpoint(state_of(3 + at))
        require_old_or_new(tmp_path, 2 + at, 3 + at)
        assert temporary(tmp_path) == []
        run.save_checkpoint(state_of(3 + at))


def whole_steps(folder: Path) -> set[int]:
    """The steps of what ``eval`` would read in a folder and in previous/."""
    steps = set()
    for place in (folder, folder / "previous"):
        if Run(place).results and (place / "config.json").exists():
            field, notes = Run(place).load_field("cpu", 1)
            assert notes == []
            values = field.storage.values.numpy()
            same = [
                n
                for n in (1, 8, 9)
                if np.allclose(values, state_of(n).field.storage.values.numpy(), 1e-3, 1e-6)
            ]
            steps.update(same)
    return steps


@pytest.mark.parametrize("finished", [False, True])
def test_killed_while_replacing_a_run_one_of_the_two_is_whole(
    tmp_path: Path, finished: bool
) -> None:
    """Up to the first checkpoint of the new run, the old one is in the folder or in previous/."""

    def old_run(name: str) -> Path:
        run = run_with(tmp_path / name, 8, 9)
        if finished:
            run.save_field(state_of(9).field)
        return run.folder

    def replaced(folder: Path, at: int | None) -> None:
        with pytest.MonkeyPatch.context() as patch:
            Faults(patch, killed).at = at
            new_run(folder).save_checkpoint(state_of(1))

    counted = old_run("counted")
    n_calls = len(calls_of(lambda: replaced(counted, None)))
    for at in range(1, n_calls + 1):
        folder = old_run(f"run{at}")
        assert in_child(lambda folder=folder, at=at: replaced(folder, at)) == KILLED
        assert whole_steps(folder) & {1, 9}
        new_run(folder)  # another one, that ends before it has saved anything
        assert whole_steps(folder) & {1, 9}
        replaced(folder, None)
        require_old_or_new(folder, 1, 1)
        assert not (folder / "previous").exists()
        assert not (folder / "field.safetensors").exists()
        assert temporary(folder) == []


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
