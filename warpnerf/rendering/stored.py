"""Fields that the operations of several frameworks render: what they store, and checks of that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import warp as wp

from warpnerf.checked import fits
from warpnerf.checks import InputError, require_one_of, require_whole, said
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.storage import ArrayShape
from warpnerf.fields.storages import STORAGES, class_of
from warpnerf.grid_config import MAX_VOXELS
from warpnerf.model.interface import Model
from warpnerf.model.storage_kinds import DENSE, StorageKind, storage_of
from warpnerf.rendering.arguments import Head, StoredField, corners_of, model_in
from warpnerf.runtime import kernel_cache


@dataclass(frozen=True, kw_only=True)
class Layout:
    """What a field is stored in, and which arrays these are."""

    kind: StorageKind
    """What it is stored in."""
    model: Model
    """What it holds."""
    corners: tuple[tuple[float, ...], tuple[float, ...]]
    """[3] each of its box, scene units."""
    size: tuple[int, int, int]
    """Nodes of its lattice along each axis."""

    @cached_property
    def lattice(self) -> Lattice:
        """Over its box."""
        lower, upper = (np.array(corner, np.float64) for corner in self.corners)
        return Lattice(box_min=lower, box_max=upper, size=self.size)

    @cached_property
    def arrays(self) -> dict[str, ArrayShape]:
        """What it stores, by name, in the order of the kind's ``rules``."""
        shapes = class_of(self.kind).array_shapes(self.kind, self.model, self.lattice)
        return {name: shapes[name] for name in self.kind.rules}


def named_tensors(field: StoredField) -> dict[str, Any]:
    """What a field stores, by name.

    Raises:
        InputError: It has no names.
    """
    if not (hasattr(field.tensors, "keys") and hasattr(field.tensors, "__getitem__")):
        raise InputError(
            f"tensors of a field must be a dictionary of them, not {said(field.tensors)}; "
            "first_tensors gives one."
        )
    return {name: field.tensors[name] for name in field.tensors.keys()}  # noqa: SIM118


def layout_of(field: StoredField, model: Model, corners: tuple[np.ndarray, np.ndarray]) -> Layout:
    """How a field is stored.

    Args:
        field: Which one; of its tensors, names alone are looked at.
        model: What it holds.
        corners: [3] each of its box, scene units.

    Raises:
        InputError: It is stored in nothing that is known, or has other tensors or another size.
    """
    kind, found = _kind_of(field.kind), list(named_tensors(field))
    if set(found) != set(kind.rules):
        names = ", ".join(kind.rules)
        raise InputError(f"tensors of a {kind.name} must be {names}, by name, not {said(found)}.")
    return _layout(kind, model, corners, _size_of(kind, field.size))


def dense_layout(
    shape: Sequence[int], model: Model, corners: tuple[np.ndarray, np.ndarray]
) -> Layout:
    """How a dense grid is stored.

    Args:
        shape: X, Y, Z, and numbers of a node.
        model: What it holds.
        corners: [3] each of its box, scene units.

    Raises:
        InputError: It is no grid of the model's nodes.
    """
    numbers = 1 + model.n_features
    if len(shape) != 4 or shape[3] != numbers or min(shape[:3]) < 2:
        raise InputError(
            f"raw must be [X, Y, Z, {numbers}] with at least two nodes along each axis, "
            f"not {list(shape)}."
        )
    if math.prod(shape[:3]) >= MAX_VOXELS:
        raise InputError(
            f"raw must have fewer than {MAX_VOXELS} nodes, not {math.prod(shape[:3])}."
        )
    return _layout(DENSE, model, corners, (shape[0], shape[1], shape[2]))


def first_tensors(
    kind: str | StorageKind,
    box: tuple[Sequence[float], Sequence[float]],
    size: Sequence[int] | None = None,
    *,
    head: str | Model | Head = "rgb",
    seed: int = 0,
) -> dict[str, np.ndarray]:
    """Initial values of the tensors of a ``StoredField``, as a training begins.

    Those of a vm (TensoRF, Chen et al. 2022) are planes [X Y + X Z + Y Z, width]: xy, xz and yz,
    second axis fastest; lines [Z + Y + X, width]: z, y and x; and the decoder [3 width, columns],
    which takes their products to raw density and features. Those of a hash (Instant-NGP, Müller et
    al. 2022) are values [n_entries, features], level by level; the hidden layer
    [levels features, hidden], if there is one; and the decoder.

    Args:
        kind: See ``StoredField``.
        box: Its lower and its upper corner, [3] each, scene units.
        size: See ``StoredField``.
        head: What it is to hold; see ``render_rays``.
        seed: Of what is random.

    Returns:
        float32 arrays by name.

    Raises:
        InputError: There is no such kind, or its size or box do not fit.
    """
    model = model_in(head)
    require_whole("seed", seed, 0)
    chosen, corners = _kind_of(kind), corners_of(box)
    layout = _layout(chosen, model, corners, _size_of(chosen, size))
    kernel_cache.start()
    cpu = wp.get_device("cpu")
    return class_of(chosen).first(chosen, model, layout.lattice, seed, cpu).tensors()


def require_stored(name: str, shape: Sequence[int], expected: ArrayShape) -> None:
    """Raise InputError unless a tensor of a field has its shape."""
    if tuple(shape) != expected.shape:
        raise InputError(
            f"tensors[{name!r}] must be {list(expected.shape)} here, not {list(shape)}; "
            "first_tensors gives some that fit."
        )


def _kind_of(kind: Any) -> StorageKind:
    """What a field is stored in.

    Raises:
        InputError: It is a dense grid, or nothing that is known.
    """
    known = [name for name in STORAGES if name != DENSE.name]
    if isinstance(kind, str):
        require_one_of("kind", kind, known)
        kind = storage_of(kind)
    if not isinstance(kind, StorageKind) or kind.name not in known:
        raise InputError(
            f"kind must be {' or '.join(known)}, or one configured, as warpnerf.Vm(appearance=28), "
            f"not {said(kind)}; a dense grid is given as it is."
        )
    return kind


def _size_of(kind: StorageKind, size: Any) -> tuple[int, int, int]:
    """Nodes of the lattice along each axis.

    Raises:
        InputError: They are no such numbers.
    """
    if not kind.as_fine_as_nodes:
        if size is not None:
            raise InputError(
                f"size must be left out, not {said(size)}: a {kind.name} has levels of its own."
            )
        return 2, 2, 2
    if not isinstance(size, Sequence) or len(size) != 3 or not all(fits(n, int) for n in size):
        raise InputError(
            f"size must be three whole numbers, nodes along each axis for the {kind.name}, not "
            f"{said(size)}."
        )
    x, y, z = map(int, size)
    if min(x, y, z) < 2 or x * y * z >= MAX_VOXELS:
        raise InputError(
            f"size must be two nodes or more along each axis, and fewer than {MAX_VOXELS} in all, "
            f"not {said(size)}."
        )
    return x, y, z


def _layout(
    kind: StorageKind,
    model: Model,
    corners: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int, int],
) -> Layout:
    lower, upper = (tuple(corner.tolist()) for corner in corners)
    return Layout(kind=kind, model=model, corners=(lower, upper), size=size)
