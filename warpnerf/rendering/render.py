"""Rendering rays through a grid, and the training launch that does so both ways."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import real
from warpnerf_kernels.launch import assembly
from warpnerf_kernels.sampling import steps as sampling
from warpnerf_kernels.volume import gradscale

from warpnerf.config import Contraction, Jacobian, LossConfig, Scaling
from warpnerf.model.grid import CONTRACTIONS, FreeCells, VoxelGrid
from warpnerf.model.interface import Model, loader
from warpnerf.rendering.adjoint import AdjointLaunch, Gradients
from warpnerf.rendering.losses import PLAIN, Minimised, loss_struct, parts_with
from warpnerf.rendering.rays import RayBatch, rays_struct
from warpnerf.runtime.parallel import Workers

SCALINGS = {
    "none": gradscale.NONE,
    "quadratic": gradscale.QUADRATIC,
    "clamped": gradscale.CLAMPED,
}
JACOBIANS = {
    "none": gradscale.JACOBIAN_NONE,
    "density": gradscale.JACOBIAN_DENSITY,
    "paper": gradscale.JACOBIAN_PAPER,
}

KEPT_PACKS = 63
"""Packs of sixteen steps that a CPU worker keeps of a ray between the two passes; later ones are
made again."""
KEPT_PACKS_OF_BATCH = 255
"""The same of the rays of a batch together, where the head shades several at a time."""


MOST_LINEAR = 2**24
"""Equal steps of a ray: float32 counts no more of them one by one."""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Where along a ray samples may sit: n_linear equal steps from near on, then growing ones."""

    near: float
    """Where the first step begins, scene units."""
    far: float
    """No sample at or beyond it, scene units."""
    step: float
    """Length of the equal steps, scene units."""
    n_linear: int = 0
    """How many there are; with growth only."""
    growth: float = 0.0
    """Each later step is (1 + growth) times the one before; 0: all are equal."""
    transmittance_min: float = 0.0
    """A ray ends where less light than this would pass."""
    in_ndc: bool = False
    """Whether steps are lengths in the coordinates of a grid's frustum, and begin where a ray
    enters it. Near and far are in scene units all the same; the grid's box minds them."""

    def reaching(self, distance: float) -> Steps:
        """With equal steps for a distance at least, scene units, before steps grow.

        So that a camera farther away than those of the training sees the inside of the box in steps
        as short as theirs.
        """
        if self.growth == 0.0:
            return self
        n_linear = min(math.ceil((distance - self.near) / self.step), MOST_LINEAR)
        return replace(self, n_linear=max(self.n_linear, n_linear))

    def most(self, length: float) -> int:
        """How many steps a ray can take, at most.

        Args:
            length: Of its way through the box, in its coordinates; infinite where space is folded.
        """
        if self.in_ndc:
            return int(min(length / self.step, 1e9)) + 4
        linear = self.near + self.n_linear * self.step  # where growing steps begin
        if self.growth == 0.0 or self.far <= linear:
            shortest, in_all = self.step, (self.far - self.near) / self.step
        else:
            shortest = min(self.step, self.growth * linear)
            ratio = float(np.float32(1.0 + self.growth))  # as kernels have it
            in_all = self.n_linear + math.log(self.far / linear) / math.log(ratio)
        # prepare_ray rounds outwards, and adds a step at each end.
        return int(min(in_all, length / shortest, 1e9)) + 4

    def struct(self, sampling: ModuleType = sampling) -> Any:
        """The steps as kernels take them, in the precision of the given ``sampling.steps``."""
        march = sampling.March()
        march.near = 0.0 if self.in_ndc else self.near
        march.far = 1e30 if self.in_ndc else self.far
        march.step = self.step
        march.growth = self.growth
        march.n_linear = self.n_linear
        march.transmittance_min = self.transmittance_min
        return march


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedRays:
    """What rays see, on their device."""

    rgb: wp.array
    """[n_rays] vec3 with background; a deferred head may leave [0, 1]."""
    transmittance: wp.array
    """[n_rays] in [0, 1], light of the background."""
    depth: wp.array
    """[n_rays] sum of weight times t, scene units."""
    n_samples: wp.array
    """[n_rays] visited steps."""


def variant_of(
    model: Model,
    precision: str,
    contraction: Contraction,
    scaling: Scaling,
    jacobian: Jacobian,
    packed: bool,
    losses: LossConfig = PLAIN.config,
) -> Any:
    """What to compile for a model.

    Args:
        model: Which one.
        precision: float32 or float64.
        contraction: Of the grid.
        scaling: Of gradients.
        jacobian: Its term.
        packed: Sixteen samples at a time, where all parts of the model have such a form.
        losses: What a training launch minimises; it is compiled for those of a weight above 0.

    Returns:
        ``warpnerf_kernels.launch.assembly.Variant`` in that precision.
    """
    parts = parts_with(model, precision, losses)
    return loader(precision)("launch.assembly").Variant(
        parts,
        CONTRACTIONS[contraction],
        SCALINGS[scaling],
        JACOBIANS[jacobian],
        packed=packed and parts.have_packs,
    )


def scene_struct(
    model: Model,
    precision: str,
    *,
    box: Any,
    free: Any,
    steps: Steps,
    grid: Any,
    density: Any,
    weights: wp.array,
    workers: Workers,
    minimised: Minimised = PLAIN,
) -> Any:
    """What rays are marched through, as kernels take it.

    Args:
        model: Which one.
        precision: float32 or float64, that of the structs that follow.
        box: A kernel's Box.
        free: A kernel's FreeSpace.
        steps: How to march.
        grid: A kernel's Grid.
        density: A kernel's Density.
        weights: [n_weights] of the head.
        workers: Those that will be launched.
        minimised: By a training launch.

    Returns:
        A kernel's Scene.
    """
    load = loader(precision)
    parts = parts_with(model, precision, minimised.config)
    scene = load("launch.assembly").scene_type(parts)()
    scene.box, scene.free, scene.field, scene.density = box, free, grid, density
    scene.march = march_struct(model, precision, steps, workers)
    scene.loss = loss_struct(model, precision, minimised)
    layout = model.layout(load)
    if layout is not None:
        head = load("heads.mlp").Weights()
        head.values = weights
        head.width = layout.width
        row = -(-layout.n_transposed // 16) * 16  # whole cache lines
        head.transposed = wp.zeros((workers.count, row), dtype=weights.dtype, device=workers.device)
        scene.head = head
    return scene


def march_struct(model: Model, precision: str, steps: Steps, workers: Workers) -> Any:
    """The parameters of a model's sampler, as kernels take them.

    Args:
        model: Which one.
        precision: float32 or float64.
        steps: How to march.
        workers: Those that will be launched.

    Returns:
        A kernel's ``Params`` of the sampler.
    """
    return model.march(loader(precision), steps, workers.device)


def scratch_struct(variant: Any, n_packs: int, workers: Workers, assembly: ModuleType) -> Any:
    """Where the workers of a launch keep rays between the passes.

    Args:
        variant: Of the kernel to launch.
        n_packs: What each worker keeps, if in packs, besides those that it does not keep. Scalar
            kernels, which CUDA runs, keep nothing:
            with all rays under way at once, reading a sample again is the cheaper way.
        workers: Where to work.
        assembly: ``warpnerf_kernels.launch.assembly`` in the variant's precision.

    Returns:
        A kernel's Scratch.
    """
    Scratch = assembly.scratch_type(variant)
    scratch = Scratch()
    if variant.packed:
        fields, n = Scratch.vars, workers.count
        scratch.capacity = capacity = n_packs + variant.parts.head.vectors.n_packs
        scratch.packs = wp.empty(n * capacity, dtype=fields["packs"].type.dtype, device="cpu")
        scratch.rows = wp.empty(n * variant.batch, dtype=fields["rows"].type.dtype, device="cpu")
    return scratch


def seen_struct(variant: Any, n_rays: int, workers: Workers, assembly: ModuleType) -> Any:
    """Room for what the rays of a forward launch see.

    Args:
        variant: Of the kernel to launch.
        n_rays: How many.
        workers: Where to work.
        assembly: ``warpnerf_kernels.launch.assembly`` in the variant's precision.

    Returns:
        A kernel's Seen.
    """
    Seen = assembly.seen_type(variant.parts.head.n_channels)
    seen = Seen()
    for name, variable in Seen.vars.items():
        room = wp.empty(n_rays, dtype=variable.type.dtype, device=workers.device)
        setattr(seen, name, room)
    return seen


def render_rays(
    model: Model,
    grid: VoxelGrid,
    weights: wp.array,
    free: FreeCells,
    steps: Steps,
    origins: wp.array,
    directions: wp.array,
    offsets: wp.array,
    background: wp.array,
    workers: Workers,
) -> RenderedRays:
    """Integrate emission and absorption along each ray.

    rgb = sum_k T_k alpha_k c_k + T_end background,  alpha_k = 1 - exp(-sigma_k dt_k)
    Source: Mildenhall et al. 2020, eq. 3. Adjoint: kernels/README.md, "A ray".

    Args:
        model: What the grid holds.
        grid: Scene.
        weights: [n_weights] of the model's head.
        free: What of it is skipped.
        steps: How to march.
        origins: [n_rays] vec3, scene units.
        directions: [n_rays] vec3 of unit length.
        offsets: [n_rays] or [1], where in its step a sample sits.
        background: [n_rays] or [1] vec3, rgb in [0, 1].
        workers: Where to work.

    Returns:
        What each ray sees.
    """
    variant = variant_of(
        model, "float32", grid.contraction, "none", "none", packed=not workers.device.is_cuda
    )
    n = origins.shape[0]
    seen = seen_struct(variant, n, workers, assembly)
    scene = scene_struct(
        model,
        "float32",
        box=grid.box_between(steps.near, steps.far),
        free=free.struct,
        steps=steps,
        grid=grid.struct,
        density=grid.density,
        weights=weights,
        workers=workers,
    )
    workers.launch_owned(
        assembly.render_forward_kernel(variant),
        -(-n // variant.batch),
        n,
        scene,
        rays_struct(assembly, origins, directions, offsets, background),
        scratch_struct(variant, 0, workers, assembly),
        seen,
        rays=variant.batch,
    )
    return RenderedRays(
        rgb=seen.rgb, transmittance=seen.transmittance, depth=seen.depth, n_samples=seen.n_samples
    )


class TrainingPass:
    """Forward, loss and scaled adjoint of ray batches, into a gradient of its own.

    That is one launch, or as many as AdjointLaunch takes.

    Loss: sum over batches of the mean over a batch's rays of what is minimised.
    """

    def __init__(
        self,
        n_rays: int,
        model: Model,
        grid: VoxelGrid,
        weights: wp.array,
        steps: Steps,
        scaling: Scaling,
        jacobian: Jacobian,
        workers: Workers,
        minimised: Minimised = PLAIN,
    ) -> None:
        """Allocate what a batch needs.

        Args:
            n_rays: Of a batch, at most.
            model: What the grid holds, and how that becomes colour.
            grid: What rays go through; its values are read at each run.
            weights: [n_weights] of the model's head, likewise; none without an MLP.
            steps: Where samples lie.
            scaling: Of each sample's gradient, by its distance.
            jacobian: Whether folding enters the scale.
            workers: Where to work.
            minimised: Losses besides the squared error.
        """
        device = workers.device
        variant = variant_of(
            model,
            "float32",
            grid.contraction,
            scaling,
            jacobian,
            packed=not device.is_cuda,
            losses=minimised.config,
        )
        self.launch = AdjointLaunch(
            assembly.render_train_kernel(variant),
            variant,
            model.most_steps(steps, math.inf if grid.folded else grid.diagonal),
            n_rays,
            workers,
        )
        """How batches are put through."""
        kept = KEPT_PACKS if variant.batch == 1 else KEPT_PACKS_OF_BATCH
        self._scratch = scratch_struct(variant, kept, self.launch.workers, assembly)
        self._scene = scene_struct(
            model,
            "float32",
            box=grid.box_between(steps.near, steps.far),
            free=FreeCells.none(workers).struct,
            steps=steps,
            grid=grid.struct,
            density=grid.density,
            weights=weights,
            workers=workers,
            minimised=minimised,
        )
        self.n_rays = n_rays
        """Rays of the last run; before the first, those that there is room for."""
        self.error = wp.zeros(n_rays, dtype=real, device=device)
        """Squared error of each of these, then room."""
        self.loss = wp.zeros(n_rays, dtype=real, device=device)
        """What is minimised of each of these, then room."""
        self.n_samples = wp.zeros(n_rays, dtype=wp.int32, device=device)
        """Visited steps of each of these, then room."""
        self.gradients = Gradients.zeros(model, math.prod(grid.size), workers)
        """What batches have added up to since the last update."""

    def run(self, free: FreeCells, batch: RayBatch, n_batches: int = 1, share: float = 1.0) -> None:
        """Add the gradient of a batch to ``gradients``, or of several put together.

        Args:
            free: What of the grid is skipped.
            batch: The rays.
            n_batches: How many batches of as many rays each these are.
            share: Of the rays that the mean is taken over; the others, which meet nothing, add
                nothing to the gradient and are not among these.
        """
        self.n_rays = batch.count
        self._scene.free = free.struct
        self.launch.run(
            batch.count,
            self.gradients.struct,
            self._scene,
            batch.struct,
            batch.target_rgb,
            n_batches * share / batch.count,
            self._scratch,
            self.error,
            self.loss,
            self.n_samples,
        )
