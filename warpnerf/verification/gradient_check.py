"""Gradient checking: the kernels of either precision and form, launched with small problems."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base import precision, tiles
from warpnerf_kernels.base.simd import LANES

from warpnerf.config import Scaling
from warpnerf.fields.gradients import n_tiles
from warpnerf.fields.lattice import box_struct, frustum_struct, grid_struct
from warpnerf.fields.occupancy import free_struct
from warpnerf.fields.storage import density_struct
from warpnerf.model.sampler_kinds import ProposedDensity
from warpnerf.model.spaces import SPACES, part_of
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.proposal import bins_struct, scratch_of, shares_of
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.render import KEPT_PACKS
from warpnerf.rendering.structs import (
    FieldStructs,
    render_outputs_struct,
    render_params_struct,
    scratch_struct,
    train_outputs,
    variant_of,
)
from warpnerf.runtime.parallel import Workers
from warpnerf.verification.problems import (
    DENSITY_SHIFT,
    Found,
    RayProblem,
    RenderOutputs,
    some_intervals,
)

BINS, BIN_UNIT = 32, 0.7
"""Of a ray, and where they begin to widen, scene units."""


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

    def bound(self, problem: RayProblem) -> tuple[np.ndarray, Found]:
        """Proposal loss of rays [n_rays], by how much ``some_intervals`` outweigh the bins of a
        proposal; and the gradient of the sum. Proposed are the densities of the problem's grid.
        """
        densities = replace(problem, raw=problem.raw[..., :1], model=ProposedDensity())
        load, workers, n_rays = self._load, self._workers, problem.n_rays
        propose, rays = load("launch.propose"), self._rays(problem)
        made = propose.proposing(part_of(problem.contraction, self._name), self._packed)
        scene, guide = self._scene(densities, workers), propose.Guide()
        guide.box, guide.free, guide.grid = scene.box, scene.free, scene.field
        guide.density = scene.density
        ends = self._zeros(n_rays, self._types.vec2)
        guide.bins = bins = bins_struct(load, BINS, BIN_UNIT, problem.steps, ends)
        histograms = propose.Histograms()
        for name in propose.Histograms.vars:
            setattr(histograms, name, self._zeros((n_rays, BINS)))
        scratch = scratch_of(made, workers)
        edges, weights = (self._array(array) for array in some_intervals(problem))
        drawn, none = self._zeros(edges.shape), self._zeros((0, 0))
        workers.launch_owned(
            *(made.propose_forward, n_rays, guide, rays, 1.0, scratch, histograms, drawn, none)
        )
        loss, gradient = self._zeros(n_rays), self._no_gradient(densities, workers)
        workers.launch(
            *(made.propose_backward, n_rays, bins, edges, weights, 1.0, histograms, loss)
        )
        items, parts, stride = shares_of(workers, n_rays)
        workers.launch(*(made.add_bins, items, guide, rays, histograms, parts, stride, gradient))
        found = np.zeros(problem.raw.shape)
        found[..., :1] = _found(gradient, densities).values
        return loss.numpy(), Found(arrays={"values": found})

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
            problem.stored,
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
                values=self._stored(problem, workers),
                density=density_struct(self._types, DENSITY_SHIFT, problem.density_scale),
                weights=self._array(problem.weights),
            ),
            problem.steps,
            workers,
            objective=problem.objective,
            stored=problem.stored,
        )

    def _stored(self, problem: RayProblem, workers: Workers) -> Any:
        """The encoding's ``Params``."""
        arrays = {}
        for name, rule in problem.stored.rules.items():
            values = problem.learned[name]
            if rule == "nodes":
                width = values.shape[-1]
                arrays[name] = self._array(values.reshape(-1, width), self._types.vector(width))
            else:
                arrays[name] = self._array(values.ravel())
        return problem.storage(arrays).struct_in(self._load, workers)

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
        """The encoding's ``Gradient``, zero."""
        gradient = problem.stored.encoding(self._load, problem.model).Gradient()
        gradient.weights = self._rows(len(problem.weights), workers)
        for name, array in problem.learned.items():
            if problem.stored.rules.get(name) == "nodes":
                n, width = math.prod(array.shape[:-1]), array.shape[-1]
                setattr(gradient, name, self._zeros(n, self._types.vector(width)))
                gradient.touched = self._zeros(n_tiles(n), wp.uint8)
            else:
                setattr(gradient, name, self._rows(array.size, workers))
        return gradient

    def _rows(self, n: int, workers: Workers) -> wp.array:
        """A row of numbers for each worker, of whole cache lines."""
        return self._zeros((workers.count, -(-n // LANES) * LANES))

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
    arrays = {}
    for name, array in problem.learned.items():
        found = getattr(gradient, name).numpy().astype(np.float64)
        if problem.stored.rules.get(name) == "nodes":
            flags = np.pad(gradient.touched.numpy(), (1, 0)) != 0
            tile = 1 + np.arange(len(found)) // tiles.TILE
            seen = flags[tile] | flags[tile - 1]
            found[found.any(axis=1) & ~seen] = np.nan
        else:  # a row of each worker
            found = found.sum(axis=0)[: array.size]
        arrays[name] = found.reshape(array.shape)
    return Found(arrays=arrays)
