"""One training in several processes, as torchrun starts them; the first one writes."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from warpnerf.checks import InputError, require_extra
from warpnerf.cli.given import Given
from warpnerf.cli.machine import FAILED
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_to_json
from warpnerf.runtime.child import is_child
from warpnerf.runtime.memory import processes_here, usable_cores
from warpnerf.runtime.signals import Stopped, StopRequest

if TYPE_CHECKING:
    from warpnerf.runs.run import Run
    from warpnerf.scenes.scene import Scene
    from warpnerf.training.peers import PeerLostError, Peers
    from warpnerf.training.trainer import Trainer

BAD_INPUT = 2
STOPPED = 143
"""What a process exits with that stops because another one was told to: as after SIGTERM."""
PATIENCE = 5.0
"""Seconds in which a terminal or scheduler, and whoever started this process, both pass on one
request."""


def are_several() -> bool:
    """Whether this is one of the processes that torchrun, or who sets its variables, started."""
    return "RANK" in os.environ and os.environ.get("WORLD_SIZE", "1") != "1"


def together(train: Callable[[Peers], int]) -> int:
    """Train as one of several processes. The first one prints; of an error, one tells.

    Args:
        train: The command in one process.

    Returns:
        Its exit code.

    Raises:
        InputError: Input is bad, and no other process has told.
        FloatingPointError: A short training fails likewise.
    """
    require_extra("torch", "torch", "training in several processes")
    from warpnerf.torch.processes import Processes
    from warpnerf.training.peers import PeerLostError

    peers = Processes()
    if peers.rank > 0:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115
    try:
        return train(peers)
    except (InputError, FloatingPointError) as error:
        if peers.is_first_to_fail():
            raise
        return BAD_INPUT if isinstance(error, InputError) else FAILED
    except PeerLostError as error:  # before the first update
        return _told_once(peers, error)


def share_of_machine(config: TrainConfig, given: Given) -> TrainConfig:
    """A configuration with this process's share of the cores, or its own GPU.

    Raises:
        InputError: One GPU is named for all processes.
    """
    if ":" in "".join(given.get("device", ())):
        raise InputError(
            f"--device {config.device} does not go with several processes, of which each has its "
            "own GPU; give --device cuda, and choose GPUs by CUDA_VISIBLE_DEVICES."
        )
    if config.device.startswith("cuda"):
        config = replace(config, device=f"cuda:{os.environ.get('LOCAL_RANK', '0')}")
    if "threads" in given:
        return config
    return replace(config, threads=max(1, usable_cores() // processes_here()))


def identity(scene: Scene, config: TrainConfig) -> dict[str, str]:
    """What all processes of a training must have in common."""
    from warpnerf.training.state import scene_digest

    same = config_to_json(replace(config, device="cpu", threads=None))
    return {
        "scene": scene_digest(scene),
        "configuration": json.dumps(same, sort_keys=True),
        "kind of device": config.device.partition(":")[0],
    }


def patience(peers: Peers) -> float:
    """For how many seconds further signals are no second request to stop."""
    return PATIENCE if peers.count > 1 or is_child() else 0.0


def exit_code_of(stop: StopRequest, trainer: Trainer) -> int | None:
    """What a training that was stopped exits with; None where it has come to its end."""
    if stop.exit_code is None and trainer.peers.count > 1 and trainer.fraction < 1.0:
        return STOPPED
    return stop.exit_code


def follow(run: Run, trainer: Trainer) -> int:
    """Train beside the first process, which writes."""
    from warpnerf.training.peers import PeerLostError

    with StopRequest(PATIENCE) as stop:
        try:
            trainer.run(None, lambda state: None, lambda: stop.asked, checkpoint_when_done=False)
        except PeerLostError as error:
            if trainer.steps_done == 0:  # what the folder holds may be of a run before
                return _told_once(trainer.peers, error)
            return saved_alone(run, trainer, error)
        except FloatingPointError:  # of which the first process tells
            return FAILED
        except Stopped as stopped:
            return stopped.exit_code
        return exit_code_of(stop, trainer) or 0


def saved_alone(run: Run, trainer: Trainer, error: PeerLostError) -> int:
    """End a training that has lost a process, with a checkpoint of the last update.

    The first process saves it; where that is the one that has ended, whoever else can write to the
    run's folder.
    """
    if trainer.peers.rank == 0:
        return _ended(run, trainer, error)
    if not (run.folder / "config.json").exists():
        return FAILED
    try:
        with run.only_writer():
            return _ended(run, trainer, error)
    except InputError:  # the first process, or another one, is there
        return FAILED


def _ended(run: Run, trainer: Trainer, error: PeerLostError) -> int:
    try:
        if trainer.steps_done > (run.last_step or 0):
            run.save_checkpoint(trainer.state())
    except FloatingPointError:
        pass  # nothing to resume from; the checkpoint before stays
    return _told(f"{str(error).rstrip('.')}; {run.way_on()}.")


def _told_once(peers: Peers, error: PeerLostError) -> int:
    return _told(str(error)) if peers.is_first_to_fail() else FAILED


def _told(sentence: str) -> int:
    print(f"warpnerf: error: {sentence}", file=sys.stderr, flush=True)
    return FAILED
