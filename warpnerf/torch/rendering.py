"""Differentiable volume rendering of rays as a torch operation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np
import torch

from warpnerf.checks import InputError, require_finite, require_one_of
from warpnerf.config import Scaling
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import (
    Head,
    March,
    head_of,
    require_ascending,
    require_box,
    require_reach,
    steps_of,
)
from warpnerf.torch.arguments import accept_old_spelling
from warpnerf.torch.launches import Call, Render
from warpnerf.torch.tensors import (
    PRECISIONS,
    corner_of,
    flat_head,
    rays_of,
    require_constant,
    require_dense,
    require_grid,
    require_numbers,
)


class RenderedRays(NamedTuple):
    """Rendered rays: colour, opacity and depth."""

    rgb: torch.Tensor
    """[n_rays, 3], with background."""
    opacity: torch.Tensor
    """[n_rays] in [0, 1]."""
    depth: torch.Tensor
    """[n_rays] sum of weight times t, scene units."""


@accept_old_spelling
def render_rays(
    raw: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    box: tuple[Sequence[float] | torch.Tensor, Sequence[float] | torch.Tensor],
    step: float | March,
    *,
    density_shift: float = 0.0,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    scaling: Scaling = "none",
    content_distance: float | torch.Tensor = 1.0,
    head: str | Model | Head = "rgb",
) -> RenderedRays:
    """Render rays through a grid of raw values, differentiable with respect to these and the head.

    Samples sit at t = near + (k + 1/2) step for every k >= 0 whose point lies in the box and whose
    t is below far; sigma = softplus(raw density + density_shift), and c as the model says, for rgb
    sigmoid(raw rgb);

        rgb = sum_k T_k alpha_k c_k + T_end background,  alpha_k = 1 - exp(-sigma_k step)

    The gradient is warpnerf's hand-written adjoint (kernels/README.md), in which each sample's
    share is multiplied by its distance scaling. It is then the gradient of no loss: see the paper.
    Only raw and the head's layers have gradients: rays, box, background and content distance that
    require grad are refused. A background that is trained is added outside, over a black one:
    rgb + (1 - opacity)[:, None] * background.

    Args:
        raw: [X, Y, Z, 1 + n_features] raw density and raw features, of rgb raw r, g, b, at nodes
            box[0] + index (box[1] - box[0]) / (size - 1); float32 or float64, CPU or CUDA.
        origins: [n_rays, 3] scene units, on the same device.
        directions: [n_rays, 3] of unit length.
        box: Its lower and its upper corner, [3] each, scene units.
        step: Length of a step, scene units; or a March, where rays do not begin at their origins.
        density_shift: Added to raw densities before their activation.
        background: [3] or [n_rays, 3], rgb.
        scaling: none, quadratic or clamped.
        content_distance: Where gradients reach full strength, scene units; a number or [n_rays].
        head: The name of a model without an MLP, the model itself, or a Head.

    Returns:
        rgb [n_rays, 3], opacity [n_rays] and depth [n_rays], of raw's type and device.

    Raises:
        InputError: A shape, type, device or number does not fit, or a tensor other than raw and
            layers requires grad.
    """
    require_box(box)
    box_min, box_max = box
    for field, value in {
        "origins": origins,
        "directions": directions,
        "box_min": box_min,
        "box_max": box_max,
        "density_shift": density_shift,
        "background": background,
        "content_distance": content_distance,
    }.items():
        require_constant(field, value)
    require_one_of("scaling", scaling, get_args(Scaling))
    steps = steps_of(step)
    require_finite("density_shift", density_shift)
    model, layers = head_of(head)
    require_grid(raw, model)
    weights = flat_head(layers, model, raw)
    if raw.shape[3] < model.n_floats:
        raw = torch.nn.functional.pad(raw, (0, model.n_floats - raw.shape[3]))
    corners = corner_of("box_min", box_min), corner_of("box_max", box_max)
    require_ascending(corners)
    rays = rays_of("origins", origins, raw), rays_of("directions", directions, raw)
    if len(rays[0]) != len(rays[1]):
        raise InputError(
            f"origins and directions must be equally many, not {len(rays[0])} and {len(rays[1])}."
        )
    norms = rays[1].norm(dim=1)
    if len(norms) and not bool(((norms - 1.0).abs() < 1e-3).all()):
        raise InputError(
            "directions must be unit vectors, so that t is a distance; divide them by their length."
        )
    reach = (
        float((rays[0] - rays[0].new_tensor((corners[0] + corners[1]) / 2)).norm(dim=1).max())
        if len(rays[0])
        else 0.0
    )
    reach += float(np.linalg.norm(corners[1] - corners[0]))
    require_reach(reach, steps.step, PRECISIONS[raw.dtype])
    require_dense("background", background)
    require_dense("content_distance", content_distance)
    require_numbers("background", background)
    require_numbers("content_distance", content_distance)
    behind = torch.as_tensor(background, dtype=raw.dtype, device=raw.device).detach()
    if behind.shape not in ((3,), (len(rays[0]), 3)) or not bool(behind.isfinite().all()):
        raise InputError(
            f"background must be finite rgb, [3] or [n_rays, 3], not {list(behind.shape)}."
        )
    content = torch.as_tensor(content_distance, dtype=raw.dtype, device=raw.device).detach()
    if content.shape not in ((), (1,), (len(rays[0]),)) or not bool((content > 0).all()):
        raise InputError(
            "content_distance must be above 0: a number or [n_rays], "
            f"not {content.tolist() if content.dim() == 0 else list(content.shape)}."
        )
    call = Call(
        corners=corners,
        steps=steps,
        density_shift=density_shift,
        background=behind.reshape(-1, 3).contiguous(),
        scaling=scaling,
        content_distance=content.reshape(-1).contiguous(),
        model=model,
    )
    return RenderedRays(*Render.apply(raw, weights, *rays, call))
