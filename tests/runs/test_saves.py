"""No failure at any point of a save costs what was saved before."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from tests.support.faulty_saves import (
    KILLED,
    Faults,
    calls_of,
    disk_full,
    in_child,
    killed,
    new_run,
    require_old_or_new,
    run_with,
    state_of,
    temporary,
)
from warpnerf import writing
from warpnerf.checks import InputError
from warpnerf.runs.checkpoint import load_field
from warpnerf.runs.run import Run
from warpnerf.training.state import TrainingState


@pytest.fixture(autouse=True)
def several_writes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writing, "CHUNK", 3000)


def test_all_of_a_save_goes_through_the_calls_that_fail_below(tmp_path: Path) -> None:
    run, state = run_with(tmp_path, 1, 2), state_of(3)
    with pytest.MonkeyPatch.context() as patch:
        faults = Faults(patch, disk_full)
        run.save_checkpoint(state)
    n_writes = faults.calls.count("write")
    assert n_writes > 5
    before, after = (
        ["unlink", "open", *n_writes * ["write"], "fsync", "close"],
        ["open", "fsync", "close"],
    )
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


@pytest.mark.ci
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


@pytest.mark.ci
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


def test_what_another_process_writes_stays(tmp_path: Path) -> None:
    """Such as an export into the folder of a run that is trained; not what is left of a process
    that had this one's number, as in containers."""
    run = run_with(tmp_path, 1)
    numbers = (os.getppid(), os.getpid(), 4194304999)  # the last one is no process's
    alive, *left = (tmp_path / f".mesh.npz.{number}.tmp" for number in numbers)
    for path in (alive, *left):
        path.write_bytes(b"")
    run.save_checkpoint(state_of(2))
    assert temporary(tmp_path) == [alive]


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


@pytest.mark.ci
@pytest.mark.parametrize("finished", [pytest.param(False, marks=pytest.mark.slow), True])
def test_killed_while_replacing_a_run_one_of_the_two_is_whole(
    tmp_path: Path, finished: bool
) -> None:
    """Killed at any call up to the first checkpoint of the new run, the old one is in the folder or
    in previous/."""

    def old_run(name: str) -> Path:
        run = run_with(tmp_path / name, 8, 9)
        if finished:
            run.save_field(state_of(9).field)
        return run.folder

    def replaced(folder: Path, at: int | None) -> None:
        with pytest.MonkeyPatch.context() as patch:
            Faults(patch, killed).at = at
            new_run(folder).save_checkpoint(state_of(1))

    replaced(old_run("first"), None)  # which may write what later ones find
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
