"""Several processes that train one scene, by torch.distributed on this machine."""

from __future__ import annotations

import os
import re
import signal
import sys
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.cli_process import make_scene
from tests.support.several import Ended, several
from tests.support.tiny_trainings import STEPS, ball, tiny_config
from tests.support.tiny_trainings import early_growth as early_growth
from warpnerf.checks import InputError
from warpnerf.cli.main import main
from warpnerf.cli.processes import share_of_machine
from warpnerf.runtime.memory import zero_bytes
from warpnerf.training import exposure
from warpnerf.training.peers import Peers
from warpnerf.training.trainer import Trainer

processes = pytest.importorskip("warpnerf.torch.processes")
if sys.platform != "linux":
    pytest.skip("processes of these tests are forks", allow_module_level=True)


@pytest.fixture(autouse=True)
def _forks(on_cpu: None) -> None:
    """A GPU may not be used in forks."""


def recorded(peers: Peers) -> list[dict[str, np.ndarray]]:
    """From now on, the gradients of each update, summed over processes."""
    found: list[dict[str, np.ndarray]] = []
    add = peers.add

    def adding(accumulated: Any, workers: Any) -> None:
        add(accumulated, workers)
        gradients, _ = accumulated[0]
        arrays = {name: array.numpy().copy() for name, array in gradients.arrays.items()}
        arrays["weights"] = arrays["weights"].sum(axis=0)
        found.append(arrays)

    peers.add = adding  # type: ignore[method-assign]
    return found


def trained(peers: Peers, file: Path) -> int:
    """Train, and write the first update's gradients and the field to a file."""
    found = recorded(peers)
    trainer = Trainer(ball(), tiny_config(appearance="auto"), peers=peers)
    progress = trainer.run()
    fields = {f"field.{name}": array for name, array in trainer.storage.tensors().items()}
    fields |= {"field.weights": trainer.weights.numpy()}
    assert trainer.exposures is not None and trainer.exposures.used
    fields |= {"field.exposures": trainer.exposures.sums.numpy()}
    np.savez(file, **found[0], **fields, loss=progress.loss, n_updates=len(found))
    return 0


def test_processes_with_a_share_of_the_rays_are_one_with_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To rounding, which Adam blows up after the first update; and to the bit each other, and when
    done again, where gradients are copied to shared memory, or one cannot reach the first's."""
    for name, value in (("FIRST_RAYS", 0), ("JUDGED_RAYS", 9), ("DIFFERENT", 0.0)):
        monkeypatch.setattr(exposure, name, value)
    alone = tmp_path / "alone.npz"
    trained(Peers(), alone)
    for turn, (rows, launched) in enumerate([(2, STEPS), (2, 0), (1, 0)]):

        def one_of_two(rank: int, turn: int = turn) -> int:
            if turn == 2 and rank == 1:
                processes.opened = lambda place, n_bytes: None
            peers, shares = processes.Processes(), []
            add_share = peers._add_shared
            peers._add_shared = lambda *given: shares.append(add_share(*given))
            if turn == 1:
                peers.zeros = zero_bytes  # type: ignore[method-assign]
            trained(peers, tmp_path / f"{turn}{rank}.npz")
            return 100 * len(peers._room) + len(shares)

        done = several(one_of_two, tmp_path)
        assert [ended.code for ended in done] == 2 * [100 * rows + launched], done
    one, *others = (np.load(tmp_path / f"{turn}{rank}.npz") for turn in "012" for rank in "01")
    for other in others:
        assert all(np.array_equal(one[name], other[name]) for name in one.files if name != "loss")
    with np.load(alone) as expected:
        for name in ("values", "weights"):
            largest = np.abs(expected[name]).max()
            assert largest > 0.0
            np.testing.assert_allclose(one[name], expected[name], rtol=0.0, atol=2e-6 * largest)
        assert np.array_equal(one["touched"] != 0, expected["touched"] != 0)
        assert int(one["n_updates"]) == int(expected["n_updates"]) == STEPS
        counts = [of["field.exposures"].reshape(3, 3, 5)[..., 0] for of in (one, expected)]
        np.testing.assert_allclose(*counts, rtol=1e-5)  # of the same rays
        assert counts[0].min() > 0.0
        assert one["field.values"].shape == expected["field.values"].shape  # it has grown alike
        assert np.abs(one["field.values"] - expected["field.values"]).mean() < 0.05


def test_a_field_that_is_all_in_shared_memory(tmp_path: Path) -> None:
    """Without a head, no weights are sent."""

    def one_of_two(rank: int) -> int:
        peers = processes.Processes()
        trainer = Trainer(ball(), tiny_config(model="rgb", steps=3, appearance="none"), peers=peers)
        trainer.run()
        np.save(tmp_path / f"{rank}.npy", trainer.storage.tensors()["values"])
        return 0 if peers._room is None else 1

    done = several(one_of_two, tmp_path)
    assert [ended.code for ended in done] == [0, 0], done
    one, other = (np.load(tmp_path / f"{rank}.npy") for rank in range(2))
    assert np.array_equal(one, other)


# --- The command --------------------------------------------------------------------------------

TINY = ("--steps", "6", "--voxels", "512", "--threads", "1", "--eval-views", "none")


def command(scene: Path, run: Path, *options: str) -> int:
    return main(["train", str(scene), "--output", str(run), *TINY, *options])


def sentences(ended: list[Ended]) -> list[str]:
    """What processes said of errors, line by line."""
    lines = [line for one in ended for line in one.err.splitlines()]
    return [line for line in lines if line.startswith("warpnerf: ")]


@pytest.mark.ci
@pytest.mark.parametrize(
    ("lost", "by"), [(1, signal.SIGKILL), (1, signal.SIGSTOP), (0, signal.SIGKILL)]
)
def test_a_lost_process_ends_the_others_with_a_checkpoint(
    lost: int, by: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From which another number of processes resumes."""
    monkeypatch.setattr(processes, "PATIENCE", timedelta(seconds=5))
    scene, run, update = make_scene(tmp_path), tmp_path / "run", Trainer.update

    def lost_after_three(trainer: Trainer) -> None:
        if trainer._updates == 3 and trainer.peers.rank == lost:
            os.kill(os.getpid(), by)
        update(trainer)

    def one(rank: int) -> int:
        Trainer.update = lost_after_three  # type: ignore[method-assign]
        return command(scene, run)

    done = several(one, tmp_path, killed_after=1 - lost)
    assert done[1 - lost].code == 1 and done[lost].code == -signal.SIGKILL, done
    (sentence,) = sentences(done)
    (checkpoint,) = run.glob("checkpoint-*")
    step = int(re.findall(r"\d+", checkpoint.name)[0])
    assert f"has ended, or hangs; continue after step {step} with: warpnerf train" in sentence
    assert main(["train", "--resume", str(run), "--eval-views", "none"]) == 0
    assert (run / "field.safetensors").exists()


@pytest.mark.parametrize("lost", [0, 1])
def test_one_that_is_lost_while_the_grid_grows_ends_the_others_likewise(
    lost: int, tmp_path: Path
) -> None:
    scene, run, grow = make_scene(tmp_path), tmp_path / "run", Trainer._grow
    growing: list[int] = []

    def grown(trainer: Trainer, fraction: float) -> None:
        growing.append(trainer._updates)
        grow(trainer, fraction)
        growing.clear()

    def one(rank: int) -> int:
        zeros = processes.Processes.zeros

        def lost_in_growth(peers: Any, n_bytes: int) -> np.ndarray:
            if growing and growing[0] > 0 and rank == lost:
                os.kill(os.getpid(), signal.SIGKILL)
            return np.asarray(zeros(peers, n_bytes))

        Trainer._grow = grown  # type: ignore[method-assign]
        processes.Processes.zeros = lost_in_growth
        return command(scene, run, "--steps", "20")

    done = several(one, tmp_path, killed_after=1 - lost)
    assert done[1 - lost].code == 1 and done[lost].code == -signal.SIGKILL, done
    said = "has ended, or hangs; continue after step"
    assert [said in sentence for sentence in sentences(done)] == [True]
    assert main(["train", "--resume", str(run), "--eval-views", "none"]) == 0


def test_a_gpu_with_a_number_is_refused() -> None:
    config = tiny_config(device="cuda:1")
    with pytest.raises(InputError, match="--device cuda:1 does not go with several processes"):
        share_of_machine(config, {"device": ("cuda:1",)})
    assert share_of_machine(config, {}).device == "cuda:0"  # as it was begun, elsewhere


@pytest.mark.ci
def test_processes_that_train_otherwise_are_refused(tmp_path: Path) -> None:
    scene, run = make_scene(tmp_path), tmp_path / "run"
    for options, name in ((("--seed", "1"), "configuration"), (("--downscale", "2"), "scene")):

        def one(rank: int, options: tuple[str, ...] = options) -> int:
            return command(scene, run, *(options if rank == 1 else ()))

        done = several(one, tmp_path)
        assert [ended.code for ended in done] == [2, 2], done
        (sentence,) = sentences(done)
        assert f"process 1 trains with another {name} than process 0" in sentence
        assert not run.exists()
    done = several(lambda rank: command(scene, run, "--eval-every", "2"), tmp_path)
    assert [ended.code for ended in done] == [2, 2], done
    (sentence,) = sentences(done)
    assert "--eval-every does not go with several processes" in sentence
    (run / "of_others").mkdir(parents=True)  # only the first process looks there
    done = several(lambda rank: command(scene, run), tmp_path)
    assert [ended.code for ended in done] == [2, 2], done
    (sentence,) = sentences(done)
    assert "holds other files; name a new folder" in sentence


def test_of_a_loss_that_is_not_finite_in_one_process_the_first_tells(tmp_path: Path) -> None:
    scene, run, update = make_scene(tmp_path), tmp_path / "run", Trainer.update

    def runs_away(trainer: Trainer) -> None:
        update(trainer)
        if trainer._updates == 3 and trainer.peers.rank == 1:
            trainer._pass.loss.fill_(float("nan"))

    def one(rank: int) -> int:
        Trainer.update = runs_away  # type: ignore[method-assign]
        return command(scene, run)

    done = several(one, tmp_path)
    assert [ended.code for ended in done] == [1, 1], done
    (sentence,) = sentences(done[:1])
    assert "the loss is not finite after step 3" in sentence and not sentences(done[1:])


def test_one_writes_and_prints_and_one_that_is_stopped_stops_all(tmp_path: Path) -> None:
    scene, run, update = make_scene(tmp_path), tmp_path / "run", Trainer.update

    def stopped_after_three(trainer: Trainer) -> None:
        update(trainer)
        if trainer._updates == 3 and trainer.peers.rank == 1:
            for _ in range(2):  # as a terminal and torchrun both do
                os.kill(os.getpid(), signal.SIGTERM)

    def one(rank: int) -> int:
        Trainer.update = stopped_after_three  # type: ignore[method-assign]
        return command(scene, run)

    done = several(one, tmp_path)
    assert [ended.code for ended in done] == [143, 143], done
    assert "stopped and saved after step" in done[0].out and not done[1].out

    def resumed(rank: int) -> int:
        return main(["train", "--resume", str(run), "--eval-views", "none"])

    done = several(resumed, tmp_path)
    assert [ended.code for ended in done] == [0, 0], done
    assert "resuming after step" in done[0].out and not done[1].out
    assert (run / "field.safetensors").exists() and not (run / ".lock").exists()
