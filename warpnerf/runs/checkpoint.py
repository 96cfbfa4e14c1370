"""Checkpoints: fields, and whole trainings between two updates, in files. No pickle.

A file is tensors with a header: format version, how to render, and for a training its configuration
and progress. A training's file is a field's file and more, so a field is read from either.
"""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import warp as wp

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, require_one_of
from warpnerf.config import TrainConfig
from warpnerf.config_json import config_to_json
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storages import class_of
from warpnerf.grid_config import GROW_AT, Contraction
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import FORMER_NAMES, MODELS, Rgb
from warpnerf.model.registry import to_json
from warpnerf.model.sampler_kinds import MARCHED
from warpnerf.model.spaces import SPACES
from warpnerf.model.storage_kinds import DENSE, STORAGE_KINDS, StorageKind
from warpnerf.rendering.field import Field
from warpnerf.rendering.proposal import PARAMETER
from warpnerf.rendering.steps import Steps
from warpnerf.runs.compact import COMPACT, Precision, compact, expanded
from warpnerf.runs.optimiser_tensors import optimiser_tensors, read_optimiser
from warpnerf.runs.stored_proposal import StoredProposal, proposal_header
from warpnerf.runs.tensor_file import read_tensors, refuse, write_tensors
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.frustum import Frustum
from warpnerf.scenes.extent.space import grid_size
from warpnerf.training.exposure import STATE as EXPOSURES
from warpnerf.training.optim import OPTIMISERS
from warpnerf.training.plan import OlderPlan, TrainingPlan
from warpnerf.training.plan_json import decode, plan_to_json, prepared
from warpnerf.training.state import Progress, TrainingState

FIELD = "warpnerf-field-2"
TRAINING = "warpnerf-training-8"
"""What a file holds, and the version of its format."""
OLDER = {
    "warpnerf-field-1": FIELD,
    "warpnerf-training-5": TRAINING,
    "warpnerf-training-6": TRAINING,
    "warpnerf-training-7": TRAINING,
}
"""Formats of versions before, which are read. field-1 and training-5 had one model, rgb;
training-6 counted it among the growths that the box of an object had been made tighter; up to
training-7 a file held no plan, but its configuration, content distances and reach."""
WITHOUT_PLAN = "warpnerf-training-7"
"""What is written of a training that was read from such a file, and has not gone on."""


@checked_arguments
def save_field(path: str | Path, field: Field, precision: Precision = "float32") -> None:
    """Save a radiance field as a safetensors file, replacing an older one in a single step.

    Args:
        path: Of the file; its folder exists.
        field: What to write.
        precision: float16 leaves out features of free space, too, see ``runs.compact``.

    Raises:
        InputError: There is no such precision.
        OSError: The file cannot be written; an older one is then left as it was.
    """
    require_one_of("precision", precision, get_args(Precision))
    kind, tensors = FIELD, field_tensors(field)
    if precision == "float16":
        kind, tensors = COMPACT, compact(field, tensors)
    write_tensors(path, {"format": kind} | field_header(field), tensors)


@checked_arguments
def save_checkpoint(path: str | Path, state: TrainingState) -> None:
    """Save a checkpoint: all that a training needs to resume, replacing an older one at once.

    Args:
        path: Of the file; its folder exists.
        state: From ``Trainer.state``, or what ``train`` passes to ``on_checkpoint``.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    training = {
        "scene_digest": state.scene_digest,
        "grown": state.grown,
        "updates": state.updates,
        "restarted": state.restarted,
        "progress": asdict(state.progress),
    }
    if isinstance(state.plan, TrainingPlan):
        kind, training["plan"] = TRAINING, plan_to_json(state.plan)
    else:
        kind, config = WITHOUT_PLAN, config_to_json(state.config)
        training |= asdict(state.plan) | {"config": config}
    header = {"format": kind, "training": training} | field_header(state.field)
    write_tensors(path, header, optimiser_tensors(state) | field_tensors(state.field))


@checked_arguments
def load_field(path: str | Path, device: str = "cpu", threads: int | None = None) -> Field:
    """Load a trained radiance field that ``save_field`` or ``save_checkpoint`` wrote.

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


@checked_arguments
def load_checkpoint(path: str | Path) -> TrainingState:
    """Load a checkpoint, a training that ``save_checkpoint`` wrote, into memory.

    Args:
        path: Of the file.

    Returns:
        The state, to resume from by ``train(scene, resume=state)``.

    Raises:
        InputError: The file is missing, damaged, or of another kind.
    """
    path = Path(path)
    header, tensors = _read(path)
    training = header.training
    if training is None:
        raise InputError(
            f"{path} holds a field but no training to resume; name a checkpoint, or train again."
        )
    if not 0 <= training.updates <= training.progress.step:
        refuse(path, f"{training.updates} updates do not fit {training.progress.step} steps")
    if not 0 <= training.restarted <= training.updates:
        refuse(
            path,
            f"an optimiser of {training.updates} updates cannot restart after {training.restarted}",
        )
    plan = training.plan or training.older
    if plan is None:
        refuse(path, "it holds no plan of its training")
    if isinstance(plan, OlderPlan):
        chosen, each = plan.config.content_distance, bool(plan.content_distances)
        if each != (chosen == "per-camera") and not (each and chosen == "auto"):
            refuse(path, "content distances of cameras are not as its configuration says")
        most = max(len(plan.config.grid.grows_at(kind)) for kind in GROW_AT)
    else:
        most = len(plan.schedule.grow_at)
    workers = Workers("cpu")
    field = _field(header, tensors, path, workers)
    if plan.config.model != field.model:
        refuse(path, "its configuration names another model than its field")
    if plan.config.field != field.storage.kind:
        refuse(path, "its configuration names another storage than its field")
    if plan.sampler != (MARCHED if field.proposal is None else field.proposal.kind):
        refuse(path, "its configuration names another sampler than its field")
    grown = training.grown
    if header.format == "warpnerf-training-6":
        grown = _growths(grown, most, plan.config, field.lattice)
    if not 0 <= grown <= most:
        refuse(path, f"a grid cannot have grown {grown} times")
    return TrainingState(
        plan=plan,
        scene_digest=training.scene_digest,
        grown=grown,
        updates=training.updates,
        restarted=training.restarted,
        progress=training.progress,
        field=field,
        optimiser=read_optimiser(plan.config, field, tensors, path, workers),
    )


def _growths(counted: int, most: int, config: TrainConfig, lattice: Lattice) -> int:
    """How often a grid has grown, where growths may have been counted with one that was none."""
    for grown in (counted, counted - 1):
        if 0 <= grown <= most:
            nodes = config.grid.nodes_after(grown, "object")
            if grid_size(lattice.extent, nodes) == lattice.size:
                return grown
    return counted


class _Training(msgspec.Struct, frozen=True):
    """The header's part that only a training has."""

    scene_digest: str
    grown: int
    updates: int
    progress: Progress
    plan: TrainingPlan | None = None
    older: OlderPlan | None = None
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
    content: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    field: StorageKind = DENSE
    size: tuple[int, int, int] | None = None  # in older files that of the values
    proposal: StoredProposal | None = None


def field_header(field: Field) -> dict[str, Any]:
    """How a field is rendered, in JSON."""
    lattice, frustum = field.lattice, field.lattice.frustum
    header = {
        "model": to_json(field.model),
        "field": to_json(field.storage.kind),
        "size": list(lattice.size),
        "box_min": lattice.box_min.tolist(),
        "box_max": lattice.box_max.tolist(),
        "contraction": lattice.contraction,
        "border": lattice.border,
        "density_shift": field.storage.density_shift,
        "density_scale": field.storage.density_scale,
        "steps": asdict(field.steps),
        "background": list(field.background),
    }
    if field.proposal is not None:
        header["proposal"] = proposal_header(field.proposal)
    if lattice.content is not None:
        header["content"] = lattice.content.tolist()
    if frustum is not None:
        header["frustum"] = {
            "origin": frustum.origin.tolist(),
            "axes": frustum.axes.tolist(),
            "near": frustum.near,
            "depth": frustum.depth,
        }
    return header


def field_tensors(field: Field) -> dict[str, np.ndarray]:
    """The arrays of a field, by name: with its header, all that it renders with."""
    tensors, proposal = field.storage.tensors(), field.proposal
    tensors |= {} if proposal is None else {PARAMETER: proposal.grid.tensors()["values"]}
    tensors["free_distance"] = field.free.distance.numpy().reshape(field.free.size)
    return tensors | ({"weights": field.weights.numpy()} if field.weights.size else {})


def _field(header: _Header, tensors: dict[str, np.ndarray], path: Path, workers: Workers) -> Field:
    free, steps, model, stored = tensors["free_distance"], header.steps, header.model, header.field
    weights = tensors.get("weights", np.zeros(0, np.float32))
    size = header.size
    if size is None and "values" in tensors and tensors["values"].ndim == 4:
        x, y, z = tensors["values"].shape[:3]
        size = x, y, z
    fits = (
        size is not None
        and min(size) >= 2
        and weights.shape == (n_weights(model),)
        and weights.dtype == np.float32
        and np.isfinite(weights).all()
        and free.ndim == 3
        and free.size > 0
        and free.dtype == np.uint8
        and all(low < high for low, high in zip(header.box_min, header.box_max, strict=True))
        and 0.0 <= header.border <= 1.0
        and _frustum_fits(header)
        and (header.content is None or bool(np.less(*header.content).all()))
        and steps.step > 0.0
        and steps.n_linear >= 0
        and steps.growth >= 0.0
        and 0.0 <= steps.transmittance_min < 1.0
        and all(np.isfinite(tensors[name]).all() for name in stored.rules)
    )
    if not fits or size is None:
        refuse(path, "it holds values that cannot be rendered")
    told = header.proposal
    if told is not None and (steps.in_ndc or (told.unit == 0.0 and steps.near == 0.0)):
        refuse(path, "it holds a proposal that its rays do not go with")
    lattice = Lattice(
        size=size,
        box_min=np.array(header.box_min),
        box_max=np.array(header.box_max),
        contraction=header.contraction,
        border=header.border,
        frustum=None
        if header.frustum is None
        else Frustum(
            origin=np.array(header.frustum.origin),
            axes=np.array(header.frustum.axes),
            near=header.frustum.near,
            depth=header.frustum.depth,
        ),
        content=None if header.content is None else np.array(header.content),
    )
    own, arrays = class_of(stored), {name: tensors[name] for name in stored.rules}
    try:
        storage = own.from_tensors(stored, model, lattice, arrays, workers.device)
    except ValueError:
        refuse(path, "it holds values that cannot be rendered")
    return Field(
        model=model,
        storage=replace(
            storage, density_shift=header.density_shift, density_scale=header.density_scale
        ),
        weights=wp.array(weights, dtype=wp.float32, device=workers.device),
        free=FreeCells(
            distance=wp.array(free.reshape(-1), dtype=wp.uint8, device=workers.device),
            size=(free.shape[0], free.shape[1], free.shape[2]),
            border=header.border,
        ),
        steps=steps,
        background=header.background,
        workers=workers,
        proposal=None if told is None else told.read(lattice, tensors, path, workers),
    )


def _frustum_fits(header: _Header) -> bool:
    """Whether there is a frustum where there has to be one, and it is one."""
    frustum, wanted = header.frustum, SPACES[header.contraction].has_frustum
    if frustum is None or not wanted or not header.steps.in_ndc:
        return frustum is None and not wanted and not header.steps.in_ndc
    axes = np.array(frustum.axes)
    return bool(
        np.isfinite(frustum.origin).all()
        and np.abs(axes @ axes.T - np.eye(3)).max() < 1e-6
        and 0.0 < frustum.near < math.inf
        and 0.0 < frustum.depth < math.inf
    )


def _read(path: Path) -> tuple[_Header, dict[str, np.ndarray]]:
    """Header and tensors of a field or a training; what is not ours is refused."""
    tree, tensors = read_tensors(path, (FIELD, COMPACT, TRAINING, *OLDER))
    kind = tree["format"]
    for part, known, what, thing in (
        ("model", MODELS, "of the model", "model"),
        ("field", STORAGE_KINDS, "that is stored as", "storage"),
        ("contraction", SPACES, "in the space", "space"),
    ):
        value = tree.get(part)
        name = value.get("name") if isinstance(value, dict) else value
        if isinstance(name, str) and name not in known and name not in FORMER_NAMES:
            raise InputError(
                f"{path} holds a field {what} {name!r}, but this version knows {', '.join(known)}; "
                f"register that {thing}, or use the version that wrote it."
            )
    try:
        if isinstance(training := tree.get("training"), dict):
            tree["training"] = _with_plan(training)
        header = msgspec.convert(tree, _Header, dec_hook=decode)
    except (msgspec.ValidationError, TypeError) as error:
        refuse(path, f"its header does not fit: {error}")
    if kind == COMPACT:
        kind, tensors = FIELD, expanded(path, tensors, header.size)
    elif kind in OLDER:
        kind = OLDER[kind]
        if "moments" in tensors and "values.moments" not in tensors:
            tensors["values.moments"] = tensors.pop("moments")
    rules = dict(header.field.rules) | ({"weights": "weights"} if n_weights(header.model) else {})
    rules |= {PARAMETER: "nodes"} if header.proposal is not None else {}
    names = {"free_distance", *rules}
    if header.training is not None:
        names |= {
            f"{parameter}.{name}"
            for parameter, rule in rules.items()
            for name in OPTIMISERS[rule].state_names
        }
        plan = header.training.plan or header.training.older
        exposed = {f"{EXPOSURES}.sums", f"{EXPOSURES}.settled"}
        appearance = "none" if plan is None else plan.config.appearance
        if appearance == "affine" or (appearance == "auto" and exposed & set(tensors)):
            names |= exposed
    if set(tensors) != names or (header.training is not None) != (kind == TRAINING):
        refuse(path, f"it holds {', '.join(sorted(tensors))} instead of {', '.join(sorted(names))}")
    return header, tensors


def _with_plan(training: dict[str, Any]) -> dict[str, Any]:
    """A training's part of the header as it is decoded: with a plan, or what there was of one."""
    if isinstance(plan := training.get("plan"), dict):
        return training | {"plan": prepared(plan)}
    return training | {"older": prepared(training)}
