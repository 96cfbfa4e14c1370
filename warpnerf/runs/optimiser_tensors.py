"""What the optimiser keeps, as tensors of a checkpoint: written, and read where it fits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import warp as wp

from warpnerf.config import TrainConfig
from warpnerf.fields.parameters import head_parameters
from warpnerf.rendering.field import Field
from warpnerf.runs.tensor_file import refuse
from warpnerf.runtime.parallel import Workers
from warpnerf.training.exposure import NUMBERS, are_sums
from warpnerf.training.exposure import STATE as EXPOSURES
from warpnerf.training.optim import first_states
from warpnerf.training.state import TrainingState


def optimiser_tensors(state: TrainingState) -> dict[str, np.ndarray]:
    """What the optimiser keeps, by the parameter's name and its own."""
    return {
        f"{parameter}.{name}": array.numpy()
        for parameter, arrays in state.optimiser.items()
        for name, array in arrays.items()
    }


def read_optimiser(
    config: TrainConfig,
    field: Field,
    tensors: dict[str, np.ndarray],
    path: Path,
    workers: Workers,
) -> dict[str, dict[str, wp.array]]:
    """What was written by ``optimiser_tensors``, where it fits the model's parameters."""
    parameters = field.storage.parameters(field.model, config.optim)
    parameters += head_parameters(field.model, field.weights)
    if field.proposal is not None:
        parameters += field.proposal.parameters(config.optim)
    states = first_states(parameters, workers)
    for parameter, arrays in states.items():
        for name, array in arrays.items():
            tensor, expected = tensors[f"{parameter}.{name}"], array.numpy()
            tensor = tensor.reshape(expected.shape) if tensor.size == expected.size else tensor
            fits = tensor.shape == expected.shape and tensor.dtype == expected.dtype
            if fits and tensor.dtype == np.uint32:
                # An exponent of ones is infinity or no number, in the upper half as in the lower.
                fits = not any(((tensor >> place) & 0xFF == 0xFF).any() for place in (23, 8))
            elif fits:
                fits = bool(np.isfinite(tensor).all())
            if not fits:
                refuse(path, f"its tensor '{parameter}.{name}' does not fit its values")
            arrays[name] = wp.array(tensor, dtype=array.dtype, device=workers.device)
    if (name := f"{EXPOSURES}.sums") in tensors:
        sums, settled = tensors[name], tensors[f"{EXPOSURES}.settled"]
        if sums.dtype != np.float32 or sums.size % NUMBERS or not are_sums(sums):
            refuse(path, f"its tensor '{name}' does not fit its photographs")
        known = (1.0,) if config.appearance == "affine" else (0.0, 1.0)
        if settled.size != 1 or settled.item() not in known:
            refuse(path, f"its tensor '{EXPOSURES}.settled' does not fit its appearance")
        states[EXPOSURES] = {
            name: wp.array(tensor.ravel(), dtype=wp.float32, device=workers.device)
            for name, tensor in (("sums", sums), ("settled", settled))
        }
    return states
