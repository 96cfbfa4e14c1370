"""Adam over a voxel grid, and the total variation that joins its gradient."""

from __future__ import annotations

import math

import warp as wp
from warpnerf_kernels import adam, regularize, tiles
from warpnerf_kernels.types import vec4

from warpnerf.adjoint import Gradients
from warpnerf.config import OptimConfig
from warpnerf.grid import VoxelGrid
from warpnerf.parallel import NODES, Workers


def no_moments(grid: VoxelGrid, workers: Workers) -> wp.array:
    """Adam's running moments of a grid's gradient before the first update.

    Returns:
        [n_nodes] of 16 bytes: per channel the mean and the mean square; see warpnerf_kernels.adam.
    """
    return wp.zeros(math.prod(grid.size), dtype=adam.uint4, device=workers.device)


def resized_moments(
    moments: wp.array, grid: VoxelGrid, other: VoxelGrid, workers: Workers
) -> wp.array:
    """Moments on another grid, trilinearly read off a first one.

    Args:
        moments: [grid n_nodes] as ``no_moments`` describes them.
        grid: Theirs.
        other: The other one, from ``VoxelGrid.resized``.
        workers: Where to work.

    Returns:
        [other n_nodes] likewise.
    """
    out = wp.empty(math.prod(other.size), dtype=adam.uint4, device=workers.device)
    grid.resample(adam.resample_moments, moments, other, out, workers)
    return out


def adam_step(
    grid: VoxelGrid,
    moments: wp.array,
    gradients: Gradients,
    update: int,
    factor: float,
    config: OptimConfig,
    workers: Workers,
) -> None:
    """Update a grid from its gradients, which are zeroed. Source: Kingma & Ba 2015, algorithm 1.

    Args:
        grid: Its values are updated; an entry whose gradient is exactly zero is left alone.
        moments: [n_nodes] updated likewise.
        gradients: Of the update's steps.
        update: Counts from 1.
        factor: On the learning rates.
        config: The rest.
        workers: Where to work.
    """
    rgb_rate = factor * config.learning_rate_rgb
    workers.launch(
        adam.adam_step,
        *_shares(grid, workers),
        update,
        vec4(factor * config.learning_rate_density, rgb_rate, rgb_rate, rgb_rate),
        config.beta1,
        config.beta2,
        config.epsilon,
        1.0 / (1.0 - config.beta1**update),
        1.0 / (1.0 - config.beta2**update),
        gradients.struct,
        grid.values,
        moments,
        chunk=NODES // tiles.STRETCH,
        packed=gradients.packed,
    )
    gradients.touched.zero_()


def add_total_variation(
    grid: VoxelGrid,
    gradients: Gradients,
    n_asked: int,
    n_steps: int,
    config: OptimConfig,
    workers: Workers,
) -> None:
    """Add the gradient of the grid's total variation at the nodes that have one already.

    What is added to the gradients of several steps grows with the root of their number: as their
    noise does at nodes that every step touches, by which Adam divides both.

    Args:
        grid: The grid.
        gradients: Added to.
        n_asked: Nodes of the grid that the weights are meant for: the final one, or about so.
        n_steps: Training steps that the gradients are the sum of.
        config: Holds the weights, and how many updates this one gradient stands for.
        workers: Where to work.
    """
    if config.tv_density == 0.0 and config.tv_rgb == 0.0:
        return
    face = (n_asked / math.prod(grid.size)) ** (2.0 / 3.0)
    factor = face * config.tv_every * math.sqrt(n_steps)
    density, rgb = factor * config.tv_density, factor * config.tv_rgb
    workers.launch(
        regularize.total_variation_backward,
        *_shares(grid, workers),
        grid.values,
        wp.vec3i(*grid.size),
        vec4(density, rgb, rgb, rgb),
        gradients.struct,
        chunk=NODES // tiles.STRETCH,
        packed=gradients.packed,
    )


def _shares(grid: VoxelGrid, workers: Workers) -> tuple[int, int]:
    """How many threads work on the nodes, and on how many each: a core takes a stretch."""
    span = 1 if workers.device.is_cuda else tiles.STRETCH
    return -(-math.prod(grid.size) // span), span
