"""Adam over a voxel grid, and the total variation that joins its gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass

import warp as wp
from warpnerf_kernels import adam, regularize, tiles
from warpnerf_kernels.types import vec4

from warpnerf.adjoint import Gradients
from warpnerf.config import OptimConfig
from warpnerf.grid import VoxelGrid
from warpnerf.parallel import NODES, Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class Moments:
    """Adam's running moments of the gradient."""

    mean: wp.array
    """[n_nodes] vec4."""
    square: wp.array
    """[n_nodes] vec4."""

    @staticmethod
    def zeros(grid: VoxelGrid, workers: Workers) -> Moments:
        """Before the first step."""
        n = math.prod(grid.size)
        return Moments(
            mean=wp.zeros(n, dtype=vec4, device=workers.device),
            square=wp.zeros(n, dtype=vec4, device=workers.device),
        )


def adam_step(
    grid: VoxelGrid,
    moments: Moments,
    gradients: Gradients,
    step: int,
    decay: float,
    config: OptimConfig,
    workers: Workers,
) -> None:
    """Update a grid from its gradients, which are zeroed. Source: Kingma & Ba 2015, algorithm 1.

    Args:
        grid: Its values are updated; an entry whose gradient is exactly zero is left alone.
        moments: Updated likewise.
        gradients: Of a batch.
        step: Counts from 1.
        decay: Factor on the learning rates.
        config: The rest.
        workers: Where to work.
    """
    rgb_rate = decay * config.learning_rate_rgb
    workers.launch(
        adam.adam_step,
        *_shares(grid, workers),
        vec4(decay * config.learning_rate_density, rgb_rate, rgb_rate, rgb_rate),
        config.beta1,
        config.beta2,
        config.epsilon,
        1.0 / (1.0 - config.beta1**step),
        1.0 / (1.0 - config.beta2**step),
        gradients.struct(),
        grid.values,
        moments.mean,
        moments.square,
        chunk=NODES // tiles.STRETCH,
    )
    gradients.touched.zero_()


def add_total_variation(
    grid: VoxelGrid, gradients: Gradients, config: OptimConfig, workers: Workers
) -> None:
    """Add the gradient of the grid's total variation at the nodes that have one already.

    Args:
        grid: The grid.
        gradients: Added to.
        config: Holds the weights, and how many steps this one gradient stands for.
        workers: Where to work.
    """
    if config.tv_density == 0.0 and config.tv_rgb == 0.0:
        return
    rgb = config.tv_every * config.tv_rgb
    workers.launch(
        regularize.total_variation_backward,
        *_shares(grid, workers),
        grid.values,
        wp.vec3i(*grid.size),
        vec4(config.tv_every * config.tv_density, rgb, rgb, rgb),
        gradients.struct(),
        chunk=NODES // tiles.STRETCH,
    )


def _shares(grid: VoxelGrid, workers: Workers) -> tuple[int, int]:
    """How many threads work on the nodes, and on how many each: a core takes a stretch."""
    span = 1 if workers.device.is_cuda else tiles.STRETCH
    return -(-math.prod(grid.size) // span), span
