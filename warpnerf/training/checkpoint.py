"""Fields, and whole trainings between two updates, in files. No pickle.

A file is tensors with a header: format version, how to render, and for a training its configuration
and progress. A training's file is a field's file and more, so a field is read from either.
"""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vector

from warpnerf.checks import InputError
from warpnerf.config import GROW_AT, Contraction, TrainConfig, config_from_json, config_to_json
from warpnerf.model.grid import FreeCells, VoxelGrid, grid_size, room_for_nodes
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import MODELS, Rgb, decode, to_json
from warpnerf.model.parameters import parameters_of
from warpnerf.rendering.field import Field
from warpnerf.rendering.render import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.frustum import Frustum
from warpnerf.training.optim import NodesRule, WeightsRule, first_states
from warpnerf.training.state import Progress, TrainingState
from warpnerf.training.tensor_file import read_tensors, refuse, write_tensors

FIELD = "warpnerf-field-2"
TRAINING = "warpnerf-training-7"
"""What a file holds, and the version of its format."""
OLDER = {
    "warpnerf-field-1": FIELD,
    "warpnerf-training-5": TRAINING,
    "warpnerf-training-6": TRAINING,
}
"""Formats of versions before, which are read. field-1 and training-5 had one model, rgb;
training-6 counted it among the growths that the box of an object had been made tighter."""


def save_field(path: str | Path, field: Field) -> None:
    """Write a field to a file, replacing an older one in a single step.

    Args:
        path: Of the file; its folder exists.
        field: What to write.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    write_tensors(path, {"format": FIELD} | _field_header(field), _field_tensors(field))


def save_checkpoint(path: str | Path, state: TrainingState) -> None:
    """Write all that a training needs to go on, likewise.

    Args:
        path: Of the file; its folder exists.
        state: From ``Trainer.state``, or what ``train`` hands to ``on_checkpoint``.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    training = {
        "config": config_to_json(state.config),
        "scene_digest": state.scene_digest,
        "content_distance": state.content_distance,
        "content_distances": state.content_distances,
        "reach": state.reach,
        "grown": state.grown,
        "updates": state.updates,
        "restarted": state.restarted,
        "progress": asdict(state.progress),
    }
    header = {"format": TRAINING, "training": training} | _field_header(state.field)
    write_tensors(path, header, _optimiser_tensors(state) | _field_tensors(state.field))


def load_field(path: str | Path, device: str = "cpu", threads: int | None = None) -> Field:
    """Read a field that ``save_field`` or ``save_checkpoint`` wrote.

    Args:
        path: Of the file.
        device: Where the field shall live.
        threads: CPU threads; None: one per usable core.

    Returns:
        The field, on that device.

    Raises:
        InputError: The file is missing, damaged, or of another kind; or the device is missing.
    """
    path = Path(path)
    header, tensors = _read(path)
    return _field(header, tensors, path, Workers(device, threads))


def load_checkpoint(path: str | Path) -> TrainingState:
    """Read a training that ``save_checkpoint`` wrote, into the memory of the CPU.

    Args:
        path: Of the file.

    Returns:
        The state, to go on from by ``train(scene, resume=state)``.

    Raises:
        InputError: The file is missing, damaged, or of another kind.
    """
    path = Path(path)
    header, tensors = _read(path)
    training = header.training
    if training is None:
        raise InputError(
            f"{path} holds a field but no training to go on with; name a checkpoint, or train anew."
        )
    if not 0 <= training.updates <= training.progress.step:
        refuse(path, f"{training.updates} updates do not fit {training.progress.step} steps")
    if not 0 <= training.restarted <= training.updates:
        refuse(
            path,
            f"an optimiser of {training.updates} updates cannot begin anew after "
            f"{training.restarted}",
        )
    chosen, each = training.config.content_distance, bool(training.content_distances)
    if each != (chosen == "per-camera") and not (each and chosen == "auto"):
        refuse(path, "content distances of cameras are not as its configuration says")
    workers = Workers("cpu")
    field = _field(header, tensors, path, workers)
    if training.config.model != field.model:
        refuse(path, "its configuration names another model than its field")
    grown, most = training.grown, max(len(training.config.grid.grows_at(kind)) for kind in GROW_AT)
    if header.format == "warpnerf-training-6":
        grown = _growths(grown, most, training.config, field.grid)
    if not 0 <= grown <= most:
        refuse(path, f"a grid cannot have grown {grown} times")
    return TrainingState(
        config=training.config,
        scene_digest=training.scene_digest,
        content_distance=training.content_distance,
        content_distances=training.content_distances,
        reach=training.reach,
        grown=grown,
        updates=training.updates,
        restarted=training.restarted,
        progress=training.progress,
        field=field,
        optimiser=_optimiser(training.config, field, tensors, path, workers),
    )


def _growths(counted: int, most: int, config: TrainConfig, grid: VoxelGrid) -> int:
    """How often a grid has grown, where growths may have been counted with one that was none."""
    extent = (grid.box_max - grid.box_min) * (1.0 + grid.border)
    for grown in (counted, counted - 1):
        if 0 <= grown <= most:
            nodes = config.grid.nodes_after(grown, "object")
            if grid_size(extent, nodes) == grid.size:
                return grown
    return counted


class _Training(msgspec.Struct, frozen=True):
    """The header's part that only a training has."""

    config: TrainConfig
    scene_digest: str
    content_distance: float
    reach: float
    grown: int
    updates: int
    progress: Progress
    content_distances: list[float] | None = None
    restarted: int = 0


class _Frustum(msgspec.Struct, frozen=True):
    """``Frustum``, of a grid in normalised device coordinates."""

    origin: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    near: float
    depth: float


class _Header(msgspec.Struct, frozen=True):
    """Everything but the tensors."""

    format: str
    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    contraction: Contraction
    border: float
    density_shift: float
    density_scale: float
    steps: Steps
    background: tuple[float, float, float]
    model: Model = Rgb()  # as in files of the version before, which do not name it
    training: _Training | None = None
    frustum: _Frustum | None = None


def _field_header(field: Field) -> dict[str, Any]:
    grid, frustum = field.grid, field.grid.frustum
    header = {
        "model": to_json(field.model),
        "box_min": grid.box_min.tolist(),
        "box_max": grid.box_max.tolist(),
        "contraction": grid.contraction,
        "border": grid.border,
        "density_shift": grid.density_shift,
        "density_scale": grid.density_scale,
        "steps": asdict(field.steps),
        "background": list(field.background),
    }
    if frustum is not None:
        header["frustum"] = {
            "origin": frustum.origin.tolist(),
            "axes": frustum.axes.tolist(),
            "near": frustum.near,
            "depth": frustum.depth,
        }
    return header


def _field_tensors(field: Field) -> dict[str, np.ndarray]:
    tensors = {
        "values": field.grid.values.numpy().reshape(*field.grid.size, field.grid.n_floats),
        "free_distance": field.free.distance.numpy().reshape(field.free.size),
    }
    if field.weights.size:
        tensors["weights"] = field.weights.numpy()
    return tensors


def _optimiser_tensors(state: TrainingState) -> dict[str, np.ndarray]:
    """What the optimiser keeps, by the parameter's name and its own."""
    return {
        f"{parameter}.{name}": array.numpy()
        for parameter, arrays in state.optimiser.items()
        for name, array in arrays.items()
    }


def _optimiser(
    config: TrainConfig,
    field: Field,
    tensors: dict[str, np.ndarray],
    path: Path,
    workers: Workers,
) -> dict[str, dict[str, wp.array]]:
    """What was written by ``_optimiser_tensors``, where it fits the model's parameters."""
    parameters = parameters_of(field.model, field.grid, field.weights, config.optim)
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
    return states


def _field(header: _Header, tensors: dict[str, np.ndarray], path: Path, workers: Workers) -> Field:
    values, free = tensors["values"], tensors["free_distance"]
    steps, model = header.steps, header.model
    weights = tensors.get("weights", np.zeros(0, np.float32))
    fits = (
        values.ndim == 4
        and values.shape[3] == model.n_floats
        and weights.shape == (n_weights(model),)
        and weights.dtype == np.float32
        and np.isfinite(weights).all()
        and min(values.shape[:3]) >= 2
        and values.dtype == np.float32
        and free.ndim == 3
        and free.size > 0
        and free.dtype == np.uint8
        and all(low < high for low, high in zip(header.box_min, header.box_max, strict=True))
        and 0.0 <= header.border <= 1.0
        and _frustum_fits(header)
        and steps.step > 0.0
        and steps.n_linear >= 0
        and steps.growth >= 0.0
        and 0.0 <= steps.transmittance_min < 1.0
        and np.isfinite(values).all()
    )
    if not fits:
        refuse(path, "it holds values that cannot be rendered")
    nodes = room_for_nodes(math.prod(values.shape[:3]), vector(model.n_floats), workers.device)
    nodes.assign(values.reshape(-1, model.n_floats))
    grid = VoxelGrid(
        values=nodes,
        size=(values.shape[0], values.shape[1], values.shape[2]),
        box_min=np.array(header.box_min),
        box_max=np.array(header.box_max),
        contraction=header.contraction,
        border=header.border,
        density_shift=header.density_shift,
        density_scale=header.density_scale,
        frustum=None
        if header.frustum is None
        else Frustum(
            origin=np.array(header.frustum.origin),
            axes=np.array(header.frustum.axes),
            near=header.frustum.near,
            depth=header.frustum.depth,
        ),
    )
    return Field(
        model=model,
        grid=grid,
        weights=wp.array(weights, dtype=wp.float32, device=workers.device),
        free=FreeCells(
            distance=wp.array(free.reshape(-1), dtype=wp.uint8, device=workers.device),
            size=(free.shape[0], free.shape[1], free.shape[2]),
            border=header.border,
        ),
        steps=steps,
        background=header.background,
        workers=workers,
    )


def _frustum_fits(header: _Header) -> bool:
    """Whether there is a frustum where there has to be one, and it is one."""
    frustum = header.frustum
    if frustum is None or header.contraction != "ndc" or not header.steps.in_ndc:
        return frustum is None and header.contraction != "ndc" and not header.steps.in_ndc
    axes = np.array(frustum.axes)
    return bool(
        np.isfinite(frustum.origin).all()
        and np.abs(axes @ axes.T - np.eye(3)).max() < 1e-6
        and 0.0 < frustum.near < math.inf
        and 0.0 < frustum.depth < math.inf
    )


def _read(path: Path) -> tuple[_Header, dict[str, np.ndarray]]:
    """Header and tensors of a field or a training; what is not ours is refused."""
    tree, tensors = read_tensors(path, (FIELD, TRAINING, *OLDER))
    kind = tree["format"]
    if isinstance(model := tree.get("model"), dict) and model.get("name") not in MODELS:
        raise InputError(
            f"{path} holds a field of the model {model.get('name')!r}, but this version knows "
            f"{', '.join(MODELS)}; register that model, or use the version that wrote it."
        )
    try:
        if isinstance(training := tree.get("training"), dict) and "config" in training:
            tree["training"] = training | {"config": config_from_json(training["config"])}
        header = msgspec.convert(tree, _Header, dec_hook=decode)
    except (msgspec.ValidationError, TypeError) as error:
        refuse(path, f"its header does not fit: {error}")
    if kind in OLDER:
        kind = OLDER[kind]
        if "moments" in tensors and "values.moments" not in tensors:
            tensors["values.moments"] = tensors.pop("moments")
    names = {"values", "free_distance"} | ({"weights"} if n_weights(header.model) else set())
    if header.training is not None:
        names |= {
            f"{parameter}.{name}"
            for parameter, rule in (("values", NodesRule), ("weights", WeightsRule))
            if parameter in names
            for name in rule.state_names
        }
    if set(tensors) != names or (header.training is not None) != (kind == TRAINING):
        refuse(path, f"it holds {', '.join(sorted(tensors))} instead of {', '.join(sorted(names))}")
    return header, tensors
