"""A field in a file: safetensors, written whole or not at all, checked when read. No pickle."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.types import vec4

from warpnerf.checks import InputError
from warpnerf.field import Field
from warpnerf.grid import CONTRACTIONS, FreeCells, VoxelGrid
from warpnerf.parallel import Workers
from warpnerf.render import Steps

FORMAT = "warpnerf-field-1"


def save_field(path: str | Path, field: Field) -> None:
    """Write a field to a file, replacing an older one in a single step.

    Args:
        path: Of the file; its folder exists.
        field: What to write.

    Raises:
        OSError: The file cannot be written; an older one is then left as it was.
    """
    from safetensors.numpy import save

    grid = field.grid
    tensors = {
        "values": grid.values.numpy().reshape(*grid.size, 4),
        "free_distance": field.free.distance.numpy().reshape(field.free.size),
    }
    header = {
        "format": FORMAT,
        "box_min": grid.box_min.tolist(),
        "box_max": grid.box_max.tolist(),
        "contraction": grid.contraction,
        "border": grid.border,
        "density_shift": grid.density_shift,
        "density_scale": grid.density_scale,
        "steps": asdict(field.steps),
        "background": list(field.background),
    }
    text = json.dumps(header, sort_keys=True)
    metadata = {"header": text, "sha256": _digest(text, tensors)}
    write_atomically(path, save(tensors, metadata))


def load_field(path: str | Path, device: str = "cpu", threads: int | None = None) -> Field:
    """Read a field that ``save_field`` wrote.

    Args:
        path: Of the file.
        device: Where the field shall live.
        threads: CPU threads; None: one per core.

    Raises:
        InputError: The file is missing, damaged, or of another kind; or the device is missing.
    """
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in sorted(file.keys())}
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist; train first, or name another file.") from error
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is not a readable safetensors file ({error}); it may be cut off: train again."
        ) from error
    if metadata.get("sha256") != _digest(metadata.get("header", ""), tensors):
        raise InputError(f"{path} is damaged: its content does not match its SHA-256; train again.")
    header = json.loads(metadata["header"])
    if header.get("format") != FORMAT:
        raise InputError(
            f"{path} has format {header.get('format')!r}, but this version reads {FORMAT!r}."
        )
    workers = Workers(device, threads)
    try:
        return _field(header, tensors, path, workers)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a whole field ({error}); train again.") from error


def _field(
    header: dict[str, Any], tensors: dict[str, np.ndarray], path: Path, workers: Workers
) -> Field:
    values, free = tensors["values"], tensors["free_distance"]
    numbers = [*header["box_min"], *header["box_max"], *header["steps"].values()]
    whole = (
        header["contraction"] in CONTRACTIONS
        and values.ndim == 4
        and values.shape[3] == 4
        and min(values.shape[:3]) >= 2
        and values.dtype == np.float32
        and free.ndim == 3
        and free.size > 0
        and free.dtype == np.uint8
        and 0.0 <= header["border"] <= 1.0
        and header["steps"]["step"] > 0.0
        and np.isfinite(numbers).all()
        and np.isfinite(values).all()
    )
    if not whole:
        raise InputError(f"{path} holds values that cannot be rendered; train again.")
    grid = VoxelGrid(
        values=wp.array(values.reshape(-1, 4), dtype=vec4, device=workers.device),
        size=(values.shape[0], values.shape[1], values.shape[2]),
        box_min=np.array(header["box_min"]),
        box_max=np.array(header["box_max"]),
        contraction=header["contraction"],
        border=header["border"],
        density_shift=header["density_shift"],
        density_scale=header["density_scale"],
    )
    return Field(
        grid=grid,
        free=FreeCells(
            distance=wp.array(free.reshape(-1), dtype=wp.uint8, device=workers.device),
            size=(free.shape[0], free.shape[1], free.shape[2]),
        ),
        steps=Steps(**header["steps"]),
        background=tuple(header["background"]),
        workers=workers,
    )


def write_atomically(path: str | Path, data: bytes) -> None:
    """Write a file so that its name always leads to all of the old content or all of the new.

    Raises:
        OSError: It cannot be written.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
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
