"""A small field, and a training that holds it, for tests that need one but no training."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vector

from tests.support.tiny_scenes import ring, tiny_scene
from warpnerf.config import TrainConfig
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.parameters import head_parameters
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import Rgb
from warpnerf.rendering.field import Field
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.training.optim import first_states
from warpnerf.training.plan import planned
from warpnerf.training.state import Progress, TrainingState

RGB = Rgb()


def tiny_field(
    *, density: float = 3.0, contraction: Contraction = "none", model: Model = RGB
) -> Field:
    """Random colours in the box [-1, 1]^3 of 5 x 6 x 7 nodes, over a background that is no gray."""
    workers = Workers("cpu", 1)
    size = (5, 6, 7)
    rng = np.random.default_rng(0)
    values = rng.normal(size=(math.prod(size), model.n_floats)).astype(np.float32)
    values[:, 0] += density
    weights = 0.4 * rng.normal(size=n_weights(model)).astype(np.float32)
    grid = DenseGrid(
        values=wp.array(values, dtype=vector(model.n_floats), device=workers.device),
        lattice=Lattice(
            size=size,
            box_min=np.array([-1.0, -1.0, -1.0]),
            box_max=np.array([1.0, 1.0, 1.0]),
            contraction=contraction,
            border=0.0 if contraction == "none" else 0.2,
        ),
        density_shift=-0.5,
        density_scale=2.0,
    )
    contracted = contraction != "none"
    steps = Steps(
        near=0.1,
        far=30.0,
        step=0.05,
        n_linear=100 if contracted else 0,
        growth=0.02 if contracted else 0.0,
        transmittance_min=1e-3,
    )
    return Field(
        model=model,
        storage=grid,
        weights=wp.array(weights, dtype=wp.float32, device=workers.device),
        free=FreeCells.of(grid, workers, steps.struct(), 1e-3),
        steps=steps,
        background=(0.1, 0.6, 0.9),
        workers=workers,
    )


def tiny_state(step: int, config: TrainConfig | None = None) -> TrainingState:
    """A training after so many steps, whose arrays differ from those after any other number."""
    config = config or TrainConfig(threads=1)
    assert isinstance(config.model, Model)
    field = tiny_field(density=float(step), model=config.model)
    parameters = field.storage.parameters(field.model, config.optim)
    parameters += head_parameters(field.model, field.weights)
    optimiser = first_states(parameters, field.workers)
    rng = np.random.default_rng(step)
    for arrays in optimiser.values():
        for array in arrays.values():
            shape = array.numpy().shape
            numbers = rng.normal(size=shape).astype(np.float32)
            if array.numpy().dtype == np.uint32:  # two in each, all finite
                numbers = numbers.view(np.uint32) & np.uint32(0xFFFF7FFF)
            array.assign(numbers)
    progress = Progress(
        step=step,
        fraction=0.25,
        seconds=1.0 / 3.0,
        loss=0.1,
        psnr=10.0,
        samples_per_ray=12.5,
        size=field.lattice.size,
        occupied=0.75,
    )
    plan = planned(tiny_scene(ring(4)), config, field.lattice.space, 2.0 / 3.0, [1.0] * 3, math.pi)
    return TrainingState(
        plan=plan,
        scene_digest="of a scene",
        grown=2,
        updates=step,
        progress=progress,
        field=field,
        optimiser=optimiser,
    )


def assert_same_state(state: TrainingState, expected: TrainingState) -> None:
    """All of it, bit for bit."""
    for name in (
        "config",
        "scene_digest",
        "grown",
        "updates",
        "restarted",
        "progress",
    ):
        assert getattr(state, name) == getattr(expected, name)
    for name in ("content_distance", "content_distances", "reach"):
        assert getattr(state.plan, name) == getattr(expected.plan, name)
    assert state.field.model == expected.field.model
    storage, other = state.field.storage, expected.field.storage
    for name in ("density_shift", "density_scale", "kind"):
        assert getattr(storage, name) == getattr(other, name)
    for name in ("size", "contraction", "border"):
        assert getattr(storage.lattice, name) == getattr(other.lattice, name)
    assert (state.field.steps, state.field.background) == (
        expected.field.steps,
        expected.field.background,
    )
    assert state.field.free.size == expected.field.free.size
    assert state.optimiser.keys() == expected.optimiser.keys()
    kept = []
    for name, arrays in expected.optimiser.items():
        assert state.optimiser[name].keys() == arrays.keys()
        kept += [(state.optimiser[name][key], array) for key, array in arrays.items()]
    for array, wanted in (
        (storage.lattice.box_min, other.lattice.box_min),
        (storage.lattice.box_max, other.lattice.box_max),
        *((storage.tensors()[name], tensor) for name, tensor in other.tensors().items()),
        (state.field.weights.numpy(), expected.field.weights.numpy()),
        *((array.numpy(), wanted.numpy()) for array, wanted in kept),
        (state.field.free.distance.numpy(), expected.field.free.distance.numpy()),
    ):
        np.testing.assert_array_equal(array.view(np.uint8), wanted.view(np.uint8))
