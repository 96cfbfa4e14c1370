"""What the benchmarks render: rays through a voxel grid, and the colours they should see.

Nothing here is measured; measuring.py keeps the time.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import real, vec3, vector

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import allocate_nodes
from warpnerf.model import interface, models
from warpnerf.rendering.rays import RayBatch
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers

BOX = np.ones(3)
"""The box is [-1, 1]^3."""
DENSITY_SHIFT = -1.0
"""Of a grid of standard normal raw values: half of the light crosses the box."""
INSIDE_LENGTH = 1.5
"""What of a ray is sampled where all of it lies in the box, scene units."""
CAMERA_DISTANCE = 1.6
"""Of the cameras of crossing rays from the centre, scene units."""
PATCH = 8
"""Edge of a patch, pixels."""
PIXEL = 0.002
"""Angle from a pixel to the next: an image 400 pixels wide sees 44 degrees."""
SPHERE_RADIUS = 0.6
"""Of the solid sphere, scene units: a ninth of the box."""
SPHERE_DENSITY = 40.0
"""Mean raw density in the sphere: half of the light passes one or two of the usual steps."""
EMPTY_DENSITY = -15.0
"""Raw density around the sphere: no light is lost."""
ALPHA_MIN = 1e-2
"""A cell is free where no step is more opaque; as in training."""

Rays = Literal["inside", "random", "patches"]
Scene = Literal["dense", "sphere"]
ModelName = Literal["rgb", "sh", "deferred", "per_sample", "dvgo"]


@dataclass(frozen=True, kw_only=True)
class Model:
    """What makes colours of features."""

    n_features: int
    """Numbers of a node besides the density."""
    n_values: int
    """Numbers of a node in memory, a power of two: density, features, padding."""
    degree: int = 0
    """Of the spherical harmonics of `sh`."""
    n_inputs: int = 0
    """Of the network; 0 for no network."""
    n_hidden: int = 2
    """Its hidden layers."""
    width: int = 32
    """Of each."""
    n_frequencies: int = 0
    """Of the encoding of directions, 3 + 6 n numbers."""
    threshold: float | None = None
    """A network for each sample gives it a colour where its weight is above this."""
    n_own_colours: int = 0
    """Features of a sample that are colour, to which its network adds: 3 or none."""


MODELS: dict[ModelName, Model] = {
    "rgb": Model(n_features=3, n_values=4),
    "sh": Model(n_features=27, n_values=32, degree=2),
    "deferred": Model(n_features=7, n_values=8, n_inputs=7 + 9, n_frequencies=1),
    "per_sample": Model(
        n_features=12,
        n_values=16,
        n_inputs=9 + 27,
        n_frequencies=4,
        threshold=1e-4,
        n_own_colours=3,
    ),
    "dvgo": Model(
        n_features=12, n_values=16, n_inputs=12 + 27, width=128, n_frequencies=4, threshold=1e-4
    ),
}
"""Those of warpnerf by default, but `deferred` a smaller one, and `per_sample` as DVGO has it."""

DEFAULT_MODELS = tuple(name for name in MODELS if name != "dvgo")
"""Those that are compared by default; against_torch.py is about the other one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Workload:
    """Rays through a grid and what they should see, as arrays that every candidate loads."""

    values: np.ndarray
    """[X, Y, Z, n_values] float32 raw density, raw features (of rgb: raw rgb), zeros."""
    free: np.ndarray
    """[MX, MY, MZ] uint8, over the box: cells from each to the nearest needing samples, diagonal
    neighbours being one apart; 0 there. Nobody has to look: free cells are left out."""
    origins: np.ndarray
    """[n_rays, 3] float32, scene units."""
    directions: np.ndarray
    """[n_rays, 3] float32, unit."""
    target_rgb: np.ndarray
    """[n_rays, 3] float32 in [0, 1]."""
    n_steps: int
    """Steps along each ray, from near = 0 on."""
    step: float
    """Their length, scene units."""
    scaled: bool = True
    """Whether gradients are scaled by distance: min(1, (t / content_distance)^2)."""
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """rgb in [0, 1]."""
    content_distance: float = 1.0
    """Scene units; most rays have samples on both sides of it."""
    box: tuple[np.ndarray, np.ndarray] = (-BOX, BOX)
    """Corners, [3] float64, scene units. Of other boxes than [-1, 1]^3, other densities and rays
    that end early, which trainings have, only warpnerf and `torch_models` know."""
    density_shift: float = DENSITY_SHIFT
    """sigma = density_scale softplus(raw density + density_shift)."""
    density_scale: float = 1.0
    """1 / scene unit."""
    transmittance_min: float = 0.0
    """A ray ends where less light than this would pass."""
    model: ModelName = "rgb"
    network: tuple[np.ndarray, ...] = ()
    """Of models that have one: weights [inputs, outputs] and biases [outputs] float32, in turn."""

    @property
    def skips(self) -> bool:
        """Whether anything is free."""
        return bool(self.free.any())

    def voxel_grid(self, workers: Workers) -> DenseGrid:
        """The grid as warpnerf takes it."""
        grid = voxel_grid(self.values, workers)
        return replace(
            grid,
            lattice=replace(grid.lattice, box_min=self.box[0], box_max=self.box[1]),
            density_shift=self.density_shift,
            density_scale=self.density_scale,
        )

    def warp_model(self) -> interface.Model:
        """The model as warpnerf takes it."""
        if self.model == "dvgo":
            return models.PerSample(width=128, residual=False)
        if self.model == "deferred":
            shape = MODELS[self.model]
            return models.Deferred(specular=shape.n_features - 3, width=shape.width)
        return models.model_of(self.model)

    def weights(self, workers: Workers) -> wp.array:
        """The network as warpnerf takes it: one array, of whose last layer's four columns one is
        padding.
        """
        arrays = list(self.network)
        arrays[-2:] = (
            np.pad(array, [*[(0, 0)] * (array.ndim - 1), (0, 1)]) for array in arrays[-2:]
        )
        flat = np.concatenate([np.zeros(0, np.float32), *(array.ravel() for array in arrays)])
        if len(flat) != interface.n_weights(self.warp_model()):
            raise SystemExit(f"workload: its network is not the one that {self.model} has.")
        return wp.array(flat, dtype=real, device=workers.device)

    def free_cells(self, workers: Workers) -> FreeCells:
        """The free cells as warpnerf takes them."""
        size = self.free.shape
        return FreeCells(
            distance=wp.array(self.free.ravel(), dtype=wp.uint8, device=workers.device),
            size=(size[0], size[1], size[2]),
            border=0.0,
        )

    def steps(self) -> Steps:
        """The steps as warpnerf takes them."""
        return Steps(
            near=0.0,
            far=self.n_steps * self.step,
            step=self.step,
            transmittance_min=self.transmittance_min,
        )

    def batch(self, workers: Workers) -> RayBatch:
        """The rays as warpnerf takes them."""
        return RayBatch(
            origins=wp.array(self.origins, dtype=vec3, device=workers.device),
            directions=wp.array(self.directions, dtype=vec3, device=workers.device),
            offsets=wp.array([0.5], dtype=real, device=workers.device),
            background=wp.array([self.background], dtype=vec3, device=workers.device),
            content_distance=wp.array([self.content_distance], dtype=real, device=workers.device),
            target_rgb=wp.array(self.target_rgb, dtype=vec3, device=workers.device),
        )

    def positions(self) -> tuple[np.ndarray, np.ndarray]:
        """All steps of all rays in scene units, [n_rays, n_steps, 3] float32, and which of them
        need sampling, [n_rays, n_steps].
        """
        t = ((np.arange(self.n_steps) + 0.5) * self.step).astype(np.float32)
        q = self.origins[:, None] + t[:, None] * self.directions[:, None]
        needed = (np.abs(q) <= 1.0).all(axis=2)
        cells = np.array(self.free.shape)
        i, j, k = np.clip(((q + 1.0) * (0.5 * cells)).astype(int), 0, cells - 1).transpose(2, 0, 1)
        return q, needed & (self.free[i, j, k] == 0)


def voxel_grid(values: np.ndarray, workers: Workers) -> DenseGrid:
    """Raw values [X, Y, Z, n_values] over the box as warpnerf takes them."""
    size, n_values = values.shape[:3], values.shape[3]
    nodes = allocate_nodes(math.prod(size), vector(n_values), workers.device)
    nodes.assign(values.reshape(-1, n_values))
    return DenseGrid(
        values=nodes,
        lattice=Lattice(size=(size[0], size[1], size[2]), box_min=-BOX, box_max=BOX),
        density_shift=DENSITY_SHIFT,
    )


def make_workload(
    rays: Rays,
    grid: int,
    n_rays: int,
    n_steps: int,
    *,
    scene: Scene = "dense",
    scaled: bool = True,
    model: ModelName = "rgb",
    seed: int = 0,
) -> Workload:
    """Rays through a grid^3 of raw values.

    Args:
        rays: inside: cameras in the box, all n_steps samples of a ray too. random: single pixels of
            cameras on a sphere around the box that look into it; the steps reach to its far corner.
            patches: the same, each camera with a patch of 8 x 8 neighbouring pixels.
        grid: Nodes along each axis.
        n_rays: Number of rays.
        n_steps: Steps along each.
        scene: dense: standard normal raw values everywhere. sphere: a solid sphere in empty space.
        scaled: Whether gradients are scaled by distance.
        model: What makes colours of features.
        seed: Of all that is random.
    """
    rng = np.random.default_rng(seed)
    reach = INSIDE_LENGTH if rays == "inside" else CAMERA_DISTANCE + math.sqrt(3.0)
    step = reach / n_steps
    group = PATCH * PATCH if rays == "patches" else 1
    many = 2 * -(-n_rays // group) + 64
    if rays == "inside":
        directions = _unit(rng.normal(size=(many, 1, 3)))
        # Uniform among the places from which the whole length fits into the box.
        room = 2.0 - 1e-3 - np.abs(directions) * reach
        first = np.where(directions < 0, 1.0 - 5e-4 - room, -1.0 + 5e-4)
        origins = first + rng.uniform(size=room.shape) * room
    else:
        origins = CAMERA_DISTANCE * _unit(rng.normal(size=(many, 1, 3)))
        directions = _unit(rng.uniform(-0.6, 0.6, size=origins.shape) - origins)
        if rays == "patches":
            directions = _patch(directions, _unit(rng.normal(size=origins.shape)))
        origins = np.broadcast_to(origins, directions.shape)
    # Which side of the box's face a sample lies on must not hang on rounding: candidates round
    # differently, and a sample more or less is no error of any.
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    t = (np.arange(n_steps) + 0.5) * step
    q = origins[:, :, None].astype(float) + t[:, None] * directions[:, :, None]
    clear = (np.abs(np.abs(q) - 1.0) > 1e-5).all(axis=(1, 2, 3))
    chosen = MODELS[model]
    values = np.zeros((grid, grid, grid, chosen.n_values), np.float32)
    used = values[..., : 1 + chosen.n_features]
    used[...] = rng.normal(size=used.shape)
    free = np.zeros((1, 1, 1), np.uint8)
    if scene == "sphere":
        values[..., 0] = np.where(_in_sphere(grid), SPHERE_DENSITY + values[..., 0], EMPTY_DENSITY)
        free = free_distances(np.ascontiguousarray(values[..., :4]), step)
    target_rgb = rng.uniform(size=(n_rays, 3)).astype(np.float32)
    return Workload(
        values=values,
        free=free,
        origins=origins[clear].reshape(-1, 3)[:n_rays],
        directions=directions[clear].reshape(-1, 3)[:n_rays],
        target_rgb=target_rgb,
        n_steps=n_steps,
        step=step,
        scaled=scaled,
        model=model,
        network=_network(chosen, rng),
    )


def _network(model: Model, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Random weights and biases, in turn, that keep numbers at about their size."""
    if not model.n_inputs:
        return ()
    sizes = [model.n_inputs, *[model.width] * model.n_hidden, 3]
    return tuple(
        array.astype(np.float32)
        for a, b in itertools.pairwise(sizes)
        for array in (math.sqrt(2.0 / a) * rng.normal(size=(a, b)), 0.1 * rng.normal(size=b))
    )


def split_network(model: Model, weights: np.ndarray) -> tuple[np.ndarray, ...]:
    """Workload.network from the weights as warpnerf has them; the other way round is
    Workload.weights."""
    if not model.n_inputs:
        return ()
    sizes = [model.n_inputs, *[model.width] * model.n_hidden, 4]
    arrays: list[np.ndarray] = []
    for a, b in itertools.pairwise(sizes):
        arrays += [weights[: a * b].reshape(a, b), weights[a * b : (a + 1) * b]]
        weights = weights[(a + 1) * b :]
    arrays[-2:] = (array[..., :3] for array in arrays[-2:])
    return tuple(np.ascontiguousarray(array) for array in arrays)


def free_distances(values: np.ndarray, step: float) -> np.ndarray:
    """Distances to the nearest cell that needs sampling, as in Workload.free."""
    workers = Workers("cpu", 1)
    march = Steps(near=0.0, far=1e30, step=step).struct()
    free = FreeCells.of(voxel_grid(values, workers), workers, march, ALPHA_MIN)
    return free.distance.numpy().reshape(free.size)


def _patch(centre: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Directions of a patch's pixels around its centre [n, 1, 3]: [n, 64, 3]; roll turns it."""
    right = _unit(np.cross(centre, roll))
    up = np.cross(right, centre)
    at = PIXEL * (np.arange(PATCH) - 0.5 * (PATCH - 1))
    x, y = (a.reshape(1, -1, 1) for a in np.meshgrid(at, at))
    return _unit(centre + x * right + y * up)


def _in_sphere(grid: int) -> np.ndarray:
    """Which nodes of a grid^3 over the box lie in the sphere, [X, Y, Z]."""
    squares = np.linspace(-1.0, 1.0, grid) ** 2
    return squares[:, None, None] + squares[:, None] + squares < SPHERE_RADIUS**2


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)
