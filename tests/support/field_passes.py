"""A training pass over a field with random contents: its gradient, packed or plain, by workers."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from warpnerf_kernels.base.tiles import TILE

from tests.support.expected import assert_close
from tests.support.tiny_trainings import ball
from warpnerf.config import GridConfig, LossConfig, TrainConfig
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import Storage
from warpnerf.model.interface import Model
from warpnerf.model.models import Deferred, PerSample, Rgb, SphericalHarmonics
from warpnerf.model.storage_kinds import StorageKind
from warpnerf.rendering.render import TrainingPass
from warpnerf.training.trainer import Trainer

N_RAYS = 301
MODELS: dict[str, Model] = {
    "rgb": Rgb(),
    "sh": SphericalHarmonics(degree=2),
    "deferred": Deferred(width=16),
    "per_sample": PerSample(width=16),
    "many": PerSample(width=16, features=27, residual=False),
}
CASES = [
    *(("rgb", "none"), ("deferred", "none"), ("many", "none"), ("deferred", "linf")),
    *(pytest.param(name, "none", marks=pytest.mark.slow) for name in ("sh", "per_sample")),
]
"""Models, and the space that each is read in; of heads alike in what they read, one always runs."""

Gradient = dict[str, np.ndarray]


def trainer_of(
    model: Model,
    kind: StorageKind,
    threads: int = 1,
    contraction: str = "none",
    n_rays: int = N_RAYS,
) -> Trainer:
    """At its first step, on a lattice of 700 nodes, as many along no axis as along another."""
    config = TrainConfig(
        model=model,
        field=kind,
        loss=LossConfig(),
        rays_per_step=n_rays,
        coarse_steps=0,
        grid=GridConfig(
            voxels=700,
            grow_at=(),
            contraction=contraction,
            alpha_init=0.1,
            box=(-0.55, -1.0, -0.75, 0.55, 1.0, 0.75),
        ),
        threads=threads,
    )
    return Trainer(ball(), config)


def fill(*arrays: Any) -> None:
    """With random numbers, the same each time."""
    rng = np.random.default_rng(1)
    for array in arrays:
        array.assign(rng.normal(0.0, 0.5, array.numpy().shape).astype(np.float32))


def gradient_of(trainer: Trainer, storage: Storage) -> Gradient:
    """Of a batch of rays, and the loss of each; copies of workers are summed.

    A third of the cells are free, so that packs have samples in some of their lanes, not the first.
    """
    steps, workers, n_rays = (
        trainer.march_steps(),
        trainer.workers,
        trainer.config.rays_per_step,
    )
    launch = TrainingPass(
        *(n_rays, trainer.model, storage, trainer.weights, steps, "clamped", "none", workers)
    )
    occupied = np.random.default_rng(2).random(storage.lattice.cells) < 0.67
    free = FreeCells.none(workers).cropped(storage.lattice, occupied, workers)
    launch.run(free, trainer._sampler.draw(0))
    found = {
        name: array.numpy().sum(axis=0) if array.ndim == 2 else array.numpy()
        for name, array in launch.gradients.arrays.items()
    }
    found = {name: array for name, array in found.items() if array.size}  # rgb has no weights
    return found | {"loss": launch.loss.numpy(), "samples": launch.n_samples.numpy()}


def require_same(packed: Gradient, plain: Gradient, contraction: str = "none") -> None:
    """Positions are rounded otherwise in contracted space, too."""
    for part in plain:
        assert_close(packed[part], plain[part], 1e-5 if contraction == "none" else 2e-5)


def require_workers_agree(gradient: Callable[[int], Gradient], threads: int) -> None:
    """One worker with several, and these with themselves, bit by bit."""
    alone, shared, again = (gradient(n) for n in (1, threads, threads))
    for part in alone:
        assert_close(shared[part], alone[part], 3e-6)
        assert np.array_equal(shared[part], again[part])
    assert np.array_equal(shared["loss"], alone["loss"])


def require_flags_cover(found: Gradient, name: str) -> None:
    """Adam passes over tiles that are not flagged, nor the one before them."""
    flags = found["touched"] != 0
    flags[1:] |= flags[:-1]
    got = np.abs(found[name]).max(axis=1) > 0.0
    assert got.any() and not got.all()
    assert np.repeat(flags, TILE)[: len(got)][got].all()
