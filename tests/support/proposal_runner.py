"""The kernels of proposals, driven through rendering problems: the grid's density is proposed."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from tests.reference import resampling
from tests.support.kernel_runner import Kernels, found_gradient
from tests.support.problems import Float64, Problem
from warpnerf.fields.occupancy import free_struct
from warpnerf.model.spaces import part_of

PADDING, EPSILON = 0.01, 1e-7


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """How intervals are drawn."""

    bins: int = 32
    samples: int = 9
    unit: float = 0.7
    anneal: float = 1.0


class Proposing:
    """The kernels, and their arrays for one problem."""

    def __init__(self, kernels: Kernels, p: Problem, drawn: Drawn, threads: int = 1) -> None:
        self.kernels, self.p, self.drawn = kernels, p, drawn
        self.module = kernels.module("launch.propose")
        space = part_of(p.contraction, kernels.precision)
        self.made = self.module.proposing(space, kernels.packed)
        self.guide = guide = self.module.Guide()
        density = replace(p, raw=p.raw[..., :1])
        guide.box, guide.density = kernels.box(p), kernels.density(p)
        guide.grid = kernels.grid(density)
        distance = wp.array(p.free.ravel(), dtype=wp.uint8, device=kernels.device)
        x, y, z = p.free.shape
        guide.free = free_struct(kernels.types, distance, (x, y, z), p.border)
        bins = kernels.module("sampling.resampled").Bins()
        bins.ends = kernels.zeros(p.n_rays, kernels.types.vec2)
        bins.n, bins.unit, bins.near, bins.far = drawn.bins, drawn.unit, p.steps.near, p.steps.far
        bins.transmittance_min = p.steps.transmittance_min
        guide.bins = bins
        self.bins = bins
        self.histograms = self.module.Histograms()
        for name in ("weights", "light", "slopes", "mass"):
            junk = kernels.array(np.full((p.n_rays, drawn.bins), 3.0))
            setattr(self.histograms, name, junk)
        self.edges = kernels.zeros((p.n_rays, drawn.samples + 1))
        self.scratch = self.made.Scratch()
        if kernels.packed:
            dtype = self.made.Scratch.vars["packs"].type.dtype
            self.scratch.packs = wp.empty(kernels.workers.count, dtype=dtype, device="cpu")

    def forward(self) -> tuple[Float64, Float64]:
        """What bins weigh [n_rays, n_bins], and edges of intervals [n_rays, n + 1]."""
        kernels = self.kernels
        weights = kernels.array(np.full((self.p.n_rays, self.drawn.samples), 3.0))
        kernels.workers.launch_owned(
            self.made.propose_forward,
            self.p.n_rays,
            self.guide,
            kernels.rays(self.p),
            self.drawn.anneal,
            self.scratch,
            self.histograms,
            self.edges,
            weights,
        )
        assert not weights.numpy().any()
        return self.histograms.weights.numpy(), self.edges.numpy()

    def backward(
        self, weights: Float64, edges: Float64 | None = None, parts: int = 1
    ) -> tuple[Float64, Float64]:
        """After `forward`: the bound's loss of each ray, and the gradient of their sum."""
        kernels, p = self.kernels, self.p
        loss = kernels.zeros(p.n_rays)
        gradient = kernels.no_gradient(replace(p, raw=p.raw[..., :1]))
        kernels.workers.launch(
            self.made.propose_backward,
            p.n_rays,
            self.bins,
            self.edges if edges is None else kernels.array(edges),
            kernels.array(weights),
            1.0,
            self.histograms,
            loss,
        )
        kernels.workers.launch(
            self.made.add_bins,
            parts,
            *(self.guide, kernels.rays(p), self.histograms, parts, 1, gradient),
        )
        return loss.numpy(), found_gradient(gradient).reshape(p.raw.shape[:3])


def histogram_of(p: Problem, drawn: Drawn, density: torch.Tensor) -> resampling.Histogram:
    """The same in the oracle, of raw densities that may want a gradient."""
    offsets = torch.tensor(p.offsets).expand(p.n_rays)
    return resampling.histogram(
        density,
        torch.tensor(p.origins),
        torch.tensor(p.directions),
        box_min=torch.tensor(p.box_min),
        box_max=torch.tensor(p.box_max),
        near=p.steps.near,
        far=p.steps.far,
        unit=drawn.unit,
        n_bins=drawn.bins,
        offset=offsets,
        norm=p.contraction,
        border=p.border,
        density_shift=p.density_shift,
        density_scale=p.density_scale,
        mask=torch.tensor(p.free == 0),
        transmittance_min=p.steps.transmittance_min,
    )


def edges_of(p: Problem, drawn: Drawn, found: resampling.Histogram) -> Any:
    """Edges of intervals that the oracle draws from it."""
    mass = resampling.blur(found.weights, PADDING) ** drawn.anneal
    return resampling.draw(found.edges, mass, drawn.unit, drawn.samples)
