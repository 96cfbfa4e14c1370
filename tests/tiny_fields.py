"""A small field with everything in it, for tests that need one but no training."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from warpnerf_kernels.types import vec4

from warpnerf.field import Field
from warpnerf.grid import FreeCells, VoxelGrid
from warpnerf.parallel import Workers
from warpnerf.render import Steps


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
