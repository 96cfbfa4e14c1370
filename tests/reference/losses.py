"""Losses on rays, from their formulas: each [n_rays], differentiable.

Samples that do not count have weight 0; their distances may be anything finite.
"""

import numpy as np
import torch
from torch import Tensor


def distortion_loss(weights: Tensor, t: Tensor, dt: Tensor, unit: float) -> Tensor:
    """sum_ij w_i w_j |s_i - s_j| + 1/3 sum_i w_i^2 h_i, with s = t / (unit + t).

    h_i is the length in s of the interval of length dt_i around t_i, cut off at the camera. Pair by
    pair. Source: Barron et al. 2022, eq. 15.

    Args:
        weights: w [n_rays, n_steps].
        t: Distances [n_rays, n_steps], scene units.
        dt: Lengths of steps [n_steps] or [n_rays, n_steps], scene units.
        unit: Where s is 1/2, scene units.
    """

    def squeezed(distance: Tensor) -> Tensor:
        return distance / (unit + distance)

    s = squeezed(t)
    h = squeezed(t + 0.5 * dt) - squeezed((t - 0.5 * dt).clamp_min(0.0))
    pairs = weights[:, :, None] * weights[:, None, :] * (s[:, :, None] - s[:, None, :]).abs()
    return pairs.sum(dim=(1, 2)) + (weights**2 * h).sum(dim=1) / 3.0


def entropy_loss(transmittance: Tensor) -> Tensor:
    """-(p log p + (1 - p) log(1 - p)), p = T_end [n_rays] clamped to [1e-6, 1 - 1e-6]."""
    p = transmittance.clamp(1e-6, 1.0 - 1e-6)
    return -(p * p.log() + (1.0 - p) * (1.0 - p).log())


def opacity_loss(transmittance: Tensor) -> Tensor:
    """Cross entropy of the opacity o = 1 - T_end [n_rays] against 1; a line where o < 0.01."""
    opacity = 1.0 - transmittance
    line = 1.0 - opacity / 0.01 - np.log(0.01)
    return torch.where(opacity < 0.01, line, -opacity.clamp_min(1e-3).log())


def huber_loss(rgb: Tensor, target: Tensor, delta: float) -> Tensor:
    """Twice torch's Huber loss, summed over channels: d^2 where |d| <= delta.

    Args:
        rgb: Rendered colours [n_rays, 3].
        target: Colours of the photographs [n_rays, 3].
        delta: Where the line begins.
    """
    huber = torch.nn.functional.huber_loss(rgb, target, reduction="none", delta=delta)
    return 2.0 * huber.sum(dim=-1)


def sample_colour_loss(
    weights: Tensor, colors: Tensor, target: Tensor, threshold: float = -1.0
) -> Tensor:
    """sum_i w_i |c_i - target|^2 over samples of more weight than the threshold; w is a constant.

    Args:
        weights: w [n_rays, n_steps].
        colors: c [n_rays, n_steps, 3].
        target: Colours of the photographs [n_rays, 3].
        threshold: Samples of no more weight have no colour.
    """
    weights = torch.where(weights > threshold, weights, torch.zeros_like(weights)).detach()
    return (weights[..., None] * (colors - target[:, None, :]) ** 2).sum(dim=(1, 2))


def near_clip_loss(raw_density: Tensor, t: Tensor, kept: Tensor, distance: float) -> Tensor:
    """sum of raw densities over kept samples with t < distance.

    Args:
        raw_density: Interpolated, before activation [n_rays, n_steps].
        t: Distances [n_rays, n_steps], scene units.
        kept: Which are samples [n_rays, n_steps], bool.
        distance: Scene units.
    """
    near = kept & (t < distance)
    return torch.where(near, raw_density, torch.zeros_like(raw_density)).sum(dim=1)
