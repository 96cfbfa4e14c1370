"""Trainable parameters: arrays with their learning rates, one list for all that loops over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warpnerf.model.interface import Model
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class Parameter:
    """A trainable parameter: an array that training changes, and how."""

    name: str
    """In checkpoints."""
    values: wp.array
    """[n_entries] vectors, or [n_weights]."""
    rule: str
    """The name of the rule that updates it, in ``training.optim.OPTIMISERS``: nodes, of which only
    those change where rays have been, or weights that all rays share."""
    learning_rates: np.ndarray
    """Of each number of an entry, or [1]."""
    gradient: tuple[str, ...]
    """Names of its arrays in ``Gradients``, as its rule wants them: for nodes, values and flags of
    tiles; for weights, the copies of the workers."""
    epsilon: float | None = None
    """Of Adam, for it alone; None: ``OptimConfig.epsilon``."""


def head_parameters(model: Model, weights: wp.array) -> tuple[Parameter, ...]:
    """The trainable parameters of a model's head.

    Args:
        model: Which one.
        weights: [n_weights] of its MLP; none where it has none.
    """
    if not weights.size:
        return ()
    rates = np.array([model.learning_rate_mlp])
    return (
        Parameter(
            name="weights",
            values=weights,
            rule="weights",
            learning_rates=rates,
            gradient=("weights",),
        ),
    )


def first_weights(model: Model, seed: int, workers: Workers) -> wp.array:
    """The head's weights before the first step, on the device."""
    return wp.array(model.first_weights(seed), dtype=wp.float32, device=workers.device)
