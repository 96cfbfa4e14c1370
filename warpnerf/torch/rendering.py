"""Differentiable volume rendering of rays as a torch operation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import torch

from warpnerf.checks import InputError, require_finite, require_one_of
from warpnerf.config import Scaling
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import (
    Head,
    March,
    StoredField,
    head_of,
    require_intervals,
    require_reach,
    require_rising,
    steps_of,
    steps_of_intervals,
)
from warpnerf.rendering.operation import Operation
from warpnerf.rendering.steps import Steps
from warpnerf.torch.arguments import accept_old_spelling
from warpnerf.torch.launches import Constants, Render
from warpnerf.torch.tensors import (
    PRECISIONS,
    corners_in,
    flat_head,
    rays_of,
    require_constant,
    require_dense,
    require_numbers,
    require_tensor,
    stored_by,
)


class RenderedRays(NamedTuple):
    """Rendered rays: colour, opacity and depth."""

    rgb: torch.Tensor
    """[n_rays, 3], with background."""
    opacity: torch.Tensor
    """[n_rays] in [0, 1]."""
    depth: torch.Tensor
    """[n_rays] sum of weight times t, scene units."""


class RenderedIntervals(NamedTuple):
    """Rendered rays, and the weights of their samples."""

    rgb: torch.Tensor
    """[n_rays, 3], with background."""
    opacity: torch.Tensor
    """[n_rays] in [0, 1]."""
    depth: torch.Tensor
    """[n_rays] sum of weight times t, scene units."""
    weights: torch.Tensor
    """[n_rays, n] of samples, which add up to opacity; without gradient."""


@accept_old_spelling
def render_rays(
    raw: torch.Tensor | StoredField,
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
    """Render rays through a field, differentiable with respect to what it stores and the head.

    Samples sit at t = near + (k + 1/2) step for every k >= 0 whose point lies in the box and whose
    t is below far; sigma = softplus(raw density + density_shift), and c as the model says, for rgb
    sigmoid(raw rgb);

        rgb = sum_k T_k alpha_k c_k + T_end background,  alpha_k = 1 - exp(-sigma_k step)

    The gradient is warpnerf's hand-written adjoint (kernels/README.md), in which each sample's
    share is multiplied by its distance scaling. It is then the gradient of no loss: see the paper.
    Only what is stored and the head's layers have gradients: rays, box, background and content
    distance that require grad are refused. A background that is trained is added outside, over a
    black one: rgb + (1 - opacity)[:, None] * background.

    Args:
        raw: [X, Y, Z, 1 + n_features] raw density and raw features, of rgb raw r, g, b, at nodes
            box[0] + index (box[1] - box[0]) / (size - 1); float32 or float64, CPU or CUDA. Or a
            StoredField: planes and lines (vm), or a hash.
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
        InputError: A shape, type, device or number does not fit, or what has no gradient requires
            grad.
    """
    steps = steps_of(step)
    options = Options(density_shift, background, scaling, content_distance, head)
    return RenderedRays(*_rendered(raw, origins, directions, box, options, steps=steps)[:3])


def render_intervals(
    raw: torch.Tensor | StoredField,
    origins: torch.Tensor,
    directions: torch.Tensor,
    box: tuple[Sequence[float] | torch.Tensor, Sequence[float] | torch.Tensor],
    edges: torch.Tensor,
    *,
    density_shift: float = 0.0,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    scaling: Scaling = "none",
    content_distance: float | torch.Tensor = 1.0,
    head: str | Model | Head = "rgb",
) -> RenderedIntervals:
    """Render rays with a sample in the middle of each of their intervals, as importance sampling by
    a proposal network draws them.

    As ``render_rays``, but for t = (edges[k] + edges[k + 1]) / 2, and the difference of the two in
    place of the step. Samples outside the box are skipped. Edges have no gradient: what draws them
    learns from the weights (Mip-NeRF 360, Barron et al. 2022, eq. 13).

    Args:
        raw: See ``render_rays``; so are arguments that are not named here.
        origins: [n_rays, 3] scene units.
        directions: [n_rays, 3] of unit length.
        box: Its lower and its upper corner, [3] each, scene units.
        edges: [n_rays, n + 1] where intervals of each ray begin and end, 0 or above, in rising
            order, scene units; 2 to 1024 intervals.
        density_shift: Added to raw densities before their activation.
        background: [3] or [n_rays, 3], rgb.
        scaling: none, quadratic or clamped.
        content_distance: Where gradients reach full strength, scene units; a number or [n_rays].
        head: The name of a model without an MLP, the model itself, or a Head.

    Returns:
        rgb [n_rays, 3], opacity [n_rays], depth [n_rays] and weights [n_rays, n], of raw's type and
        device.

    Raises:
        InputError: As ``render_rays``.
    """
    options = Options(density_shift, background, scaling, content_distance, head)
    return RenderedIntervals(*_rendered(raw, origins, directions, box, options, edges=edges))


class Options(NamedTuple):
    """What both ways to render take by name."""

    density_shift: float
    background: Sequence[float] | torch.Tensor
    scaling: Scaling
    content_distance: float | torch.Tensor
    head: str | Model | Head


def _rendered(
    raw: torch.Tensor | StoredField,
    origins: torch.Tensor,
    directions: torch.Tensor,
    box: tuple[Sequence[float] | torch.Tensor, Sequence[float] | torch.Tensor],
    options: Options,
    steps: Steps | None = None,
    edges: torch.Tensor | None = None,
) -> tuple[torch.Tensor, ...]:
    """Rgb, opacity, depth and weights of rays, that are marched, or have edges."""
    for field, value in {
        "origins": origins,
        "directions": directions,
        "edges": edges,
        "density_shift": options.density_shift,
        "background": options.background,
        "content_distance": options.content_distance,
    }.items():
        require_constant(field, value)
    require_one_of("scaling", options.scaling, get_args(Scaling))
    require_finite("density_shift", options.density_shift)
    model, layers = head_of(options.head)
    corners = corners_in(box)
    layout, stored = stored_by(raw, model, corners)
    like, precision = stored[0], PRECISIONS[stored[0].dtype]
    weights = flat_head(layers, model, like)
    rays = rays_of("origins", origins, like), rays_of("directions", directions, like)
    n = len(rays[0])
    if n != len(rays[1]):
        raise InputError(
            f"origins and directions must be equally many, not {n} and {len(rays[1])}."
        )
    norms = rays[1].norm(dim=1)
    if n and not bool(((norms - 1.0).abs() < 1e-3).all()):
        raise InputError(
            "directions must be unit vectors, so that t is a distance; divide them by their length."
        )
    if steps is not None:
        middle = like.new_tensor((corners[0] + corners[1]) / 2)
        reach = float((rays[0] - middle).norm(dim=1).max()) if n else 0.0
        require_reach(reach + layout.lattice.diagonal, steps.step, precision)
    intervals = like.new_zeros(n, 0) if steps is not None else _edges(edges, n, like)
    operation = Operation(
        layout=layout,
        precision=precision,
        steps=steps or steps_of_intervals(),
        n_intervals=max(0, intervals.shape[1] - 1),
        density_shift=float(options.density_shift),
        scaling=options.scaling,
    )
    behind, content = _constants(options, n, like)
    constants = Constants(*rays, behind, content, intervals)
    found: tuple[torch.Tensor, ...] = Render.apply(operation, *constants, weights, *stored)
    return found


def _edges(edges: Any, n_rays: int, like: torch.Tensor) -> torch.Tensor:
    """Of intervals, [n_rays, n + 1], as kernels take them."""
    require_tensor("edges", edges, like)
    require_intervals(edges.shape, n_rays)
    given = edges.detach().to(like.dtype).contiguous()
    rising = (given[:, 1:] >= given[:, :-1]).all() and (given[:, 0] >= 0.0).all()
    require_rising(bool(given.isfinite().all()) and bool(rising))
    return given


def _constants(
    options: Options, n_rays: int, like: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Background, [n_rays or 1, 3], and content distances, [n_rays or 1], as kernels take them."""
    background, content_distance = options.background, options.content_distance
    for field, value in (("background", background), ("content_distance", content_distance)):
        require_dense(field, value)
        require_numbers(field, value)
    behind = torch.as_tensor(background, dtype=like.dtype, device=like.device).detach()
    if behind.shape not in ((3,), (n_rays, 3)) or not bool(behind.isfinite().all()):
        raise InputError(
            f"background must be finite rgb, [3] or [n_rays, 3], not {list(behind.shape)}."
        )
    content = torch.as_tensor(content_distance, dtype=like.dtype, device=like.device).detach()
    if content.shape not in ((), (1,), (n_rays,)) or not bool((content > 0).all()):
        raise InputError(
            "content_distance must be above 0: a number or [n_rays], "
            f"not {content.tolist() if content.dim() == 0 else list(content.shape)}."
        )
    return behind.reshape(-1, 3).contiguous(), content.reshape(-1).contiguous()
