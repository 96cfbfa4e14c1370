"""What of a model is trained: arrays with their rates, one list for all that loops over them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from warpnerf.config import OptimConfig
from warpnerf.model.grid import VoxelGrid
from warpnerf.model.interface import Model
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameter:
    """An array that training changes."""

    name: str
    """In checkpoints, and of its gradient in ``Gradients``."""
    values: wp.array
    """[n_nodes] vectors, or [n_weights]."""
    kind: Literal["nodes", "weights"]
    """Which rule updates it: nodes of a grid where rays have been, or weights that rays share."""
    learning_rates: np.ndarray
    """Of each number of a node, or [1]."""
    variation: np.ndarray
    """Weights of total variation, of each number of a node or [1]; 0: none."""


def parameters_of(
    model: Model, grid: VoxelGrid, weights: wp.array, optim: OptimConfig
) -> tuple[Parameter, ...]:
    """All that a model learns.

    Args:
        model: Which one.
        grid: Its values.
        weights: [n_weights] of its head; none where it has no MLP.
        optim: Rates and weights of total variation.
    """
    nodes = Parameter(
        name="values",
        values=grid.values,
        kind="nodes",
        learning_rates=model.learning_rates(optim),
        variation=model.variation(optim),
    )
    if not weights.size:
        return (nodes,)
    of_head = Parameter(
        name="weights",
        values=weights,
        kind="weights",
        learning_rates=np.array([model.learning_rate_mlp]),
        variation=np.zeros(1),
    )
    return nodes, of_head


def first_weights(model: Model, seed: int, workers: Workers) -> wp.array:
    """The head's weights before the first step, on the device."""
    return wp.array(model.first_weights(seed), dtype=wp.float32, device=workers.device)
