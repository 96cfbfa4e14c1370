"""A field in a file: safetensors, with a digest over everything that matters, and no pickle."""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta

from warpnerf.atomic import write_bytes
from warpnerf.checks import InputError
from warpnerf.config import Contraction

if TYPE_CHECKING:
    from warpnerf.field import Field

VERSION = 1
"""Of the format; a reader refuses any other."""

_Positive = Annotated[float, Meta(gt=0.0)]
_NotNegative = Annotated[float, Meta(ge=0.0)]
_Share = Annotated[float, Meta(ge=0.0, le=1.0)]


class _StepsHeader(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``Steps``."""

    near: _NotNegative
    far: _Positive
    step: _Positive
    n_linear: Annotated[int, Meta(ge=0, lt=2**31)]
    growth: _NotNegative
    transmittance_min: _Share


class _Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a field is besides its tensors; lengths in scene units."""

    box_min: tuple[float, float, float]
    box_max: tuple[float, float, float]
    contraction: Contraction
    border: _Share
    density_shift: float
    density_scale: _Positive
    steps: _StepsHeader
    background: tuple[_Share, _Share, _Share]
    metadata: dict[str, str]


def save_field(path: str | Path, field: Field, metadata: dict[str, str] | None = None) -> None:
    """Write a field: values [X, Y, Z, 4] float32, free_distance [MX, MY, MZ] uint8, and a header.

    The file is replaced as a whole or not at all.

    Args:
        path: Where to; its folder exists.
        field: The field.
        metadata: What to keep with it, such as the content distance; see ``read_metadata``.

    Raises:
        OSError: The file cannot be written.
    """
    from safetensors.numpy import save

    grid, free = field.grid, field.free
    tensors = {
        "values": np.ascontiguousarray(grid.values.numpy().reshape(*grid.size, 4), np.float32),
        "free_distance": np.ascontiguousarray(free.distance.numpy().reshape(free.size), np.uint8),
    }
    header = _Header(
        box_min=_triple(grid.box_min),
        box_max=_triple(grid.box_max),
        contraction=grid.contraction,
        border=grid.border,
        density_shift=grid.density_shift,
        density_scale=grid.density_scale,
        steps=_StepsHeader(**asdict(field.steps)),
        background=_triple(field.background),
        metadata=metadata or {},
    )
    text = msgspec.json.encode(header).decode()
    notes = {"version": str(VERSION), "warpnerf": text, "sha256": _digest(text, tensors)}
    write_bytes(Path(path), save(tensors, metadata=notes))


def load_field(path: str | Path, device: str = "cpu", threads: int | None = None) -> Field:
    """Read a field that ``save_field`` wrote.

    Args:
        path: The file.
        device: Where it shall live: cpu, cuda, cuda:1, ...
        threads: CPU threads; None: one per core.

    Raises:
        InputError: The file is missing, foreign, cut or damaged, or the device is missing.
    """
    header, tensors = _read(Path(path))

    import warp as wp
    from warpnerf_kernels.types import vec4

    from warpnerf.field import Field
    from warpnerf.grid import FreeCells, VoxelGrid
    from warpnerf.parallel import Workers
    from warpnerf.render import Steps

    workers = Workers(device, threads)
    values, distance = tensors["values"], tensors["free_distance"]
    return Field(
        grid=VoxelGrid(
            values=wp.array(values.reshape(-1, 4), dtype=vec4, device=workers.device),
            size=_size(values),
            box_min=np.array(header.box_min),
            box_max=np.array(header.box_max),
            contraction=header.contraction,
            border=header.border,
            density_shift=header.density_shift,
            density_scale=header.density_scale,
        ),
        free=FreeCells(
            distance=wp.array(distance.reshape(-1), dtype=wp.uint8, device=workers.device),
            size=_size(distance),
        ),
        steps=Steps(**msgspec.structs.asdict(header.steps)),
        background=header.background,
        workers=workers,
    )


def read_metadata(path: str | Path) -> dict[str, str]:
    """What ``save_field`` was given to keep with the field.

    Raises:
        InputError: As ``load_field``.
    """
    return _read(Path(path))[0].metadata


def _read(path: Path) -> tuple[_Header, dict[str, np.ndarray]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        # Read, not mapped: a file that another process cuts meanwhile must not kill this one.
        content = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give a run's field.safetensors."
        ) from error
    try:
        tensors = load(content)
        notes = _notes(content)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: is not a whole safetensors file ({error}); train again, or take a copy that "
            "is intact."
        ) from None
    version = notes.get("version")
    text = notes.get("warpnerf")
    if version is None or text is None:
        raise InputError(f"{path}: is no field of warpnerf; give a run's field.safetensors.")
    if version != str(VERSION):
        raise InputError(
            f"{path}: has format version {version}, but this warpnerf reads {VERSION}; use the "
            "warpnerf that wrote it, or train again."
        )
    if notes.get("sha256") != _digest(text, tensors):
        raise InputError(
            f"{path}: is damaged, its SHA-256 does not match; train again, or take a copy that is "
            "intact."
        )
    try:
        header = msgspec.json.decode(text, type=_Header)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: header: {error}; train again.") from None
    problem = _problem(header, tensors)
    if problem:
        raise InputError(f"{path}: {problem}; train again.")
    return header, tensors


def _notes(content: bytes) -> dict[str, str]:
    """The metadata of a safetensors file: after 8 bytes of length, a JSON object."""
    length = int.from_bytes(content[:8], "little")
    header: dict[str, Any] = msgspec.json.decode(content[8 : 8 + length])
    return msgspec.convert(header.get("__metadata__", {}), dict[str, str])


def _problem(header: _Header, tensors: dict[str, np.ndarray]) -> str | None:
    """What keeps this from being a field: half a sentence."""
    values, distance = tensors.get("values"), tensors.get("free_distance")
    if values is None or distance is None or len(tensors) != 2:
        return f"holds {', '.join(sorted(tensors)) or 'nothing'}, not values and free_distance"
    if values.dtype != np.float32 or values.ndim != 4 or values.shape[3] != 4:
        return f"values must be [X, Y, Z, 4] float32, not {list(values.shape)} {values.dtype}"
    if min(values.shape[:3]) < 2:
        return f"values must have at least 2 nodes along each axis, not {list(values.shape[:3])}"
    if distance.dtype != np.uint8 or distance.ndim != 3 or min(distance.shape) < 1:
        return (
            f"free_distance must be [MX, MY, MZ] uint8, not {list(distance.shape)} {distance.dtype}"
        )
    if not np.isfinite(values).all():
        return "values hold NaN or infinity"
    numbers = (*header.box_min, *header.box_max, header.density_shift)
    if not all(math.isfinite(number) for number in numbers):
        return "the header holds a number that is not finite"
    if not all(low < high for low, high in zip(header.box_min, header.box_max, strict=True)):
        return f"box_min {header.box_min} must lie below box_max {header.box_max}"
    if (header.contraction == "none") != (header.border == 0.0):
        return f"contraction {header.contraction} does not go with border {header.border}"
    if not header.steps.near < header.steps.far:
        return "steps.far must lie beyond steps.near"
    return None


def _digest(text: str, tensors: dict[str, np.ndarray]) -> str:
    """SHA-256 over the header and, by name, each tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(text.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"\n{name} {tensor.dtype.str} {tensor.shape}\n".encode())
        digest.update(np.ascontiguousarray(tensor).data)
    return digest.hexdigest()


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _size(tensor: np.ndarray) -> tuple[int, int, int]:
    return int(tensor.shape[0]), int(tensor.shape[1]), int(tensor.shape[2])
