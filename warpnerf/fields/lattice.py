"""The lattice (voxel grid geometry) of a field: nodes over a space, their growth and exports."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import types
from warpnerf_kernels.base.types import Box

from warpnerf.scenes.extent.frustum import Frustum
from warpnerf.scenes.extent.space import Space

SHOWN = 8.0
"""Depth, in near planes of a frustum, to which a box around it reaches: the rest is background."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lattice(Space):
    """A lattice of nodes [X, Y, Z] over a space, z fastest, those at the ends on its faces.

    A dense grid has a value at each; other storages are read at them where somebody needs values in
    a lattice.
    """

    size: tuple[int, int, int]
    """X, Y, Z."""

    @classmethod
    def over(cls, space: Space, size: tuple[int, int, int]) -> Lattice:
        """So many nodes over a space."""
        of_space = {field.name: getattr(space, field.name) for field in fields(Space)}
        return cls(**of_space, size=size)

    @property
    def space(self) -> Space:
        """That its nodes fill."""
        return Space(**{field.name: getattr(self, field.name) for field in fields(Space)})

    @property
    def voxel_size(self) -> np.ndarray:
        """Distance between nodes inside the box, [3] scene units."""
        return self.voxel_edges(self.size)

    @property
    def surroundings(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, [3] scene units, of a box around what it holds: its content, or its frustum."""
        if self.frustum is None:
            own = np.stack([self.box_min, self.box_max])
            return tuple(own if self.content is None else self.content)
        high = self.box_max.copy()
        high[2] = min(high[2], self.frustum.depth * (1.0 - 1.0 / SHOWN))
        ends = np.stack([self.box_min, high])
        corners = np.stack(np.meshgrid(*ends.T), axis=-1).reshape(-1, 3)
        points = self.frustum.to_scene(corners)
        return points.min(axis=0), points.max(axis=0)

    @property
    def diagonal(self) -> float:
        """Of the box, in its units."""
        return float(np.linalg.norm(self.box_max - self.box_min))

    @property
    def cells(self) -> tuple[int, int, int]:
        """MX, MY, MZ cells of free space: each is two voxels wide, or a little more."""
        x, y, z = (max(1, (n - 1) // 2) for n in self.size)
        return x, y, z

    @cached_property
    def box(self) -> Box:
        """Its box as kernels take it that do not follow rays."""
        return box_struct(types, self.box_min, self.box_max, self.border)

    def box_between(self, near: float, far: float) -> Box:
        """Its box as kernels take it, for rays from near to far.

        Args:
            near: Nothing is sampled nearer to their origins, scene units; for boxes in a frustum,
                as those in the scene leave that to the steps.
            far: Nor at this distance or beyond.
        """
        box = box_struct(types, self.box_min, self.box_max, self.border)
        if self.frustum is not None:
            box.frustum = frustum_struct(types, self.frustum, near, far)
        return box


def box_struct(types: ModuleType, box_min: np.ndarray, box_max: np.ndarray, border: float) -> Any:
    """A kernel's Box, in the precision of the given ``warpnerf_kernels.base.types``."""
    box = types.Box()
    box.centre = types.vec3(*(0.5 * (box_min + box_max)))
    box.half = types.vec3(*(0.5 * (box_max - box_min)))
    box.border = border
    return box


def frustum_struct(types: ModuleType, frustum: Frustum, near: float, far: float) -> Any:
    """A kernel's Frustum, in the precision of the given ``warpnerf_kernels.base.types``."""
    struct = types.Frustum()
    struct.origin = types.vec3(*frustum.origin)
    struct.axes = types.mat33(*frustum.axes.ravel())
    struct.near, struct.depth = frustum.near, frustum.depth
    struct.begin, struct.end = near, far
    return struct


def grid_struct(
    dense: ModuleType, values: wp.array, size: tuple[int, int, int], border: float
) -> Any:
    """A kernel's Grid, in the precision of the given ``warpnerf_kernels.fields.dense``."""
    grid = dense.grid_type(values.dtype._length_)()
    grid.values = values
    grid.size = wp.vec3i(*size)
    middle = 0.5 * (np.array(size) - 1)
    grid.to_nodes = dense.vec3(*(middle / (1.0 + border)))
    grid.middle = dense.vec3(*middle)
    return grid
