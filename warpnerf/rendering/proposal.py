"""A proposal on its device: what it is, and drawing rays' intervals from it.

A rendering or a training that resamples proposes first, which fills ``Intervals``, and then walks
through these as through any steps. In training the walk tells what they weigh, and the proposal
learns to bound it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import warp as wp
from warpnerf_kernels.base.types import real, vec2
from warpnerf_kernels.launch import propose

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.parameters import Parameter
from warpnerf.grid_config import Contraction
from warpnerf.model.interface import Load, loader
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.model.spaces import part_of
from warpnerf.model.storage_kinds import DENSE
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import LaunchCache, Workers
from warpnerf.scenes.extent.space import Space, grid_size

PARAMETER = "proposal"
"""What the optimiser and files call its values."""

ALPHA_INIT = 1e-3
"""Opacity of one of its voxels' lengths before training."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal:
    """Where samples of rays should lie: densities on a small grid over the space of a field."""

    kind: Resampled
    """How it is configured."""
    grid: DenseGrid
    """Its raw densities."""
    unit: float
    """Bins of rays have equal widths in 1 / (unit + t); scene units, 0 or above."""

    @staticmethod
    def first(kind: Resampled, space: Space, unit: float, device: wp.Device) -> Proposal:
        """As it is before the first update: alike everywhere.

        Args:
            kind: How it is configured.
            space: Of the field.
            unit: See there.
            device: Where it lies.
        """
        lattice = Lattice.over(space, grid_size(space.extent, kind.voxels))
        grid = DenseGrid.first(DENSE, kind.stored, lattice, 0, device)
        shift = math.log(math.expm1(-math.log1p(-ALPHA_INIT)))
        scale = 1.0 / float(lattice.voxel_size.min())
        grid = replace(grid, density_shift=shift, density_scale=scale)
        return Proposal(kind=kind, grid=grid, unit=unit)

    def copied_to(self, device: wp.Device) -> Proposal:
        """The same with values of its own.

        Args:
            device: Where they lie.
        """
        return replace(self, grid=self.grid.copied_to(device))

    def resized(self, space: Space, workers: Workers) -> Proposal:
        """The same over a space within this one's.

        Args:
            space: The new one.
            workers: Where to work.
        """
        lattice = Lattice.over(space, grid_size(space.extent, self.kind.voxels))
        return replace(self, grid=self.grid.resized(workers, lattice))

    def parameters(self, optim: OptimConfig) -> tuple[Parameter, ...]:
        """What of it is learned.

        Args:
            optim: How the field's parameters are.
        """
        (values,) = self.grid.parameters(self.kind.stored, optim)
        return (replace(values, name=PARAMETER),)

    def gradients(self, workers: Workers) -> Gradients:
        """No gradient yet."""
        return self.grid.gradients(self.kind.stored, workers)


def proposing_kernels(contraction: Contraction, device: wp.Device) -> SimpleNamespace:
    """``launch.propose.proposing`` for a space, in float32.

    Args:
        contraction: The space.
        device: Where they run.
    """
    space = part_of(contraction, "float32")
    return propose.proposing(space, not device.is_cuda and space.vectors is not None)


def bins_struct(load: Load, n: int, unit: float, steps: Steps, ends: wp.array) -> Any:
    """Histogram bins of rays, as kernels take them.

    Args:
        load: The kernels' modules, in the precision of the array.
        n: Of each ray.
        unit: See ``Proposal.unit``.
        steps: Near, far, and where rays end.
        ends: [n_rays] vec2 that is written.
    """
    bins = load("sampling.resampled").Bins()
    bins.ends, bins.n, bins.unit = ends, n, unit
    bins.near, bins.far = steps.near, steps.far
    bins.transmittance_min = steps.transmittance_min
    return bins


def scratch_of(made: SimpleNamespace, workers: Workers) -> Any:
    """Scratch memory of ``launch.propose.proposing``: a pack of bins for each worker, if packed."""
    scratch = made.Scratch()
    if "packs" in made.Scratch.vars:
        dtype = made.Scratch.vars["packs"].type.dtype
        scratch.packs = wp.empty(workers.count, dtype=dtype, device="cpu")
    return scratch


def shares_of(workers: Workers, n_rays: int) -> tuple[int, int, int]:
    """Threads that scatter the gradient of so many rays' bins, parts of the grid, and threads of
    each part. On the CPU each thread adds to a part of its own; on CUDA there is one part, and a
    thread a ray."""
    return (n_rays, 1, n_rays) if workers.device.is_cuda else (workers.count, workers.count, 1)


def unit_of(near: float, content_distance: float) -> float:
    """``Proposal.unit`` for rays from a near plane on.

    From 0 on, bins are equally long near the camera, and far away as wide as their distance asks;
    from a near plane on they are so everywhere.

    Args:
        near: Scene units.
        content_distance: Scene units.
    """
    return content_distance if near == 0.0 else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Intervals:
    """Where samples of the rays of a launch lie; in place of ``Steps``."""

    kind: Resampled
    """How they are drawn."""
    steps: Steps
    """Near, far, and by which cells are free."""
    edges: wp.array
    """[n_rays or more, n + 1] in rising order, scene units."""
    weights: wp.array
    """[n_rays or more, n] what samples in them weigh, which launches write; [0, 0]: nobody asks."""

    @property
    def near(self) -> float:
        """Nothing is sampled nearer, scene units."""
        return self.steps.near

    @property
    def far(self) -> float:
        """Nothing is sampled at or beyond it, scene units."""
        return self.steps.far

    def struct(self, load: Load) -> Any:
        """As kernels take them.

        Args:
            load: The kernels' modules, in the precision of the arrays.
        """
        params = load("sampling.resampled").Intervals()
        params.edges, params.out_weights = self.edges, self.weights
        params.march = self.steps.struct(load("sampling.steps"))
        params.near, params.far = self.steps.near, self.steps.far
        params.transmittance_min = self.steps.transmittance_min
        return params


class Proposer:
    """Draws intervals of rays, of no more than there is room for at a time."""

    def __init__(
        self,
        n_rays: int,
        proposal: Proposal,
        steps: Steps,
        workers: Workers,
        learns: bool = False,
    ) -> None:
        """Allocate what rays need.

        Args:
            n_rays: At a time, at most.
            proposal: Whose values are read at each run.
            steps: Near, far, and by which cells are free.
            workers: Where to work.
            learns: Whether there is a way back.
        """
        kind, lattice, device = proposal.kind, proposal.grid.lattice, workers.device
        self._workers, self._launches = workers, LaunchCache()
        self._kernels = proposing_kernels(lattice.contraction, device)

        def room(*shape: int) -> wp.array:
            return wp.empty(shape, dtype=real, device=device)

        weights = room(n_rays, kind.samples) if learns else room(0, 0)
        self.intervals = Intervals(
            kind=kind, steps=steps, edges=room(n_rays, kind.samples + 1), weights=weights
        )
        """Of the rays of the last run."""
        self.histograms = propose.Histograms()
        """What their bins weigh."""
        for name in ("weights", "light", "slopes", "mass"):
            setattr(self.histograms, name, room(n_rays, kind.bins))
        self.loss = room(n_rays if learns else 0)
        """[n_rays or more] of the bound, of the rays of the last ``learn``."""
        self._guide = guide = propose.Guide()
        guide.box = lattice.box_between(steps.near, steps.far)
        guide.grid, guide.density = proposal.grid.struct, proposal.grid.density
        ends = wp.empty(n_rays, dtype=vec2, device=device)
        bins = bins_struct(loader("float32"), kind.bins, proposal.unit, steps, ends)
        self._bins = guide.bins = bins
        self._scratch = scratch_of(self._kernels, workers)
        self.gradients = proposal.gradients(workers) if learns else None
        """What ``learn`` has accumulated to since the last update; None: there is no way back."""

    def run(
        self, free: FreeCells, rays: Any, anneal: float = 1.0, ends: wp.array | None = None
    ) -> None:
        """Draw intervals of rays.

        Args:
            free: What of the field is skipped; so it is here.
            rays: A kernel's Rays.
            anneal: Power that histograms are raised to, (0, 1].
            ends: [n_rays] vec2, distances that intervals lie between; None: near and far.
        """
        if ends is not None:
            self._guide.between = ends
        self._guide.free = free.struct
        self._workers.launch_owned(
            self._kernels.propose_forward,
            rays.origins.shape[0],
            self._guide,
            rays,
            anneal,
            self._scratch,
            self.histograms,
            self.intervals.edges,
            self.intervals.weights,
            cache=self._launches,
        )

    def learn(self, rays: Any, loss_weight: float) -> None:
        """Add the gradient of the loss of the bound.

        Args:
            rays: Those of the last run, whose samples have been weighed.
            loss_weight: Of one ray.
        """
        assert self.gradients is not None
        n = rays.origins.shape[0]
        self._workers.launch(
            self._kernels.propose_backward,
            n,
            self._bins,
            self.intervals.edges,
            self.intervals.weights,
            loss_weight,
            self.histograms,
            self.loss,
            cache=self._launches,
        )
        items, parts, stride = shares_of(self._workers, n)
        self._workers.launch(
            self._kernels.add_bins,
            items,
            self._guide,
            rays,
            self.histograms,
            parts,
            stride,
            self.gradients.struct,
            cache=self._launches,
        )
