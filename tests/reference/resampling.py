"""Intervals drawn from a histogram along each ray, and the bound on what they weigh."""

from typing import NamedTuple

import torch
from torch import Tensor

from .geometry import grid_coordinates, normalized_coordinates
from .render import attenuate, occupied, softplus, trilinear


class Histogram(NamedTuple):
    """What `histogram` returns; [n_rays, n_bins] each, but for edges."""

    edges: Tensor
    """Of the bins [n_rays, n_bins + 1], scene units; NaN where a ray meets nothing."""
    weights: Tensor
    """T_k alpha_k, 0 where a bin is dropped; differentiable."""


def box_interval(
    origins: Tensor, directions: Tensor, box_min: Tensor, box_max: Tensor, near: float, far: float
) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave a box, between near and far: [n_rays] each."""
    at_faces = torch.stack([(box_min - origins) / directions, (box_max - origins) / directions])
    enter = at_faces.amin(dim=0).amax(dim=1).clamp_min(near)
    leave = at_faces.amax(dim=0).amin(dim=1).clamp_max(far)
    return enter, leave


def bin_edges(begin: Tensor, end: Tensor, unit: float, n_bins: int) -> Tensor:
    """Edges [n_rays, n_bins + 1] of bins that are uniform in s.

    s = (g(t) - g(begin)) / (g(end) - g(begin)),  g(t) = -1 / (unit + t)

    With unit = D and begin = 0 this is t / (D + t) up to a factor, with unit = 0 the disparity.
    """
    g = torch.stack([-1.0 / (unit + begin), -1.0 / (unit + end)], dim=1)
    s = torch.linspace(0.0, 1.0, n_bins + 1, dtype=begin.dtype)
    return -1.0 / torch.lerp(g[:, :1], g[:, 1:], s) - unit


def histogram(
    density: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    box_min: Tensor,
    box_max: Tensor,
    near: float,
    far: float,
    unit: float,
    n_bins: int,
    offset: Tensor,
    norm: str,
    border: float,
    density_shift: float,
    density_scale: float,
    mask: Tensor,
    transmittance_min: float,
) -> Histogram:
    """What bins of rays weigh, through a grid of raw densities [X, Y, Z]."""
    begin, end = torch.full_like(offset, near), torch.full_like(offset, far)
    if norm == "none":
        begin, end = box_interval(origins, directions, box_min, box_max, near, far)
    hits = begin < end
    edges = bin_edges(begin, torch.where(hits, end, begin + 1.0), unit, n_bins)
    dt = edges.diff(dim=1)
    t = edges[:, :-1] + offset[:, None] * dt
    points = origins[:, None] + t[..., None] * directions[:, None]
    u = grid_coordinates(points, box_min, box_max, density.shape, norm, border)
    raw = trilinear(density[..., None], u)[..., 0]
    sigma = density_scale * softplus(raw + density_shift)
    valid = hits[:, None] & occupied(mask, u, density.shape)
    if norm == "none":
        inside = normalized_coordinates(points, box_min, box_max).abs() <= 1.0
        valid = valid & inside.all(dim=-1)
    light = attenuate(sigma, dt, valid, transmittance_min)
    nan = torch.full_like(edges, float("nan"))
    return Histogram(torch.where(hits[:, None], edges, nan), light.weights)


def blur(weights: Tensor, padding: float) -> Tensor:
    """Mip-NeRF's: the mean of the two larger ones of neighbours, and padding over the bins."""
    outer = torch.nn.functional.pad(weights, (1, 1), mode="replicate")
    larger = torch.maximum(outer[:, :-1], outer[:, 1:])
    return 0.5 * (larger[:, :-1] + larger[:, 1:]) + padding / weights.shape[1]


def draw(edges: Tensor, mass: Tensor, unit: float, n: int) -> Tensor:
    """Edges [n_rays, n + 1] of intervals, each of which holds as much of the mass of the bins.

    Within a bin mass is uniform in -1 / (unit + t).
    """
    zero = torch.zeros_like(mass[:, :1])
    reached = torch.cat([zero, mass.cumsum(dim=1)], dim=1) / mass.sum(dim=1, keepdim=True)
    wanted = torch.linspace(0.0, 1.0, n + 1, dtype=mass.dtype).expand(len(mass), -1).contiguous()
    k = (torch.searchsorted(reached.contiguous(), wanted) - 1).clamp(0, mass.shape[1] - 1)
    low, high = reached.gather(1, k), reached.gather(1, k + 1)
    g = -1.0 / (unit + edges)
    share = ((wanted - low) / (high - low)).clamp(0.0, 1.0)
    return -1.0 / torch.lerp(g.gather(1, k), g.gather(1, k + 1), share) - unit


def bound_loss(
    edges: Tensor, weights: Tensor, bin_edges: Tensor, bin_weights: Tensor, epsilon: float
) -> Tensor:
    """Mip-NeRF 360's bound on what intervals weigh, for each ray [n_rays].

    sum_i max(0, w_i - B_i)^2 / (w_i + epsilon),  B_i the sum over the bins that overlap interval i

    Args:
        edges: Of the intervals [n_rays, n + 1]; constants.
        weights: Of the intervals [n_rays, n]; constants.
        bin_edges: Of the bins [n_rays, n_bins + 1].
        bin_weights: [n_rays, n_bins]
        epsilon: Above 0.
    """
    begin, end = edges[:, :-1, None], edges[:, 1:, None]
    overlap = (bin_edges[:, None, :-1] < end) & (bin_edges[:, None, 1:] > begin)
    most = (overlap * bin_weights[:, None]).sum(dim=2)
    above = (weights - most).clamp_min(0.0)
    return (above**2 / (weights + epsilon)).sum(dim=1)
