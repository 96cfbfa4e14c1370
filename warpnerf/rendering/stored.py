"""Fields that the operations of several frameworks render: what they store, and checks of that."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpnerf.checked import fits
from warpnerf.checks import InputError, is_finite, require_one_of, require_whole, said
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.storages import class_of
from warpnerf.grid_config import MAX_VOXELS
from warpnerf.model.interface import Model
from warpnerf.model.storage_kinds import (
    AUTO_FIELD,
    DENSE,
    STORAGE_KINDS,
    StorageKind,
    storage_of,
)
from warpnerf.rendering.arguments import Head, head_of, require_ascending, require_box
from warpnerf.runtime import kernel_cache


class StoredField(NamedTuple):
    """A field that is no dense grid: what it stores, and how; ``first_tensors`` begins one."""

    kind: str | StorageKind
    """vm, hash, or a configured one: ``warpnerf.Vm``, ``warpnerf.Hash``."""
    tensors: Mapping[str, Any]
    """By name, in the shapes that ``first_tensors`` gives; all are learned, and of one
    floating-point type."""
    size: Sequence[int] | None = None
    """[3] nodes along each axis, over which a vm has planes and lines; a hash has levels of its
    own, and takes none."""


@dataclass(frozen=True, kw_only=True)
class ArrayShape:
    """Of what a field stores under some name."""

    shape: tuple[int, ...]
    """Of the tensor."""
    width: int | None
    """Of the vectors, its last dimension, that it is as a Warp array [n]; None: of numbers."""


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

    @property
    def lattice(self) -> Lattice:
        """Over its box."""
        lower, upper = (np.array(corner, np.float64) for corner in self.corners)
        return Lattice(box_min=lower, box_max=upper, size=self.size)

    @property
    def arrays(self) -> dict[str, ArrayShape]:
        """What it stores, by name."""
        shapes = class_of(self.kind).shapes(self.kind, self.model, self.lattice)
        return {
            name: ArrayShape(
                shape=shapes[name], width=shapes[name][-1] if rule == "nodes" else None
            )
            for name, rule in self.kind.rules.items()
        }


def layout_of(field: StoredField, model: Model, corners: tuple[np.ndarray, np.ndarray]) -> Layout:
    """How a field is stored.

    Args:
        field: Which one; of its tensors, names alone are looked at.
        model: What it holds.
        corners: [3] each of its box, scene units.

    Raises:
        InputError: It is stored in nothing that is known, or has other tensors or another size.
    """
    kind, tensors = field.kind, field.tensors
    if isinstance(kind, str):
        require_one_of("kind", kind, [name for name in STORAGE_KINDS if name != AUTO_FIELD.name])
        kind = storage_of(kind)
    if not isinstance(kind, StorageKind) or kind == AUTO_FIELD:
        raise InputError(f"kind must be vm, hash, or one of these configured, not {said(kind)}.")
    names = list(kind.rules)
    if not isinstance(tensors, Mapping) or set(tensors) != set(names):
        found = list(tensors) if isinstance(tensors, Mapping) else tensors
        raise InputError(
            f"tensors of a {kind.name} must be {', '.join(names)}, by name, not {said(found)}."
        )
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
    """The tensors of a ``StoredField`` before training.

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
    model, _ = head_of(head)
    require_whole("seed", seed, 0)
    known = storage_of(kind) if isinstance(kind, str) and kind in STORAGE_KINDS else kind
    names = known.rules if isinstance(known, StorageKind) and known != AUTO_FIELD else {}
    layout = layout_of(StoredField(kind, names, size), model, _corners(box))
    kernel_cache.start()
    cpu = wp.get_device("cpu")
    return class_of(layout.kind).first(layout.kind, model, layout.lattice, seed, cpu).tensors()


def require_stored(name: str, shape: Sequence[int], expected: ArrayShape) -> None:
    """Raise InputError unless a tensor of a field has its shape."""
    if tuple(shape) != expected.shape:
        raise InputError(
            f"tensors[{name!r}] must be {list(expected.shape)} here, not {list(shape)}; "
            "first_tensors gives some that fit."
        )


def _size_of(kind: StorageKind, size: Any) -> tuple[int, int, int]:
    """Nodes of the lattice along each axis.

    Raises:
        InputError: They are no such numbers.
    """
    if not kind.as_fine_as_nodes:
        if size is not None:
            raise InputError(f"size must be None, not {said(size)}: a {kind.name} has its levels.")
        return 2, 2, 2
    if not isinstance(size, Sequence) or len(size) != 3 or not all(fits(n, int) for n in size):
        raise InputError(
            f"size must be three whole numbers, the nodes of a {kind.name} along each axis, not "
            f"{said(size)}."
        )
    if min(size) < 2 or math.prod(size) >= MAX_VOXELS:
        raise InputError(
            f"size must be two nodes or more along each axis, and fewer than {MAX_VOXELS} in all, "
            f"not {said(size)}."
        )
    x, y, z = map(int, size)
    return x, y, z


def _corners(box: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of a box that is given as numbers.

    Raises:
        InputError: It is none.
    """
    require_box(box)
    for field, corner in zip(("box_min", "box_max"), box, strict=True):
        if not fits(corner, Sequence | np.ndarray) or not all(map(is_finite, corner)):
            raise InputError(f"{field} must be three finite numbers, not {said(corner)}.")
        if len(corner) != 3:
            raise InputError(f"{field} must be three finite numbers, not {len(corner)}.")
    corners = np.array(box[0], np.float64), np.array(box[1], np.float64)
    require_ascending(corners)
    return corners


def _layout(
    kind: StorageKind,
    model: Model,
    corners: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int, int],
) -> Layout:
    lower, upper = (tuple(corner.tolist()) for corner in corners)
    return Layout(kind=kind, model=model, corners=(lower, upper), size=size)
