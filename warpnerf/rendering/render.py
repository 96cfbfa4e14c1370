"""Volume rendering of rays through a field, and the launch that trains, both passes in one."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import warp as wp
from warpnerf_kernels.base.types import real, vec3
from warpnerf_kernels.launch import assembly

from warpnerf.config import Jacobian, Scaling
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import Storage
from warpnerf.model.interface import Model
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective, loss_struct
from warpnerf.rendering.proposal import Intervals
from warpnerf.rendering.rays import RayBatch, rays_struct
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.structs import (
    AnySteps,
    FieldStructs,
    most_samples,
    render_outputs_struct,
    render_params_struct,
    sampler_of,
    scratch_struct,
    train_outputs,
    variant_of,
)
from warpnerf.runtime.parallel import Workers

KEPT_PACKS = 63
"""Packs of sixteen steps that a CPU worker keeps of a ray between the two passes; later ones are
recomputed."""
KEPT_PACKS_OF_BATCH = 255
"""The same of the rays of a batch together, where the head shades several at a time."""


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

    @staticmethod
    def room(n_rays: int, workers: Workers) -> RenderedRays:
        """For so many, not yet written."""

        def empty(dtype: Any) -> wp.array:
            return wp.empty(n_rays, dtype=dtype, device=workers.device)

        return RenderedRays(
            rgb=empty(vec3), transmittance=empty(real), depth=empty(real), n_samples=empty(wp.int32)
        )

    def write(self, begin: int, some: RenderedRays) -> None:
        """Take what some rays see over, for those from ``begin`` on."""
        for name, array in vars(some).items():
            wp.copy(getattr(self, name), array, dest_offset=begin)


def render_rays(
    model: Model,
    storage: Storage,
    weights: wp.array,
    free: FreeCells,
    steps: AnySteps,
    origins: wp.array,
    directions: wp.array,
    offsets: wp.array,
    background: wp.array,
    workers: Workers,
) -> RenderedRays:
    """Volume rendering: integrate emission and absorption along each ray.

    rgb = sum_k T_k alpha_k c_k + T_end background,  alpha_k = 1 - exp(-sigma_k dt_k)
    Source: Mildenhall et al. 2020, eq. 3. Adjoint: kernels/README.md, "A ray".

    Args:
        model: What the field holds.
        storage: What it is stored in.
        weights: [n_weights] of the model's head.
        free: What of it is skipped.
        steps: How to march, or intervals that a proposal has drawn for these rays.
        origins: [n_rays] vec3, scene units.
        directions: [n_rays] vec3 of unit length.
        offsets: [n_rays] or [1], where in its step a sample sits.
        background: [n_rays] or [1] vec3, rgb in [0, 1].
        workers: Where to work.

    Returns:
        What each ray sees.
    """
    variant = variant_of(
        model,
        "float32",
        storage.lattice.contraction,
        "none",
        "none",
        packed=not workers.device.is_cuda,
        stored=storage.kind,
        sampler=sampler_of(steps),
    )
    n = origins.shape[0]
    rendered = render_outputs_struct(variant, n, workers, assembly)
    scene = render_params_struct(
        model,
        "float32",
        FieldStructs.of(storage, weights, free, steps, workers),
        steps,
        workers,
        stored=storage.kind,
    )
    workers.launch_owned(
        assembly.render_forward_kernel(variant),
        -(-n // variant.batch),
        n,
        scene,
        rays_struct(assembly, origins, directions, offsets, background),
        scratch_struct(variant, 0, workers, assembly),
        rendered,
        rays=variant.batch,
    )
    return RenderedRays(
        rgb=rendered.rgb,
        transmittance=rendered.transmittance,
        depth=rendered.depth,
        n_samples=rendered.n_samples,
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
        storage: Storage,
        weights: wp.array,
        steps: Steps | Intervals,
        scaling: Scaling,
        jacobian: Jacobian,
        workers: Workers,
        objective: Objective = PHOTOMETRIC_ONLY,
    ) -> None:
        """Allocate what a batch needs.

        Args:
            n_rays: Of a batch, at most.
            model: What the field holds, and how that becomes colour.
            storage: What it is stored in; its values are read at each run.
            weights: [n_weights] of the model's head, likewise; none without an MLP.
            steps: Where samples lie; intervals where a proposal draws them before each run.
            scaling: Of each sample's gradient, by its distance.
            jacobian: Whether folding enters the scale.
            workers: Where to work.
            objective: Losses besides the squared error.
        """
        device, lattice = workers.device, storage.lattice
        variant = variant_of(
            model,
            "float32",
            lattice.contraction,
            scaling,
            jacobian,
            packed=not device.is_cuda,
            losses=objective.config,
            stored=storage.kind,
            sampler=sampler_of(steps),
        )
        self.launch = AdjointLaunch(
            assembly.render_train_kernel(variant),
            variant,
            most_samples(model, steps, math.inf if lattice.contracted else lattice.diagonal),
            n_rays,
            workers,
        )
        """How batches are processed."""
        kept = KEPT_PACKS if variant.batch == 1 else KEPT_PACKS_OF_BATCH
        self._scratch = scratch_struct(variant, kept, self.launch.workers, assembly)
        self._scene = render_params_struct(
            model,
            "float32",
            FieldStructs.of(storage, weights, FreeCells.none(workers), steps, workers),
            steps,
            workers,
            objective=objective,
            stored=storage.kind,
        )
        self._model, self._objective = model, objective
        self.n_rays = n_rays
        """Rays of the last run; before the first, those that there is room for."""
        self._outputs = outputs = train_outputs(n_rays, "float32", workers)
        self.rgb: wp.array = outputs.rgb
        """What each of these sees, vec3, then room."""
        self.error: wp.array = outputs.error
        """Squared error of each of these, then room."""
        self.loss: wp.array = outputs.loss
        """What is minimised of each of these, then room."""
        self.n_samples: wp.array = outputs.n_samples
        """Visited steps of each of these, then room."""
        self.gradients = storage.gradients(model, workers)
        """What batches have accumulated since the last update."""

    def minimise(self, objective: Objective) -> None:
        """From now on weigh losses as this one does.

        Args:
            objective: Which has the same losses as the one before.
        """
        if objective != self._objective:
            self._scene.loss = loss_struct(self._model, "float32", objective)
            self._objective = objective

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
            self._outputs,
        )
