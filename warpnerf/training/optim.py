"""The optimiser: a rule for each kind of parameter, and total variation that joins the gradient."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import warp as wp
from warpnerf_kernels.base import tiles
from warpnerf_kernels.base.types import vector
from warpnerf_kernels.optim import adam, total_variation

from warpnerf.config import OptimConfig
from warpnerf.model.grid import VoxelGrid
from warpnerf.model.parameters import Parameter
from warpnerf.rendering.adjoint import Gradients
from warpnerf.runtime.parallel import NODES, Workers


class NodesRule:
    """Adam over the nodes of a grid: where no ray has been, nothing changes."""

    state_names: ClassVar[tuple[str, ...]] = ("moments",)
    """What ``state`` holds, and checkpoints after the parameter's name."""

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        """Running moments before the first update: [n_nodes], see optim.adam."""
        dtype = adam.moments_type(len(parameter.learning_rates))
        return {"moments": wp.zeros(parameter.values.shape[0], dtype=dtype, device=workers.device)}

    @staticmethod
    def resized(
        state: dict[str, wp.array], grid: VoxelGrid, other: VoxelGrid, workers: Workers
    ) -> dict[str, wp.array]:
        """The state on another grid, trilinearly read off a first one.

        Args:
            state: Of the first.
            grid: The first.
            other: The other one, from ``VoxelGrid.resized``.
            workers: Where to work.
        """
        moments = state["moments"]
        out = wp.empty(math.prod(other.size), dtype=moments.dtype, device=workers.device)
        kernel = adam.resample_moments_kernel(grid.n_floats)
        grid.resample(kernel, moments, other, out, workers)
        return {"moments": out}

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: int,
        factor: float,
        config: OptimConfig,
        workers: Workers,
    ) -> None:
        """Update nodes from their gradients, which are zeroed."""
        n_floats = len(parameter.learning_rates)
        workers.launch(
            adam.adam_kernel(n_floats),
            *_stretches(parameter.values, workers),
            update,
            vector(n_floats)(*(factor * parameter.learning_rates)),
            *_adam_arguments(update, config),
            gradients.struct,
            parameter.values,
            state["moments"],
            at_once=NODES // tiles.STRETCH,
            cache=gradients.launches,
        )
        gradients.touched.zero_()


class WeightsRule:
    """Adam over weights that all rays share."""

    state_names: ClassVar[tuple[str, ...]] = ("mean", "square")

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        """Running moments before the first update: [n_weights] each."""
        return {name: wp.zeros_like(parameter.values) for name in WeightsRule.state_names}

    @staticmethod
    def resized(
        state: dict[str, wp.array], grid: VoxelGrid, other: VoxelGrid, workers: Workers
    ) -> dict[str, wp.array]:
        """The same: weights do not depend on the grid."""
        return state

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: int,
        factor: float,
        config: OptimConfig,
        workers: Workers,
    ) -> None:
        """Update weights from the workers' gradients, which are zeroed."""
        workers.launch(
            adam.adam_weights,
            parameter.values.shape[0],
            factor * float(parameter.learning_rates[0]),
            *_adam_arguments(update, config),
            gradients.weights,
            parameter.values,
            state["mean"],
            state["square"],
            cache=gradients.launches,
        )


RULES: dict[str, Any] = {"nodes": NodesRule, "weights": WeightsRule}
"""By kind of parameter."""


def first_states(
    parameters: tuple[Parameter, ...], workers: Workers
) -> dict[str, dict[str, wp.array]]:
    """What the optimiser keeps of each parameter before the first update, by its name."""
    return {p.name: RULES[p.kind].first_state(p, workers) for p in parameters}


def adam_step(
    parameters: tuple[Parameter, ...],
    states: dict[str, dict[str, wp.array]],
    gradients: Gradients,
    update: int,
    factor: float,
    config: OptimConfig,
    workers: Workers,
) -> None:
    """Update what a model has learned. Source: Kingma & Ba 2015, algorithm 1.

    Args:
        parameters: Updated; an entry whose gradient is exactly zero is left alone.
        states: Of each, from ``first_states``; updated, too.
        gradients: Of the update's steps; zeroed.
        update: Counts from 1.
        factor: On the learning rates.
        config: The rest.
        workers: Where to work.
    """
    for parameter in parameters:
        RULES[parameter.kind].step(
            parameter, states[parameter.name], gradients, update, factor, config, workers
        )


def add_total_variation(
    parameters: tuple[Parameter, ...],
    grid: VoxelGrid,
    gradients: Gradients,
    n_asked: int,
    n_steps: int,
    strength: wp.array,
    config: OptimConfig,
    workers: Workers,
) -> None:
    """Add the gradient of total variation at the nodes that have one already.

    What is added to the gradients of several steps grows with the root of their number: as their
    noise does at nodes that every step touches, by which Adam divides both.

    Args:
        parameters: Those that are nodes have weights of it.
        grid: Where these lie.
        gradients: Added to.
        n_asked: Nodes of the grid that the weights are meant for: the final one, or about so.
        n_steps: Training steps that the gradients are the sum of.
        strength: Of nodes in a row, see ``warpnerf.training.smoothing``.
        config: How many updates this one gradient stands for.
        workers: Where to work.
    """
    face = (n_asked / math.prod(grid.size)) ** (2.0 / 3.0)
    factor = face * config.tv_every * math.sqrt(n_steps)
    for parameter in parameters:
        if not np.any(parameter.variation):
            continue
        n_floats = len(parameter.variation)
        workers.launch(
            total_variation.total_variation_backward_kernel(n_floats),
            *_stretches(parameter.values, workers),
            parameter.values,
            wp.vec3i(*grid.size),
            vector(n_floats)(*(factor * parameter.variation)),
            strength,
            gradients.struct,
            at_once=NODES // tiles.STRETCH,
            cache=gradients.launches,
        )


def _adam_arguments(update: int, config: OptimConfig) -> tuple[float, ...]:
    return (
        config.beta1,
        config.beta2,
        config.epsilon,
        1.0 / (1.0 - config.beta1**update),
        1.0 / (1.0 - config.beta2**update),
    )


def _stretches(values: wp.array, workers: Workers) -> tuple[int, int]:
    """How many threads work on the nodes, and on how many each: a core takes a stretch."""
    span = 1 if workers.device.is_cuda else tiles.STRETCH
    return -(-values.shape[0] // span), span
