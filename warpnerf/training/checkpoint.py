"""Fields, and whole trainings between two updates, in files. No pickle.

A file is safetensors, written whole or not at all. Its metadata hold a header in JSON (format
version, how to render, and for a training its configuration and progress) and the SHA-256 over
header and tensors. A training's file is a field's file and more, so a field is read from either.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import msgspec
import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vector

from warpnerf.checks import InputError, way_out
from warpnerf.config import Contraction, TrainConfig, config_from_json, config_to_json
from warpnerf.model.grid import FreeCells, VoxelGrid
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import MODELS, Rgb, decode, to_json
from warpnerf.model.parameters import parameters_of
from warpnerf.rendering.field import Field
from warpnerf.rendering.render import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.frustum import Frustum
from warpnerf.training.optim import NodesRule, WeightsRule, first_states
from warpnerf.training.state import Progress, TrainingState

FIELD = "warpnerf-field-2"
TRAINING = "warpnerf-training-6"
"""What a file holds, and the version of its format."""
OLDER = {"warpnerf-field-1": FIELD, "warpnerf-training-5": TRAINING}
"""Formats of the version before, which had one model, rgb; they are read."""

CHUNK = 1 << 24
"""Bytes per write: signals such as Ctrl-C wait for one to end."""


class DamagedFileError(InputError):
    """A file is not what was written: cut off, altered, or of another kind altogether."""


def save_field(path: str | Path, field: Field) -> None:
    """Write a field to a file, replacing an older one in a single step.

    Args:
        path: Of the file; its folder exists.
        field: What to write.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    _write(path, {"format": FIELD} | _field_header(field), _field_tensors(field))


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
    _write(path, header, _optimiser_tensors(state) | _field_tensors(state.field))


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
    if not 0 <= training.grown <= 1 + len(training.config.grid.grow_at):
        _refuse(path, f"a grid cannot have been resized {training.grown} times")
    if not 0 <= training.updates <= training.progress.step:
        _refuse(path, f"{training.updates} updates do not fit {training.progress.step} steps")
    if not 0 <= training.restarted <= training.updates:
        _refuse(
            path,
            f"an optimiser of {training.updates} updates cannot begin anew after "
            f"{training.restarted}",
        )
    if (training.config.content_distance == "per-camera") != bool(training.content_distances):
        _refuse(path, "content distances of cameras are not as its configuration says")
    workers = Workers("cpu")
    field = _field(header, tensors, path, workers)
    if training.config.model != field.model:
        _refuse(path, "its configuration names another model than its field")
    return TrainingState(
        config=training.config,
        scene_digest=training.scene_digest,
        content_distance=training.content_distance,
        content_distances=training.content_distances,
        reach=training.reach,
        grown=training.grown,
        updates=training.updates,
        restarted=training.restarted,
        progress=training.progress,
        field=field,
        optimiser=_optimiser(training.config, field, tensors, path, workers),
    )


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
                _refuse(path, f"its tensor '{parameter}.{name}' does not fit its values")
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
        _refuse(path, "it holds values that cannot be rendered")
    grid = VoxelGrid(
        values=wp.array(
            values.reshape(-1, model.n_floats),
            dtype=vector(model.n_floats),
            device=workers.device,
        ),
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


def _write(path: str | Path, header: dict[str, Any], tensors: dict[str, np.ndarray]) -> None:
    text = json.dumps(header, sort_keys=True)
    metadata = {"header": text, "sha256": _digest(text, tensors)}
    write_atomically(path, *_safetensors(metadata, tensors))


def _safetensors(
    metadata: dict[str, str], tensors: dict[str, np.ndarray]
) -> list[bytes | memoryview]:
    """The pieces of a safetensors file, without the copies of all tensors that ``save`` makes.

    Format: https://github.com/huggingface/safetensors#format. Wide types come first, so that all
    tensors are aligned.
    """
    dtypes = {np.dtype(np.float32): "F32", np.dtype(np.uint32): "U32", np.dtype(np.uint8): "U8"}
    table: dict[str, Any] = {"__metadata__": metadata}
    pieces, end = [], 0
    for name, tensor in sorted(tensors.items(), key=lambda item: (-item[1].itemsize, item[0])):
        offsets = [end, end := end + tensor.nbytes]
        table[name] = {
            "dtype": dtypes[tensor.dtype],
            "shape": tensor.shape,
            "data_offsets": offsets,
        }
        pieces.append(np.ascontiguousarray(tensor).data.cast("B"))
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 8)
    return [len(text).to_bytes(8, "little"), text, *pieces]


def _read(path: Path) -> tuple[_Header, dict[str, np.ndarray]]:
    """Header and tensors, checked against the digest; what is not ours is refused."""
    from safetensors import SafetensorError, safe_open

    if not path.exists():
        raise InputError(f"{path} does not exist; train first, or name another file.")
    if not path.is_file():  # reading from a pipe would never end
        raise InputError(f"{path} is not a file; name a field or a checkpoint.")
    try:
        path.open("rb").close()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; {way_out(error)}.") from None
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
        with path.open("rb") as file:
            _strict_json(file.read(int.from_bytes(file.read(8), "little")))
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        _refuse(path, f"it is not readable as safetensors ({error})")
    try:
        tree = _strict_json(metadata.get("header", "{}"))
        kind = tree.get("format")
    except (ValueError, RecursionError, AttributeError) as error:
        _refuse(path, f"its header is not what was written ({error})")
    if kind not in (FIELD, TRAINING, *OLDER):
        raise InputError(
            f"{path} has format {kind!r}, but this version reads "
            f"{', '.join(map(repr, (FIELD, TRAINING, *OLDER)))}; use the version of warpnerf that "
            "wrote it, or train again."
        )
    if metadata.get("sha256") != _digest(metadata["header"], tensors):
        _refuse(path, "its content does not match its SHA-256")
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
        _refuse(path, f"its header does not fit: {error}")
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
        _refuse(
            path, f"it holds {', '.join(sorted(tensors))} instead of {', '.join(sorted(names))}"
        )
    return header, tensors


def _refuse(path: Path, why: str) -> NoReturn:
    raise DamagedFileError(f"{path} is damaged: {why}; train again.")


def _strict_json(text: str | bytes) -> Any:
    """JSON without NaN, infinity and keys given twice, of which other readers take either one."""

    def number(text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            raise ValueError(f"{text} is not a finite number")
        return value

    return json.loads(text, object_pairs_hook=_distinct, parse_float=number, parse_constant=number)


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table = dict(pairs)
    if len(table) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {twice!r} is given twice")
    return table


def write_atomically(path: str | Path, *pieces: bytes | memoryview) -> None:
    """Write a file so that its name always leads to all of the old content or all of the new.

    Raises:
        OSError: It cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | getattr(os, "O_BINARY", 0)
        file = os.open(temporary, flags, 0o666)
        try:
            for piece in pieces:
                view = memoryview(piece)
                while view:
                    view = view[os.write(file, view[:CHUNK]) :]
            os.fsync(file)
        finally:
            os.close(file)
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    if os.name == "posix":
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def _digest(header: str, tensors: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256(header.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name}{tensor.dtype}{tensor.shape}".encode())
        digest.update(np.ascontiguousarray(tensor).data)
    return digest.hexdigest()
