"""Problems with losses besides the squared error, and the oracle's answer to them."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from tests import reference
from tests.kernels.test_render import early, masked
from tests.support.expected import oracle
from tests.support.model_problems import head_of, problem_of
from tests.support.problems import Float64, Problem
from warpnerf.config import LossConfig
from warpnerf.model.interface import Model
from warpnerf.model.models import PerSample, Rgb
from warpnerf.rendering.losses import Objective

LOSSES = {
    "huber": LossConfig(photometric="huber", huber_delta=0.2),
    "distortion": LossConfig(distortion=0.7),
    "entropy": LossConfig(entropy=0.3),
    "opacity": LossConfig(opacity=0.3),
    "sample_colour": LossConfig(sample_colour=0.4),
    "near_clip": LossConfig(near_clip=0.05, near_clip_distance=0.9),
    "all": LossConfig(
        photometric="huber",
        huber_delta=0.2,
        distortion=0.7,
        entropy=0.3,
        opacity=0.2,
        sample_colour=0.4,
        near_clip=0.05,
        near_clip_distance=0.9,
    ),
}


def problem_with(
    losses: LossConfig, seed: int, model: Model | None = None, n_rays: int = 13
) -> Problem:
    """A random one. Odd seeds have free space, and rays that end early; of the others some rays
    meet next to nothing."""
    p = problem_of(model or Rgb(), seed, n_rays=n_rays)
    p = early(masked(p, seed)) if seed % 2 else replace(p, density_shift=-1.0)
    unit = float(np.random.default_rng(seed).uniform(0.5, 3.0))
    return replace(p, objective=Objective(config=losses, content_distance=unit))


def oracle_minimised(p: Problem, scaling: str = "none") -> tuple[Float64, Float64, Float64]:
    """What Kernels.both_train must return: losses of rays, gradient, and that of the weights."""
    raw, weights = (torch.tensor(a, requires_grad=True) for a in (p.raw, p.weights))
    losses = oracle_losses(p, raw, weights, scaling)
    found = torch.autograd.grad(
        losses.mean(), (raw, weights), allow_unused=True, materialize_grads=True
    )
    return losses.detach().numpy(), found[0].numpy(), found[1].numpy()


def oracle_losses(
    p: Problem, raw: Tensor, weights: Tensor, scaling: str = "none", jacobian: str = "none"
) -> Tensor:
    """The loss of each ray."""
    config, target = p.objective.config, torch.tensor(p.target)
    out = oracle(p, raw, scaling, jacobian, head_of(p.model, weights))
    if config.photometric == "huber":
        total = reference.huber_loss(out.rgb, target, config.huber_delta)
    else:
        total = ((out.rgb - target) ** 2).sum(dim=-1)
    if config.distortion:
        unit = p.objective.content_distance
        total = total + config.distortion * reference.distortion_loss(
            out.weights, out.t, out.dt, unit
        )
    if config.entropy:
        total = total + config.entropy * reference.entropy_loss(out.transmittance)
    if config.opacity:
        total = total + config.opacity * reference.opacity_loss(out.transmittance)
    if config.sample_colour:
        threshold = p.model.threshold if isinstance(p.model, PerSample) else -1.0
        total = total + config.sample_colour * reference.sample_colour_loss(
            out.weights, out.colors, target, threshold
        )
    if config.near_clip:
        assert out.raw_density is not None
        total = total + config.near_clip * reference.near_clip_loss(
            out.raw_density, out.t, out.kept, config.near_clip_distance
        )
    return total
