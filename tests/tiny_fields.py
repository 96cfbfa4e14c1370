"""A small field, and a training that holds it, for tests that need one but no training."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from warpnerf_kernels.adam import uint4
from warpnerf_kernels.types import vec4

from warpnerf.config import TrainConfig
from warpnerf.field import Field
from warpnerf.grid import FreeCells, VoxelGrid
from warpnerf.parallel import Workers
from warpnerf.render import Steps
from warpnerf.state import Progress, TrainingState


def tiny_field(*, density: float = 3.0, contraction: str = "none") -> Field:
    """Random colours in the box [-1, 1]^3 of 5 x 6 x 7 nodes, over a background that is no gray."""
    workers = Workers("cpu", 1)
    size = (5, 6, 7)
    values = np.random.default_rng(0).normal(size=(math.prod(size), 4)).astype(np.float32)
    values[:, 0] += density
    grid = VoxelGrid(
        values=wp.array(values, dtype=vec4, device=workers.device),
        size=size,
        box_min=np.array([-1.0, -1.0, -1.0]),
        box_max=np.array([1.0, 1.0, 1.0]),
        contraction=contraction,
        border=0.0 if contraction == "none" else 0.2,
        density_shift=-0.5,
        density_scale=2.0,
    )
    folded = contraction != "none"
    steps = Steps(
        near=0.1,
        far=30.0,
        step=0.05,
        n_linear=100 if folded else 0,
        growth=0.02 if folded else 0.0,
        transmittance_min=1e-3,
    )
    return Field(
        grid=grid,
        free=FreeCells.of(grid, workers, steps.struct(), 1e-3),
        steps=steps,
        background=(0.1, 0.6, 0.9),
        workers=workers,
    )


def tiny_state(step: int, config: TrainConfig | None = None) -> TrainingState:
    """A training after so many steps, whose arrays differ from those after any other number."""
    field = tiny_field(density=float(step))
    moments = np.random.default_rng(step).normal(size=(math.prod(field.grid.size), 4))
    moments = moments.astype(np.float32).view(np.uint32) & np.uint32(0xFFFF7FFF)  # all finite
    progress = Progress(
        step=step,
        fraction=0.25,
        seconds=1.0 / 3.0,
        loss=0.1,
        psnr=10.0,
        samples_per_ray=12.5,
        size=field.grid.size,
        occupied=0.75,
    )
    return TrainingState(
        config=config or TrainConfig(threads=1),
        scene_digest="of a scene",
        content_distance=2.0 / 3.0,
        reach=math.pi,
        grown=2,
        updates=step,
        progress=progress,
        field=field,
        moments=wp.array(moments, dtype=uint4, device=field.workers.device),
    )


def assert_same_state(state: TrainingState, expected: TrainingState) -> None:
    """All of it, bit for bit."""
    for name in (
        "config",
        "scene_digest",
        "content_distance",
        "reach",
        "grown",
        "updates",
        "progress",
    ):
        assert getattr(state, name) == getattr(expected, name)
    grid, other = state.field.grid, expected.field.grid
    for name in ("size", "contraction", "border", "density_shift", "density_scale"):
        assert getattr(grid, name) == getattr(other, name)
    assert (state.field.steps, state.field.background) == (
        expected.field.steps,
        expected.field.background,
    )
    assert state.field.free.size == expected.field.free.size
    for array, wanted in (
        (grid.box_min, other.box_min),
        (grid.box_max, other.box_max),
        (grid.values.numpy(), other.values.numpy()),
        (state.moments.numpy(), expected.moments.numpy()),
        (state.field.free.distance.numpy(), expected.field.free.distance.numpy()),
    ):
        np.testing.assert_array_equal(array.view(np.uint8), wanted.view(np.uint8))
