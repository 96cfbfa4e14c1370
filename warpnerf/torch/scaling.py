"""The paper's gradient scaling as a torch operation."""

from __future__ import annotations

from typing import Any, get_args

import torch

from warpnerf.checks import InputError, require_one_of, require_positive
from warpnerf.config import Scaling
from warpnerf.rendering.arguments import require_broadcasts, require_samples
from warpnerf.torch.tensors import require_constant, require_dense, require_tensor


def scale_gradient(
    colors: torch.Tensor,
    sigmas: torch.Tensor,
    distances: torch.Tensor,
    content_distance: float | torch.Tensor = 1.0,
    scaling: Scaling = "clamped",
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scale the gradients of samples by their distance; call it just before integrating them.

    Identity forward. Backward, with s = 1 (none), (t / D)^2 (quadratic) or min(1, (t / D)^2)
    (clamped): dL/dcolor <- s dL/dcolor, dL/dsigma <- s dL/dsigma. What reaches t passes as it is,
    and s itself is a constant.
    Source: Philip & Deschaintre 2023, "Floaters No More", eq. 7.

    Args:
        colors: [..., C] of samples, any floating type.
        sigmas: [...] or [..., 1] densities of the same samples.
        distances: t, of the shape of sigmas, scene units from the camera centre.
        content_distance: D, scene units; a number, or a tensor that broadcasts over distances.
        scaling: none, quadratic or clamped.

    Returns:
        colors, sigmas and distances, unchanged.

    Raises:
        InputError: Tensors are not dense floating point on one device, shapes do not fit, or
            content_distance is not above zero, or requires grad: D has none.
    """
    require_constant("content_distance", content_distance)
    require_one_of("scaling", scaling, get_args(Scaling))
    for field, value in (("colors", colors), ("sigmas", sigmas), ("distances", distances)):
        require_tensor(field, value, colors)
    require_samples(colors.shape, sigmas.shape, distances.shape)
    if isinstance(content_distance, torch.Tensor):
        require_dense("content_distance", content_distance)
        content_distance = content_distance.to(distances.device)
        require_broadcasts(content_distance.shape, distances.shape)
        if not bool((content_distance > 0).all()):
            raise InputError("content_distance must be above 0 everywhere.")
    else:
        require_positive("content_distance", content_distance)
        content_distance = float(content_distance)
    if scaling == "none":
        return colors, sigmas, distances
    ratio = distances.detach() / content_distance
    scale = ratio * ratio
    if scaling == "clamped":
        scale = scale.clamp(max=1.0)
    of_color = scale if colors.dim() == distances.dim() else scale.unsqueeze(-1)
    return _Scaled.apply(colors, of_color), _Scaled.apply(sigmas, scale), distances


class _Scaled(torch.autograd.Function):
    """x, whose gradient is multiplied by scale."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(scale)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        (scale,) = ctx.saved_tensors
        return grad * scale.to(grad.dtype), None
