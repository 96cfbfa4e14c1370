"""The voxel grid on its device: values, their place in the world, and what of it is free."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import types
from warpnerf_kernels.base.parts import Sampler
from warpnerf_kernels.base.types import Box, Density, FreeSpace, real, vec3
from warpnerf_kernels.fields import dense, dense_bound
from warpnerf_kernels.sampling import occupancy
from warpnerf_kernels.sampling.steps import STEPS
from warpnerf_kernels.space import contraction

from warpnerf.checks import InputError
from warpnerf.config import MAX_VOXELS, TRAINING_BYTES, Contraction
from warpnerf.runtime.memory import prefer_large_pages, usable_memory
from warpnerf.runtime.parallel import NODES, Workers
from warpnerf.scenes.frustum import Frustum

CONTRACTIONS = {
    "none": contraction.NONE,
    "linf": contraction.LINF,
    "l2": contraction.L2,
    "ndc": contraction.NDC,
}

SHOWN = 8.0
"""Depth, in near planes of a frustum, to which a box around it reaches: the rest is background."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VoxelGrid:
    """A dense grid [X, Y, Z] of raw values, z fastest, nodes on the box's faces.

    Box and lengths are in scene units, but in coordinates of the frustum where there is one.
    """

    values: wp.array
    """[X * Y * Z] vectors: raw density, raw features, padding to a power of two."""
    size: tuple[int, int, int]
    """X, Y, Z."""
    box_min: np.ndarray
    """[3] float64, lower corner, scene units."""
    box_max: np.ndarray
    """[3] float64, upper corner."""
    contraction: Contraction = "none"
    """How space outside the box is folded into a shell around it."""
    border: float = 0.0
    """Width of that shell, in half edges of the box; 0 without contraction."""
    density_shift: float = 0.0
    """sigma = density_scale softplus(raw density + density_shift)."""
    density_scale: float = 1.0
    """1 / scene unit."""
    frustum: Frustum | None = None
    """Whose coordinates the box has, with ndc."""

    @property
    def folded(self) -> bool:
        """Whether space outside the box is folded in."""
        return self.contraction in ("linf", "l2")

    @property
    def voxel_size(self) -> np.ndarray:
        """Distance between nodes inside the box, [3] scene units."""
        extent = (self.box_max - self.box_min) * (1.0 + self.border)
        return extent / (np.array(self.size) - 1)

    @property
    def surroundings(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, [3] scene units, of a box around what it holds: its own, or around a frustum."""
        if self.frustum is None:
            return self.box_min, self.box_max
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
    def n_floats(self) -> int:
        """Numbers of a node."""
        return int(self.values.dtype._length_)

    @cached_property
    def struct(self) -> Any:
        """The grid as kernels take it."""
        return grid_struct(dense, self.values, self.size, self.border)

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

    @cached_property
    def density(self) -> Density:
        """From raw to density, as kernels take it."""
        return density_struct(types, self.density_shift, self.density_scale)

    def copied_to(self, device: wp.Device) -> VoxelGrid:
        """The same with values of its own.

        Args:
            device: Where they lie.
        """
        values = room_for_nodes(self.values.shape[0], self.values.dtype, device)
        wp.copy(values, self.values)
        return replace(self, values=values)

    def resized(
        self,
        workers: Workers,
        size: tuple[int, int, int],
        box: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> VoxelGrid:
        """The same field on another grid, trilinearly read off this one.

        Args:
            workers: Where to work.
            size: Nodes of the new grid.
            box: Corners of the new grid, within this one's; None: the same. Not with contraction.
        """
        box_min, box_max = box or (self.box_min, self.box_max)
        values = room_for_nodes(math.prod(size), self.values.dtype, workers.device)
        grid = replace(self, values=values, size=size, box_min=box_min, box_max=box_max)
        self.resample(dense.resample_kernel(self.n_floats), self.values, grid, values, workers)
        return grid

    def resample(
        self, kernel: wp.Kernel, source: wp.array, other: VoxelGrid, out: wp.array, workers: Workers
    ) -> None:
        """Read an array over this grid's nodes at another's.

        Args:
            kernel: ``dense.resample_kernel``, or one like it.
            source: [n_nodes]
            other: The other grid.
            out: [other n_nodes] written.
            workers: Where to work.
        """
        old = (np.array(self.size) - 1) / (self.box_max - self.box_min)
        new = (other.box_max - other.box_min) / (np.array(other.size) - 1)
        scale, offset = vec3(*(old * new)), vec3(*(old * (other.box_min - self.box_min)))
        workers.launch(
            kernel,
            out.shape[0],
            *(source, wp.vec3i(*self.size), scale, offset),
            *(wp.vec3i(*other.size), out),
        )


def room_for_nodes(n_nodes: int, dtype: Any, device: wp.Device) -> wp.array:
    """Values of nodes, not yet written: [n_nodes], on the CPU on large pages where there are any.

    Args:
        n_nodes: How many.
        dtype: What a node holds.
        device: Where it lies.
    """
    values = wp.empty(n_nodes, dtype=dtype, device=device)
    if device.is_cpu:
        prefer_large_pages(values.ptr, values.capacity)
    return values


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


def density_struct(types: ModuleType, shift: float, scale: float) -> Any:
    """A kernel's Density, in the precision of the given ``warpnerf_kernels.base.types``."""
    density = types.Density()
    density.shift = shift
    density.scale = scale
    return density


def free_struct(
    types: ModuleType, distance: wp.array, size: tuple[int, int, int], border: float
) -> Any:
    """A kernel's FreeSpace over a grid with this border, in the precision of ``types``."""
    free = types.FreeSpace()
    free.distance = distance
    free.size = wp.vec3i(*size)
    free.to_cells = types.vec3(*(0.5 * np.array(size) / (1.0 + border)))
    return free


def reach_of_places(box_min: np.ndarray, box_max: np.ndarray, places: np.ndarray) -> float:
    """Distance from the outermost of some places, [n, 3], to the farthest corner of a box."""
    centre, corner = 0.5 * (box_min + box_max), 0.5 * float(np.linalg.norm(box_max - box_min))
    return corner + float(np.linalg.norm(places - centre, axis=1).max(initial=0.0))


def grid_size(extent: np.ndarray, voxels: int) -> tuple[int, int, int]:
    """Nodes along each axis so that voxels are cubes and about `voxels` in all.

    Args:
        extent: [3] edges of the domain, scene units.
        voxels: Nodes in all.
    """
    edge = (np.prod(extent) / voxels) ** (1.0 / 3.0)
    size = np.maximum(2, np.round(extent / edge).astype(int) + 1)
    return int(size[0]), int(size[1]), int(size[2])


def training_bytes(size: tuple[int, int, int], n_floats: int) -> int:
    """Memory that training a grid takes: values, two moments together, and a gradient."""
    return math.prod(size) * n_floats * TRAINING_BYTES


def require_memory(size: tuple[int, int, int], n_floats: int, device: wp.Device) -> None:
    """Raise InputError if training a grid of this size does not fit the memory of the device."""
    if math.prod(size) >= MAX_VOXELS:
        raise InputError(
            f"grid.voxels must give fewer than {MAX_VOXELS} nodes, not {math.prod(size)}; use "
            "fewer voxels."
        )
    needed = training_bytes(size, n_floats)
    total = device.total_memory if device.is_cuda else usable_memory()
    where = device if device.is_cuda else "this machine"
    if total is not None and needed > total:
        raise InputError(
            f"grid.voxels: a grid of {size[0]} x {size[1]} x {size[2]} nodes of {n_floats} numbers "
            f"needs {needed / 2**30:.1f} GiB to train, but {where} has {total / 2**30:.1f} GiB; "
            "use fewer voxels, or a model with fewer features."
        )


def _cells(grid: VoxelGrid) -> tuple[int, int, int]:
    """MX, MY, MZ: a cell is two voxels wide, or a little more."""
    x, y, z = (max(1, (n - 1) // 2) for n in grid.size)
    return x, y, z


def _cells_within(
    grid: VoxelGrid, size: tuple[int, int, int], low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """Which cells of a grid in a frustum lie in a box of the scene, with all corners: [*size]."""
    assert grid.frustum is not None
    shares = [np.arange(n + 1) / n for n in size]
    corners = np.stack(np.meshgrid(*shares, indexing="ij"), axis=-1)
    points = grid.frustum.to_scene(grid.box_min + corners * (grid.box_max - grid.box_min))
    inside = ((low <= points) & (points <= high)).all(axis=-1)
    for axis, n in enumerate(size):
        inside = np.take(inside, np.arange(n), axis) & np.take(inside, np.arange(1, n + 1), axis)
    return np.asarray(inside)


@dataclass(frozen=True, kw_only=True, eq=False)
class FreeCells:
    """Which cells of a grid's domain hold nothing visible: distances to the nearest that does."""

    distance: wp.array
    """[MX * MY * MZ] uint8, cells to the nearest occupied one; 0 there."""
    size: tuple[int, int, int]
    """MX, MY, MZ."""
    border: float
    """That of the grid; with a single cell of no matter."""

    @staticmethod
    def none(workers: Workers) -> FreeCells:
        """All space is occupied."""
        return FreeCells(
            distance=wp.zeros(1, dtype=wp.uint8, device=workers.device),
            size=(1, 1, 1),
            border=0.0,
        )

    @staticmethod
    def of(
        grid: VoxelGrid,
        workers: Workers,
        march: Any,
        alpha_min: float,
        sampler: Sampler = STEPS,
    ) -> FreeCells:
        """Look a grid over.

        Args:
            grid: The grid.
            workers: Where to work.
            march: The sampler's parameters: opacity is judged over the longest step there can be.
            alpha_min: The least opacity that counts as visible.
            sampler: Where steps lie.
        """
        device = workers.device
        size = _cells(grid)
        span = 1 if device.is_cuda else size[2]  # a core takes a row

        def launch(kernel: wp.Kernel, n: int, *arguments: Any) -> None:
            workers.launch(kernel, n // span, span, *arguments, at_once=max(1, NODES // span))

        shape = [*grid.size[:2], size[2]]
        highest = wp.empty(math.prod(shape), dtype=real, device=device)
        launch(
            dense_bound.find_highest_kernel(grid.n_floats),
            highest.size,
            grid.struct,
            size[2],
            highest,
        )
        for axis in (1, 0):  # from nodes to cells
            shape[axis] = size[axis]
            joined = wp.empty(math.prod(shape), dtype=real, device=device)
            launch(
                dense_bound.join_highest,
                joined.size,
                grid.size[axis],
                size[axis],
                math.prod(shape[axis + 1 :]),
                highest,
                joined,
            )
            highest = joined
        n, cells = math.prod(size), wp.vec3i(*size)
        distance = wp.empty(n, dtype=wp.uint8, device=device)
        launch(
            occupancy.mark_occupied_kernel(sampler),
            n,
            grid.box,
            grid.density,
            highest,
            cells,
            march,
            CONTRACTIONS[grid.contraction],
            alpha_min,
            distance,
        )
        return FreeCells._around(distance, size, grid.border, workers)

    @staticmethod
    def _around(
        distance: wp.array, size: tuple[int, int, int], border: float, workers: Workers
    ) -> FreeCells:
        """From which cells are occupied, 0 there and the farthest distance elsewhere."""
        span = 1 if workers.device.is_cuda else size[2]  # a core takes a row
        n, spread = math.prod(size), wp.empty_like(distance)
        for axis in range(3):
            workers.launch(
                occupancy.spread_distance,
                n // span,
                *(span, wp.vec3i(*size), axis, distance, spread),
                at_once=max(1, NODES // span),
            )
            distance, spread = spread, distance
        return FreeCells(distance=distance, size=size, border=border)

    def cropped(
        self, grid: VoxelGrid, low: np.ndarray, high: np.ndarray, workers: Workers
    ) -> FreeCells:
        """The same, and free is what does not lie wholly in a box; no array of this one changes.

        Args:
            grid: That these cells belong to.
            low: [3] lower corner, scene units, within the grid's box.
            high: [3] upper corner.
            workers: Where to work.
        """
        size = _cells(grid)
        occupied = self.distance.numpy() == 0
        occupied = np.ones(size, bool) if self.size != size else occupied.reshape(size)
        if grid.frustum is not None:
            occupied = occupied & _cells_within(grid, size, low, high)
        else:
            share = np.stack([low, high] - grid.box_min) / (grid.box_max - grid.box_min)
            # The box's share of the domain, whose border lies around it.
            share = 0.5 + (share - 0.5) / (1.0 + grid.border)
            for axis, n in enumerate(size):
                edges = np.arange(n + 1) / n
                inside = share[0, axis] <= edges[:-1] + 1e-6
                inside &= edges[1:] - 1e-6 <= share[1, axis]
                occupied = occupied & np.expand_dims(inside, [a for a in range(3) if a != axis])
        distance = np.where(occupied, 0, int(occupancy.FAR) + 1).astype(np.uint8)
        there = wp.array(distance.ravel(), dtype=wp.uint8, device=workers.device)
        return FreeCells._around(there, size, grid.border, workers)

    @cached_property
    def struct(self) -> FreeSpace:
        """Free space as kernels take it."""
        return free_struct(types, self.distance, self.size, self.border)

    def share(self) -> float:
        """The share of cells that are occupied, [0, 1]."""
        return float(np.mean(self.distance.numpy() == 0))

    def occupied_range(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Lowest and highest corner of the occupied cells, each [3] as shares of the domain."""
        occupied = np.argwhere(self.distance.numpy().reshape(self.size) == 0)
        if not len(occupied):
            return None
        size = np.array(self.size)
        return occupied.min(0) / size, (occupied.max(0) + 1) / size
