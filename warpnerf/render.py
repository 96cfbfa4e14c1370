"""Rendering rays through a grid, and the training launch that does so both ways."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import warp as wp
from warpnerf_kernels import gradscale, types
from warpnerf_kernels import render as kernels
from warpnerf_kernels.types import real, vec3

from warpnerf.adjoint import AdjointLaunch, Gradients
from warpnerf.config import Jacobian, Scaling
from warpnerf.grid import CONTRACTIONS, FreeCells, VoxelGrid
from warpnerf.parallel import Workers
from warpnerf.rays import RayBatch

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

KEPT_PACKS = 64
"""Packs of sixteen steps that a CPU worker keeps of a ray between the two passes; later ones are
made again."""


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

    def most(self, length: float) -> int:
        """How many steps a ray can take, at most.

        Args:
            length: Of its way through the box, scene units; infinite where space is folded.
        """
        linear = self.near + self.n_linear * self.step  # where growing steps begin
        if self.growth == 0.0 or self.far <= linear:
            shortest, in_all = self.step, (self.far - self.near) / self.step
        else:
            shortest = min(self.step, self.growth * linear)
            in_all = self.n_linear + math.log(self.far / linear) / math.log1p(self.growth)
        # prepare_ray rounds outwards, and adds a step at each end.
        return int(min(in_all, length / shortest, 1e9)) + 4

    def struct(self, types: ModuleType = types) -> Any:
        """The steps as kernels take them, in the precision of the given types."""
        march = types.March()
        march.near = self.near
        march.far = self.far
        march.step = self.step
        march.growth = self.growth
        march.n_linear = self.n_linear
        march.transmittance_min = self.transmittance_min
        return march


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderedRays:
    """What rays see, on their device."""

    rgb: wp.array
    """[n_rays] vec3 in [0, 1], with background."""
    transmittance: wp.array
    """[n_rays] in [0, 1], light of the background."""
    depth: wp.array
    """[n_rays] sum of weight times t, scene units."""
    n_samples: wp.array
    """[n_rays] visited steps."""


def render_rays(
    grid: VoxelGrid,
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
        grid: Scene.
        free: What of it is skipped.
        steps: How to march.
        origins: [n_rays] vec3, scene units.
        directions: [n_rays] vec3 of unit length.
        offsets: [n_rays] or [1], where in its step a sample sits.
        background: [n_rays] or [1] vec3, rgb in [0, 1].
        workers: Where to work.
    """
    n = origins.shape[0]
    out = RenderedRays(
        rgb=wp.empty(n, dtype=vec3, device=workers.device),
        transmittance=wp.empty(n, dtype=real, device=workers.device),
        depth=wp.empty(n, dtype=real, device=workers.device),
        n_samples=wp.empty(n, dtype=wp.int32, device=workers.device),
    )
    variant = kernels.Variant(
        CONTRACTIONS[grid.contraction],
        gradscale.NONE,
        gradscale.JACOBIAN_NONE,
        packed=not workers.device.is_cuda,
    )
    capacity, kept = scratch(kernels, variant, 1, workers)
    workers.launch_owned(
        kernels.render_forward_kernel(variant),
        n,
        grid.struct,
        free.struct,
        steps.struct(),
        origins,
        directions,
        offsets,
        background,
        capacity,
        kept,
        out.rgb,
        out.transmittance,
        out.depth,
        out.n_samples,
    )
    return out


def scratch(
    kernels: ModuleType, variant: kernels.Variant, n_packs: int, workers: Workers
) -> tuple[int, wp.array]:
    """Where the workers of a launch keep a ray's samples.

    Args:
        kernels: ``warpnerf_kernels.render`` in some precision.
        variant: Of the kernel to launch.
        n_packs: What each worker keeps, if in packs. Plain kernels, which CUDA runs, keep nothing:
            with all rays under way at once, reading a sample again is the cheaper way.
        workers: Where to work.

    Returns:
        The kernel's arguments `capacity` and `kept`.
    """
    capacity = n_packs if variant.packed else 0
    kept = wp.empty(
        workers.count * capacity, dtype=kernels.kept_type(variant), device=workers.device
    )
    return capacity, kept


class TrainingPass:
    """Forward, loss and scaled adjoint of ray batches, into a gradient of its own.

    That is one launch, or as many as AdjointLaunch takes.

    Loss: sum over batches of the mean over a batch's rays of the squared error, summed over the
    channels.
    """

    def __init__(
        self,
        n_rays: int,
        grid: VoxelGrid,
        steps: Steps,
        scaling: Scaling,
        jacobian: Jacobian,
        workers: Workers,
    ) -> None:
        """Allocate what up to n_rays at a time through a grid need, by such steps."""
        device = workers.device
        variant = kernels.Variant(
            CONTRACTIONS[grid.contraction],
            SCALINGS[scaling],
            JACOBIANS[jacobian],
            packed=not device.is_cuda,
        )
        self.launch = AdjointLaunch(
            kernels.render_train_kernel(variant),
            variant,
            steps.most(math.inf if grid.contraction != "none" else grid.diagonal),
            n_rays,
            workers,
        )
        """How batches are put through."""
        self._capacity, self._kept = scratch(kernels, variant, KEPT_PACKS, workers)
        self._grid = grid.struct
        self._steps = steps.struct()
        self.n_rays = n_rays
        """Rays of the last run; before the first, those that there is room for."""
        self.error = wp.zeros(n_rays, dtype=real, device=device)
        """Squared error of each of these, then room."""
        self.n_samples = wp.zeros(n_rays, dtype=wp.int32, device=device)
        """Visited steps of each of these, then room."""
        self.gradients = Gradients.zeros(grid.size, workers)
        """What batches have added up to since the last update."""

    def run(self, free: FreeCells, batch: RayBatch, n_batches: int = 1) -> None:
        """Add the gradient of a batch to ``gradients``, or of several put together.

        Args:
            free: What of the grid is skipped.
            batch: The rays.
            n_batches: How many batches of as many rays each these are.
        """
        self.n_rays = batch.count
        self.launch.run(
            batch.count,
            self.gradients.struct,
            self._grid,
            free.struct,
            self._steps,
            batch.origins,
            batch.directions,
            batch.offsets,
            batch.background,
            batch.content_distance,
            batch.target_rgb,
            n_batches / batch.count,
            self._capacity,
            self._kept,
            self.error,
            self.n_samples,
        )
