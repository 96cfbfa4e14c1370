"""A short training of any storage, and what holds of all of them: files, resuming, exports."""

from pathlib import Path

import numpy as np

import warpnerf as wn
from tests.support.tiny_trainings import ball
from warpnerf.config import GridConfig, TrainConfig
from warpnerf.model.storage_kinds import StorageKind
from warpnerf.optim_config import OptimConfig
from warpnerf.runs.checkpoint import load_checkpoint, save_checkpoint
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

STEPS = 250
EXPORTS = ("mesh.ply", "points.ply", "volume.npz")


def config_of(field: StorageKind | str) -> TrainConfig:
    """It grows once, late enough for a state before that."""
    return TrainConfig(
        model="rgb",  # type: ignore[arg-type]
        field=field,  # type: ignore[arg-type]
        loss=wn.LossConfig(),
        background="random",
        steps=STEPS,
        rays_per_step=300,
        occupancy_every=40,
        coarse_steps=0,
        grid=GridConfig(voxels=4000, grow_at=(0.85,), alpha_init=1e-2),
        optim=OptimConfig(accumulate_at=()),
        threads=2,
    )


def states_of(config: TrainConfig, early: int) -> list[TrainingState]:
    """Of a training: after so many steps, before it has grown, and the last."""
    trainer, found = Trainer(ball(), config), []
    while trainer.fraction < 1.0:
        trainer.update()
        if trainer.steps_done in (early, STEPS):
            found.append(trainer.state().copied_to(trainer.workers.device))
    return found


def require_resumes(states: list[TrainingState], config: TrainConfig, path: Path) -> None:
    """From a file of the first state to the bits of the last."""
    save_checkpoint(path, states[0])
    trainer = Trainer(ball(), config, load_checkpoint(path))
    trainer.run()
    assert trainer.steps_done == STEPS
    expected = states[1].field.storage.tensors()
    for name, array in trainer.storage.tensors().items():
        assert np.array_equal(array, expected[name]), name


def require_files_hold(state: TrainingState, config: TrainConfig, path: Path) -> None:
    """The field comes back as its kind, and renders the same bits."""
    wn.save_field(path, state.field)
    loaded = wn.load_field(path, threads=1)
    assert type(loaded.storage) is type(state.field.storage)
    assert loaded.storage.kind == config.field
    camera = ball().cameras[0]
    assert np.array_equal(loaded.render(camera).rgb, state.field.render(camera).rgb)


def require_exported(state: TrainingState, path: Path) -> None:
    """Something is written, of what its ending says."""
    wn.export(state.field, path)
    assert path.stat().st_size > 1000
