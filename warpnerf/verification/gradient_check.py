"""Gradient checking: small rendering problems in plain numbers, for kernels of either precision."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import precision, tiles

from warpnerf.config import Contraction, LossConfig, Scaling
from warpnerf.fields.gradients import gradient_struct, n_tiles
from warpnerf.fields.lattice import box_struct, frustum_struct, grid_struct
from warpnerf.fields.occupancy import free_struct
from warpnerf.fields.storage import density_struct
from warpnerf.model.interface import Model, n_weights
from warpnerf.model.models import Rgb
from warpnerf.model.spaces import SPACES
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.render import KEPT_PACKS
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.structs import (
    FieldStructs,
    render_outputs_struct,
    render_params_struct,
    scratch_struct,
    train_outputs,
    variant_of,
)
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.extent.frustum import Frustum

DENSITY_SHIFT = 0.3
BOX_MIN, BOX_MAX = np.array([-1.0, -0.8, -1.1]), np.array([1.2, 0.9, 1.0])


@dataclass(frozen=True, kw_only=True, eq=False)
class RayProblem:
    """Rays through a grid, and a loss: the product of what they see with the slopes below."""

    raw: np.ndarray
    """[X, Y, Z, n_floats] raw density, raw features, padding."""
    origins: np.ndarray
    """[n_rays, 3] scene units."""
    directions: np.ndarray
    """[n_rays, 3] unit vectors."""
    background: np.ndarray
    """[n_rays, 3] in [0, 1]."""
    target: np.ndarray
    """[n_rays, 3] in [0, 1], for the training launch, which has its own loss."""
    rgb_slope: np.ndarray
    """[n_rays, 3] dL/drgb."""
    opacity_slope: np.ndarray
    """[n_rays] dL/dopacity."""
    depth_slope: np.ndarray
    """[n_rays] dL/ddepth."""
    steps: Steps
    """How rays are marched."""
    offsets: np.ndarray
    """[n_rays] in [0, 1): where in its step a sample sits."""
    content_distance: np.ndarray
    """[n_rays] scene units."""
    free: np.ndarray = field(default_factory=lambda: np.zeros((1, 1, 1), np.uint8))
    """[MX, MY, MZ] cells to the nearest occupied one."""
    box_min: np.ndarray = field(default_factory=lambda: BOX_MIN)
    """[3] scene units, or coordinates in the frustum."""
    box_max: np.ndarray = field(default_factory=lambda: BOX_MAX)
    """[3] likewise."""
    contraction: Contraction = "none"
    """How space outside the box is contracted, or ndc."""
    border: float = 0.0
    """Width of the shell that holds what is contracted, in half edges of the box."""
    frustum: Frustum | None = None
    """Of normalised device coordinates."""
    density_scale: float = 1.0
    """1 / scene unit."""
    model: Model = field(default_factory=Rgb)
    """What raw values mean."""
    weights: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """[n_weights] of the model's MLP."""
    objective: Objective = PHOTOMETRIC_ONLY
    """What the training launch minimises."""

    @property
    def n_rays(self) -> int:
        """How many rays there are."""
        return len(self.origins)

    def rounded(self) -> RayProblem:
        """The same in numbers that float32 holds, so that only arithmetic can differ."""
        exact = {f.name: getattr(self, f.name) for f in fields(self)}
        exact |= {
            name: value.astype(np.float32).astype(np.float64)
            for name, value in exact.items()
            if isinstance(value, np.ndarray) and value.dtype == np.float64
        }
        if self.frustum is not None:
            exact["frustum"] = replace(
                self.frustum,
                origin=self.frustum.origin.astype(np.float32).astype(np.float64),
                axes=self.frustum.axes.astype(np.float32).astype(np.float64),
                near=float(np.float32(self.frustum.near)),
                depth=float(np.float32(self.frustum.depth)),
            )
        return RayProblem(**exact)


def make_problem(seed: int, n_rays: int = 24, size: tuple[int, int, int] = (7, 8, 6)) -> RayProblem:
    """Random rays, half of them from inside the box, through a random grid."""
    rng = np.random.default_rng(seed)

    def unit(vectors: np.ndarray) -> np.ndarray:
        return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)

    origins = 2.0 * unit(rng.normal(size=(n_rays, 3)))
    origins[::2] *= 0.2
    return RayProblem(
        raw=rng.normal(size=(*size, 4)),
        origins=origins,
        directions=unit(0.5 * rng.normal(size=(n_rays, 3)) - origins),
        background=rng.uniform(size=(n_rays, 3)),
        target=rng.uniform(size=(n_rays, 3)),
        rgb_slope=rng.normal(size=(n_rays, 3)),
        opacity_slope=rng.normal(size=n_rays),
        depth_slope=rng.normal(size=n_rays),
        steps=Steps(near=0.07, far=2.9, step=0.11),
        offsets=rng.uniform(size=n_rays),
        content_distance=rng.uniform(0.5, 3.0, size=n_rays),
    )


def stopping_early(problem: RayProblem) -> RayProblem:
    """The same through a denser medium, with rays that end where little light is left."""
    steps = replace(problem.steps, transmittance_min=0.2)
    return replace(problem, density_scale=2.5, steps=steps)


def partly_free(problem: RayProblem) -> RayProblem:
    """The same where half of 3 x 4 x 5 cells are free."""
    occupied = np.random.default_rng(7).uniform(size=(3, 4, 5)) < 0.5
    return replace(problem, free=np.where(occupied, 0, 1).astype(np.uint8))


def contracted(problem: RayProblem, contraction: Contraction = "linf") -> RayProblem:
    """The same in contracted space, with steps that grow outside the box."""
    steps = replace(problem.steps, far=40.0, n_linear=12, growth=0.09)
    return replace(problem, contraction=contraction, border=0.2, steps=steps)


def in_frustum(problem: RayProblem) -> RayProblem:
    """The same rays through a frustum, turned against the axes: some go away, some come back."""
    rng = np.random.default_rng(5)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    return replace(
        problem,
        contraction="ndc",
        frustum=Frustum(origin=-1.4 * axes[2], axes=axes, near=0.6, depth=1.3),
        box_min=np.array([-1.1, -0.8, 0.06]),
        box_max=np.array([0.9, 1.0, 1.3 * 0.999]),
        steps=replace(problem.steps, far=40.0, step=0.043, in_ndc=True),
    )


def with_losses(problem: RayProblem, sample_colour: float = 0.0) -> RayProblem:
    """The same with losses besides the squared error, in a launch that trains."""
    losses = LossConfig(
        photometric="huber",
        distortion=0.3,
        entropy=0.2,
        opacity=0.1,
        sample_colour=sample_colour,
        near_clip=0.1,
        near_clip_distance=0.6,
    )
    return replace(problem, objective=Objective(config=losses, content_distance=1.3))


def of_model(problem: RayProblem, model: Model) -> RayProblem:
    """The same rays through a random grid and MLP of another model."""
    rng = np.random.default_rng(11)
    return replace(
        problem,
        raw=rng.normal(size=(*problem.raw.shape[:3], model.n_floats)),
        model=model,
        weights=rng.normal(size=n_weights(model)) * 0.4,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class Found:
    """A gradient."""

    values: np.ndarray
    """[X, Y, Z, n_floats] of the raw values."""
    weights: np.ndarray
    """[n_weights] of the MLP's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderOutputs:
    """What the rays of a problem see."""

    rgb: np.ndarray
    """[n_rays, 3] in [0, 1], with background."""
    opacity: np.ndarray
    """[n_rays] in [0, 1]."""
    depth: np.ndarray
    """[n_rays] scene units."""
    n_samples: np.ndarray
    """[n_rays] visited steps."""

    def loss(self, problem: RayProblem) -> float:
        """The problem's loss."""
        return float(
            np.vdot(problem.rgb_slope, self.rgb)
            + np.vdot(problem.opacity_slope, self.opacity)
            + np.vdot(problem.depth_slope, self.depth)
        )


class ProblemKernels:
    """The kernels in one precision and form, on one device."""

    def __init__(self, name: str, workers: Workers, packed: bool = False) -> None:
        """Choose them.

        Args:
            name: float32 or float64.
            workers: Where to work.
            packed: Sixteen samples at a time; in float32 on the CPU.
        """
        self._workers = workers
        self._packed = packed
        self._dtype = np.dtype(name).type
        self._name = name
        self._load = partial(precision.load, name)
        self._types = self._load("base.types")
        self._assembly = self._load("launch.assembly")

    def see(self, problem: RayProblem) -> RenderOutputs:
        """The forward launch."""
        seen = self._forward(problem)
        return RenderOutputs(
            rgb=seen.rgb.numpy(),
            opacity=1.0 - seen.transmittance.numpy(),
            depth=seen.depth.numpy(),
            n_samples=seen.n_samples.numpy(),
        )

    def gradient(self, problem: RayProblem, scaling: Scaling = "none") -> Found:
        """The backward launch: the gradient of the problem's loss."""
        variant = self._variant(problem, scaling)
        launch = self._adjoint(problem, self._assembly.render_backward_kernel(variant), variant)
        gradient = self._no_gradient(problem, launch.workers)
        launch.run(
            problem.n_rays,
            gradient,
            self._scene(problem, launch.workers),
            self._rays(problem),
            self._forward(problem),
            self._array(problem.rgb_slope, self._types.vec3),
            self._array(problem.opacity_slope),
            self._array(problem.depth_slope),
            # nothing is kept between launches
            scratch_struct(variant, 0, launch.workers, self._assembly),
        )
        return _found(gradient, problem)

    def train(self, problem: RayProblem, scaling: Scaling = "none") -> tuple[np.ndarray, Found]:
        """The training launch: losses of rays [n_rays], and the gradient of their mean."""
        outputs = train_outputs(problem.n_rays, self._name, self._workers)
        variant = self._variant(problem, scaling)
        launch = self._adjoint(problem, self._assembly.render_train_kernel(variant), variant)
        gradient = self._no_gradient(problem, launch.workers)
        launch.run(
            problem.n_rays,
            gradient,
            self._scene(problem, launch.workers),
            self._rays(problem),
            self._array(problem.target, self._types.vec3),
            1.0 / problem.n_rays,
            scratch_struct(variant, KEPT_PACKS, launch.workers, self._assembly),
            outputs,
        )
        return outputs.loss.numpy(), _found(gradient, problem)

    def gather(self, values: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Values [X, Y, Z, n] at points [m, 3] in contracted coordinates: [m, n]."""
        n_floats = values.shape[3]
        out = self._zeros(len(points), self._types.vector(n_floats))
        self._workers.launch(
            self._load("launch.probe").probe(self._encoding(n_floats)).read_forward,
            len(points),
            self._grid(values, 0.0),
            self._array(points, self._types.vec3),
            out,
        )
        return out.numpy().astype(np.float64)

    def scatter(self, problem: RayProblem, points: np.ndarray, out: np.ndarray) -> np.ndarray:
        """The transpose of ``gather``, which scatters [m, n] to nodes: [X, Y, Z, n]."""
        workers = self._workers if self._workers.device.is_cuda else Workers("cpu", 1)
        gradient = self._no_gradient(problem, workers)
        n_floats = problem.model.n_floats
        workers.launch(
            self._load("launch.probe").probe(self._encoding(n_floats)).read_backward,
            len(points),
            self._grid(problem.raw, 0.0),
            self._array(points, self._types.vec3),
            self._array(out, self._types.vector(n_floats)),
            gradient,
        )
        return _found(gradient, problem).values

    def _encoding(self, n_floats: int) -> Any:
        return self._load("fields.dense").dense(n_floats)

    def _forward(self, problem: RayProblem) -> Any:
        variant = self._variant(problem, "none")
        seen = render_outputs_struct(variant, problem.n_rays, self._workers, self._assembly)
        self._workers.launch_owned(
            self._assembly.render_forward_kernel(variant),
            -(-problem.n_rays // variant.batch),
            problem.n_rays,
            self._scene(problem, self._workers),
            self._rays(problem),
            scratch_struct(variant, 0, self._workers, self._assembly),
            seen,
        )
        return seen

    def _variant(self, problem: RayProblem, scaling: Scaling) -> Any:
        return variant_of(
            problem.model,
            self._name,
            problem.contraction,
            scaling,
            "none",
            self._packed,
            problem.objective.config,
        )

    def _grid(self, values: np.ndarray, border: float) -> Any:
        x, y, z, n_floats = values.shape
        node = self._types.vector(n_floats)
        array = self._array(values.reshape(-1, n_floats), node)
        return grid_struct(self._load("fields.dense"), array, (x, y, z), border)

    def _scene(self, problem: RayProblem, workers: Workers) -> Any:
        x, y, z = problem.free.shape
        distance = wp.array(problem.free.ravel(), dtype=wp.uint8, device=self._workers.device)
        box = box_struct(self._types, problem.box_min, problem.box_max, problem.border)
        if problem.frustum is not None:
            near, far = problem.steps.near, problem.steps.far
            box.frustum = frustum_struct(self._types, problem.frustum, near, far)
        return render_params_struct(
            problem.model,
            self._name,
            FieldStructs(
                box=box,
                free=free_struct(self._types, distance, (x, y, z), problem.border),
                values=self._grid(problem.raw, problem.border),
                density=density_struct(self._types, DENSITY_SHIFT, problem.density_scale),
                weights=self._array(problem.weights),
            ),
            problem.steps,
            workers,
            objective=problem.objective,
        )

    def _rays(self, problem: RayProblem) -> Any:
        return rays_struct(
            self._assembly,
            self._array(problem.origins, self._types.vec3),
            self._array(problem.directions, self._types.vec3),
            self._array(problem.offsets),
            self._array(problem.background, self._types.vec3),
            self._array(problem.content_distance),
        )

    def _no_gradient(self, problem: RayProblem, workers: Workers) -> Any:
        """A kernel's Gradient of a problem's model, zero."""
        n_nodes = math.prod(problem.raw.shape[:3])
        return gradient_struct(
            self._types,
            self._zeros(n_nodes, self._types.vector(problem.model.n_floats)),
            self._zeros(n_tiles(n_nodes), wp.uint8),
            self._zeros((workers.count, len(problem.weights))),
        )

    def _adjoint(self, problem: RayProblem, kernel: wp.Kernel, variant: Any) -> AdjointLaunch:
        length = float(np.linalg.norm(problem.box_max - problem.box_min))
        return AdjointLaunch(
            kernel,
            variant,
            problem.model.most_steps(
                problem.steps, length if SPACES[problem.contraction].bounded else math.inf
            ),
            problem.n_rays,
            self._workers,
        )

    def _array(self, values: np.ndarray, dtype: Any = None) -> wp.array:
        dtype = dtype or self._types.real
        values = np.ascontiguousarray(values, self._dtype)
        return wp.array(values, dtype=dtype, device=self._workers.device)

    def _zeros(self, shape: int | tuple[int, ...], dtype: Any = None) -> wp.array:
        return wp.zeros(shape, dtype=dtype or self._types.real, device=self._workers.device)


def _found(gradient: Any, problem: RayProblem) -> Found:
    """What was added.

    NaN in tiles that hold gradient and are not flagged: the optimiser would not see them.
    """
    found = gradient.values.numpy().astype(np.float64)
    flags = np.pad(gradient.touched.numpy(), (1, 0)) != 0
    tile = 1 + np.arange(len(found)) // tiles.TILE
    seen = flags[tile] | flags[tile - 1]
    found[found.any(axis=1) & ~seen] = np.nan
    weights = gradient.weights.numpy().astype(np.float64).sum(axis=0)
    return Found(values=found.reshape(problem.raw.shape), weights=weights)
