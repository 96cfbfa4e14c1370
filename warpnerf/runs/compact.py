"""Compact fields: half precision, and no features where rays do not read any.

Arrays of nodes and entries are stored in float16, which costs less than 0.001 dB; what decodes
them, and proposals, stay float32, as they are small. Of a dense grid all raw densities are stored,
but features only of nodes that are next to an occupied cell and are not zero:

NAME.density    [X, Y, Z] float16
NAME.features   [n, n_floats - 1] float16, of the nodes that are kept, in their order
NAME.kept       [ceil(X Y Z / 8)] uint8, a bit for each node, the first the highest

A number that float16 cannot hold keeps its array in float32.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.nodes import nodes_of_cells
from warpnerf.rendering.field import Field
from warpnerf.runs.tensor_file import refuse

Precision = Literal["float32", "float16"]
"""Of the numbers of a field in a file."""
COMPACT = "warpnerf-field-3"
"""The format of a field in half precision."""
DENSITY, FEATURES, KEPT = ".density", ".features", ".kept"
"""What the names of a dense grid's arrays end in."""


def compact(field: Field, tensors: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Tensors of a field in half precision, as files of finished runs hold them.

    Args:
        field: Whose they are.
        tensors: By name, float32 or uint8.

    Returns:
        What ``expanded`` takes back.
    """
    stored = dict(tensors)
    for name, rule in field.storage.kind.rules.items():
        if rule == "weights":
            continue
        values = stored.pop(name)
        if not isinstance(field.storage, DenseGrid) or values.shape[3] == 1:
            stored[name] = _half(values)
            continue
        occupied = field.free.distance.numpy().reshape(field.free.size) == 0
        kept = nodes_of_cells(field.lattice, occupied) & (values[..., 1:] != 0.0).any(axis=-1)
        stored[name + DENSITY] = _half(values[..., 0])
        stored[name + FEATURES] = _half(values[..., 1:][kept])
        stored[name + KEPT] = np.packbits(kept)
    return stored


def expanded(
    path: Path, tensors: Mapping[str, np.ndarray], size: tuple[int, int, int] | None
) -> dict[str, np.ndarray]:
    """Tensors of a field in float32 again; features that were not stored are 0.

    Args:
        path: Of their file, for messages.
        tensors: From ``compact``.
        size: Nodes of the lattice.

    Raises:
        DamagedFileError: They do not fit each other.
    """
    whole = {
        name: tensor.astype(np.float32) if tensor.dtype == np.float16 else tensor
        for name, tensor in tensors.items()
    }
    for name in [key.removesuffix(KEPT) for key in tensors if key.endswith(KEPT)]:
        nothing = np.zeros(0, np.float32)
        bits = whole.pop(name + KEPT)
        density, features = (whole.pop(name + end, nothing) for end in (DENSITY, FEATURES))
        n = 0 if size is None else math.prod(size)
        if bits.dtype != np.uint8 or bits.ndim != 1 or name in whole:
            refuse(path, f"its bits of '{name}' are none")
        misfit = f"its nodes of '{name}' do not fit each other"
        if (
            size is None
            or density.shape != size
            or bits.shape != (-(-n // 8),)
            or features.ndim != 2
            or not density.dtype == features.dtype == np.float32
        ):
            refuse(path, misfit)
        kept = np.unpackbits(bits.astype(np.uint8), count=n)  # not before: sizes may be forged
        if np.count_nonzero(kept) != len(features):
            refuse(path, misfit)
        values = np.zeros((*size, 1 + features.shape[1]), np.float32)
        values[..., 0] = density
        values[kept.reshape(size).astype(bool), 1:] = features
        whole[name] = values
    return whole


def _half(values: np.ndarray) -> np.ndarray:
    """An array in float16, where that can hold all of its numbers."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.isfinite(half).all() else values
