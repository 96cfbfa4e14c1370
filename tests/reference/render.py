"""Rays through a voxel grid: interpolation, the paper's gradient scaling, and integration."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from .geometry import (
    Frustum,
    grid_coordinates,
    jacobian_determinant,
    normalized_coordinates,
    sample_distances,
)
from .heads import Head, RgbHead

SCALINGS = ("none", "quadratic", "clamped")
JACOBIANS = ("none", "density", "paper")
RGB = RgbHead()


class Rendering(NamedTuple):
    """What `integrate` and `render` return; differentiable, except `kept` and `t`."""

    rgb: Tensor
    """Colour [n_rays, 3]: sum_k w_k c_k + T_end background, or what the head makes of it."""
    opacity: Tensor
    """1 - T_end [n_rays]."""
    depth: Tensor
    """sum_k w_k t_k [n_rays], scene units; no background term."""
    transmittance: Tensor
    """T_end [n_rays], light that reaches the background."""
    weights: Tensor
    """w_k = T_k alpha_k [n_rays, n_steps]; 0 for dropped samples."""
    t: Tensor
    """Distance of each candidate [n_rays, n_steps], scene units."""
    kept: Tensor
    """Whether a candidate was integrated [n_rays, n_steps], bool."""
    colors: Tensor
    """What each sample has of what is composited [n_rays, n_steps, C]."""
    dt: Tensor
    """Length of each candidate's step [n_steps] or [n_rays, n_steps], scene units."""
    raw_density: Tensor | None = None
    """Of each candidate, before activation [n_rays, n_steps]; from `render` only."""

    @property
    def n_samples(self) -> Tensor:
        """Samples of each ray that were integrated [n_rays], int64."""
        return self.kept.sum(dim=1)


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)) without the linear shortcut of torch.nn.functional.softplus."""
    return torch.logaddexp(x, torch.zeros_like(x))


def trilinear(grid: Tensor, u: Tensor) -> Tensor:
    """Interpolate between the eight nodes around each point.

    The cell is clamped to [0, size - 2], so that u = size - 1 lies at the end of the last cell;
    u outside the grid extrapolates linearly.

    Args:
        grid: Node values [X, Y, Z, C], at least two nodes per axis.
        u: Continuous node indices [..., 3].

    Returns:
        Values [..., C], differentiable in grid and in u.
    """
    size = grid.shape[:3]
    if min(size) < 2:
        raise ValueError(f"trilinear needs two nodes per axis, got {tuple(size)}.")
    cell = torch.stack([u[..., a].floor().long().clamp(0, size[a] - 2) for a in range(3)], dim=-1)
    fraction = u - cell  # [..., 3] in [0, 1]
    value = torch.zeros((*u.shape[:-1], grid.shape[3]), dtype=grid.dtype, device=grid.device)
    for di in (0, 1):
        for dj in (0, 1):
            for dk in (0, 1):
                weight = torch.ones_like(u[..., 0])
                for axis, corner in enumerate((di, dj, dk)):
                    part = fraction[..., axis]
                    weight = weight * (part if corner == 1 else 1.0 - part)
                node = grid[cell[..., 0] + di, cell[..., 1] + dj, cell[..., 2] + dk]  # [..., C]
                value = value + weight[..., None] * node
    return value


def occupied(mask: Tensor, u: Tensor, shape: Sequence[int]) -> Tensor:
    """Whether each point lies in an occupied cell.

    cell = floor(u / (size - 1) M), clipped to [0, M - 1], for M cells along an axis

    Args:
        mask: Occupancy [MX, MY, MZ], bool; spans the same box as the grid.
        u: Continuous node indices [..., 3].
        shape: Nodes of the grid per axis (X, Y, Z); further entries are ignored.

    Returns:
        Occupancy [...], bool.
    """
    cell = [
        (u[..., a] / (shape[a] - 1) * mask.shape[a]).floor().long().clamp(0, mask.shape[a] - 1)
        for a in range(3)
    ]
    return mask[cell[0], cell[1], cell[2]]


class GradientScaler(torch.autograd.Function):
    """The paper's operation: identity forward, gradients times a per-sample factor backward."""

    @staticmethod
    def forward(ctx: Any, sigma: Tensor, colors: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Pass sigma [...] and colors [..., C] through; keep scale [...] for the way back."""
        ctx.save_for_backward(scale)
        return sigma.view_as(sigma), colors.view_as(colors)

    @staticmethod
    def backward(ctx: Any, grad_sigma: Tensor, grad_colors: Tensor) -> tuple[Tensor, Tensor, None]:
        """Scale both gradients; scale itself is a constant."""
        (scale,) = ctx.saved_tensors
        return grad_sigma * scale, grad_colors * scale[..., None], None


def distance_scale(
    t: Tensor,
    content_distance: float | Tensor,
    scaling: str,
    det_jacobian: Tensor | None = None,
    jacobian: str = "none",
) -> Tensor:
    """Factor on a sample's gradients, from its distance to the camera centre.

    x = (t / D)^2            jacobian "none"
    x = (t / D)^2 |det J|    jacobian "density"
    x = (t / D)^2 / |det J|  jacobian "paper"
    s = 1 for scaling "none", x for "quadratic", min(1, x) for "clamped"
    Source: Philip & Deschaintre 2023; "density" is our correction of their form under contraction.

    Args:
        t: Distances [n_rays, n_steps], scene units.
        content_distance: D > 0, scene units: one for all, or [n_rays].
        scaling: "none", "quadratic" or "clamped".
        det_jacobian: |det J| of the contraction at the samples [n_rays, n_steps]; needed unless
            jacobian is "none".
        jacobian: "none", "density" or "paper".

    Returns:
        Factors [n_rays, n_steps], detached from every parameter.
    """
    if scaling not in SCALINGS:
        raise ValueError(f"scaling must be one of {SCALINGS}, not {scaling!r}.")
    if jacobian not in JACOBIANS:
        raise ValueError(f"jacobian must be one of {JACOBIANS}, not {jacobian!r}.")
    content = torch.as_tensor(content_distance, dtype=t.dtype, device=t.device)
    if not bool((content > 0.0).all()):
        raise ValueError("content_distance must be positive.")
    if scaling == "none":
        return torch.ones_like(t)
    if content.ndim == 1:
        content = content[:, None]  # [n_rays, 1]
    x = (t / content) ** 2
    if jacobian != "none":
        if det_jacobian is None:
            raise ValueError(f"jacobian={jacobian!r} needs det_jacobian.")
        x = x * det_jacobian.abs() if jacobian == "density" else x / det_jacobian.abs()
    return (x.clamp_max(1.0) if scaling == "clamped" else x).detach()


class Light(NamedTuple):
    """What `attenuate` returns; differentiable, except `kept`."""

    weights: Tensor
    """w_k = T_k alpha_k [n_rays, n_steps]; 0 for dropped samples."""
    transmittance: Tensor
    """T_end [n_rays], light that reaches the background."""
    kept: Tensor
    """Whether a candidate counts [n_rays, n_steps], bool."""


def attenuate(
    sigma: Tensor,
    dt: Tensor,
    valid: Tensor | None = None,
    transmittance_min: float = 0.0,
) -> Light:
    """What of each ray's light every sample takes.

    alpha_k = 1 - exp(-sigma_k dt_k),  w_k = T_k alpha_k
    T_1 = 1,  T_{k+1} = T_k exp(-sigma_k dt_k)

    A sample is kept where it is valid and T_k >= transmittance_min, T_k over the samples kept
    before it. Since T never rises, T over all valid samples decides the same: the two agree until
    the first drop, and after it nothing is kept.

    Args:
        sigma: Densities [n_rays, n_steps], 1 / scene unit.
        dt: Step lengths [n_steps] or [n_rays, n_steps], scene units.
        valid: Candidates to consider [n_rays, n_steps], bool; all of them when None.
        transmittance_min: Stop a ray once its transmittance is below this.

    Returns:
        Light of n_rays rays.
    """
    if valid is None:
        valid = torch.ones_like(sigma, dtype=torch.bool)
    zero = torch.zeros_like(sigma)

    def light_before(tau: Tensor) -> Tensor:
        """T before each sample, and at the end: [n_rays, n_steps] -> [n_rays, n_steps + 1]."""
        return torch.exp(-torch.cumsum(torch.cat([zero[:, :1], tau], dim=1), dim=1))

    tau = sigma * torch.where(valid, dt, zero)
    kept = valid & (light_before(tau)[:, :-1] >= transmittance_min)
    tau = torch.where(kept, tau, zero)
    light = light_before(tau)
    alpha = -torch.expm1(-tau)
    return Light(weights=light[:, :-1] * alpha, transmittance=light[:, -1], kept=kept)


def integrate(
    sigma: Tensor,
    colors: Tensor,
    t: Tensor,
    dt: Tensor,
    background: Tensor,
    valid: Tensor | None = None,
    transmittance_min: float = 0.0,
    head: Head = RGB,
    directions: Tensor | None = None,
) -> Rendering:
    """Emission and absorption along each ray, with the weights of `attenuate`.

    rgb = sum_k w_k c_k + T_end background,  opacity = 1 - T_end,  depth = sum_k w_k t_k

    Args:
        sigma: Densities [n_rays, n_steps], 1 / scene unit.
        colors: Colours [n_rays, n_steps, 3], or what else the head composites [.., .., C].
        t: Distances [n_rays, n_steps], scene units.
        dt: Step lengths [n_steps] or [n_rays, n_steps], scene units.
        background: Colour [3] or [n_rays, 3].
        valid: Candidates to consider [n_rays, n_steps], bool; all of them when None.
        transmittance_min: Stop a ray once its transmittance is below this.
        head: Makes colours of rays from what was composited.
        directions: Unit vectors [n_rays, 3], for heads that need them.

    Returns:
        Rendering of n_rays rays.
    """
    weights, transmittance, kept = attenuate(sigma, dt, valid, transmittance_min)
    if directions is None:  # a head that needs them shows it
        directions = torch.full_like(t[:, :1], float("nan")).expand(-1, 3)
    composited = (weights[..., None] * colors).sum(dim=1)
    return Rendering(
        rgb=head.color(composited, transmittance, directions, background),
        opacity=1.0 - transmittance,
        depth=(weights * torch.where(kept, t, torch.zeros_like(t))).sum(dim=1),
        transmittance=transmittance,
        weights=weights,
        t=t,
        kept=kept,
        colors=colors,
        dt=dt,
    )


def render(
    raw: Tensor,
    origins: Tensor,
    directions: Tensor,
    *,
    box_min: Tensor | Sequence[float],
    box_max: Tensor | Sequence[float],
    near: float,
    far: float,
    step: float,
    n_steps: int,
    growth: float = 0.0,
    n_linear: int = 0,
    offset: float | Tensor = 0.5,
    norm: str = "none",
    border: float = 1.0,
    density_shift: float = 0.0,
    density_scale: float = 1.0,
    background: Tensor | Sequence[float] = (0.0, 0.0, 0.0),
    mask: Tensor | None = None,
    transmittance_min: float = 0.0,
    scaling: str = "none",
    content_distance: float | Tensor = 1.0,
    jacobian: str = "none",
    head: Head = RGB,
    frustum: Frustum | None = None,
) -> Rendering:
    """Render rays through a grid of raw values, every candidate sample of every ray at once.

    sigma = density_scale softplus(raw_0 + density_shift),  c = head(raw_1..F)

    Both come after interpolation and before `integrate`. A candidate is valid where it lies in the
    grid (0 <= u <= size - 1; always, under contraction), t < far, and its mask cell is occupied.
    The gradient scaling sits between the activations and the integration, as in the paper: on
    sigma, and on what the head composites of each sample.

    Args:
        raw: Node values [X, Y, Z, M]: raw density, F raw features, and what is not read. Sets dtype
            and device of the result.
        origins: Ray origins [n_rays, 3], scene units.
        directions: Ray directions [n_rays, 3], unit vectors.
        box_min: Lower corner of the (inner) box [3], scene units.
        box_max: Upper corner of the (inner) box [3], scene units.
        near: Distance of the first step's start, scene units.
        far: Samples need t < far, scene units.
        step: Step length, scene units.
        n_steps: Candidates per ray.
        growth: See `sample_distances`.
        n_linear: See `sample_distances`.
        offset: Place within the step, one for all or [n_rays].
        norm: Contraction: "none", "linf" or "l2".
        border: Width of the contracted shell.
        density_shift: Added to the raw density.
        density_scale: Factor on the activated density, 1 / scene unit.
        background: Colour [3] or [n_rays, 3].
        mask: Occupancy [MX, MY, MZ], bool; None for occupied everywhere.
        transmittance_min: Stop a ray once its transmittance is below this.
        scaling: See `distance_scale`.
        content_distance: See `distance_scale`; one for all or [n_rays].
        jacobian: See `distance_scale`; |det J| is 1 without contraction.
        head: Makes colours of features; `RgbHead` has F = 3, c = sigmoid(raw_1..3).
        frustum: In whose coordinates box and step are; steps are equal in them, and begin where a
            ray, from `near` on, is beyond its near plane.

    Returns:
        Rendering of n_rays rays.
    """

    def like_raw(values: Tensor | Sequence[float]) -> Tensor:
        return torch.as_tensor(values, dtype=raw.dtype, device=raw.device)

    origins, directions = like_raw(origins), like_raw(directions)
    corner_min, corner_max = like_raw(box_min), like_raw(box_max)
    shape = raw.shape[:3]

    steps = sample_distances(near, far, step, growth, n_linear, n_steps, offset, raw.dtype)
    t = steps.t.to(raw.device).expand(origins.shape[0], n_steps)
    dt = steps.dt.to(raw.device)
    points = origins[:, None, :] + t[..., None] * directions[:, None, :]  # [n_rays, n_steps, 3]
    valid = steps.before_far.to(raw.device).expand_as(t)
    if frustum is not None:
        places = torch.as_tensor(offset, dtype=raw.dtype).expand(origins.shape[0])
        points, t = frustum.samples(origins, directions, near, step, n_steps, places)
        dt = torch.full_like(t, step)
        valid = t < far
    u = grid_coordinates(points, corner_min, corner_max, shape, norm, border)

    if norm == "none":
        last = like_raw([size - 1 for size in shape])
        valid = valid & ((u >= 0.0) & (u <= last)).all(dim=-1)
    u = torch.where(valid[..., None], u, torch.zeros_like(u))  # nothing extrapolates
    if mask is not None:
        valid = valid & occupied(mask, u, shape)

    values = trilinear(raw[..., : 1 + head.n_features], u)  # [n_rays, n_steps, 1 + F]
    sigma = density_scale * softplus(values[..., 0] + density_shift)
    weights = attenuate(sigma.detach(), dt, valid, transmittance_min).weights
    colors = head.shade(values[..., 1:], directions, weights)  # [n_rays, n_steps, C]

    det = jacobian_determinant(normalized_coordinates(points, corner_min, corner_max), norm, border)
    scale = distance_scale(t, content_distance, scaling, det, jacobian)
    scale = torch.where(valid, scale, torch.zeros_like(scale))  # dropped samples have no gradient
    raw_density, _ = GradientScaler.apply(values[..., 0], colors, scale)
    sigma, colors = GradientScaler.apply(sigma, colors, scale)

    over = like_raw(background)
    out = integrate(sigma, colors, t, dt, over, valid, transmittance_min, head, directions)
    return out._replace(raw_density=raw_density)
