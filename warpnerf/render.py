"""Rendering rays through a grid, and the training launch that does so both ways."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels import gradscale, tiles, types
from warpnerf_kernels import render as kernels
from warpnerf_kernels.types import real, vec3, vec4

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

KEPT_PACKS = 128
"""Packs of eight steps that a CPU worker keeps of a ray between the two passes; later ones are
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
        grid.struct(),
        free.struct(grid.border),
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradient of a loss with respect to a grid's values, in one row for each worker."""

    rows: wp.array
    """[n_workers, n_nodes] vec4; their sum over the workers is the gradient."""
    touched: wp.array
    """[n_workers, n_tiles] uint8, 0 where neither a tile nor the first node behind it has any."""

    @staticmethod
    def zeros(n_nodes: int, workers: Workers) -> Gradients:
        """No gradient yet."""
        n_tiles = -(-n_nodes // tiles.TILE)
        if workers.device.is_cuda:
            rows = wp.zeros((1, n_nodes), dtype=vec4, device=workers.device)
        else:  # pages of zeros that take no memory until a gradient is added to them
            zeros = np.zeros((workers.count, n_nodes, 4), np.float32)
            rows = wp.array(zeros, dtype=vec4, device=workers.device, copy=False)
        return Gradients(
            rows=rows,
            touched=wp.zeros((workers.count, n_tiles), dtype=wp.uint8, device=workers.device),
        )


class TrainingPass:
    """Forward, loss and scaled adjoint of ray batches in one launch, into gradients of its own.

    Loss: mean over rays of the squared error, summed over the channels.
    """

    def __init__(
        self,
        n_rays: int,
        n_nodes: int,
        scaling: Scaling,
        jacobian: Jacobian,
        contraction: str,
        workers: Workers,
    ) -> None:
        """Allocate what a batch of n_rays into a grid of n_nodes needs, whatever its samples."""
        device = workers.device
        self._workers = workers
        variant = kernels.Variant(
            CONTRACTIONS[contraction],
            SCALINGS[scaling],
            JACOBIANS[jacobian],
            packed=not device.is_cuda,
        )
        self._kernel = kernels.render_train_kernel(variant)
        self._capacity, self._kept = scratch(kernels, variant, KEPT_PACKS, workers)
        self.error = wp.zeros(n_rays, dtype=real, device=device)
        """[n_rays] squared error of the last batch."""
        self.n_samples = wp.zeros(n_rays, dtype=wp.int32, device=device)
        """[n_rays] visited steps of the last batch."""
        self.gradients = Gradients.zeros(n_nodes, workers)
        """What batches have added up to since the last optimiser step."""

    def run(self, grid: VoxelGrid, free: FreeCells, steps: Steps, batch: RayBatch) -> None:
        """Add a batch's gradient to ``gradients``."""
        self._workers.launch_owned(
            self._kernel,
            batch.count,
            grid.struct(),
            free.struct(grid.border),
            steps.struct(),
            batch.origins,
            batch.directions,
            batch.offsets,
            batch.background,
            batch.content_distance,
            batch.target_rgb,
            1.0 / batch.count,
            self._capacity,
            self._kept,
            self.error,
            self.n_samples,
            self.gradients.rows,
            self.gradients.touched,
        )
