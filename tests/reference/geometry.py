"""Where samples lie: contraction of space, grid coordinates, distances along a ray."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

NORMS = ("none", "linf", "l2")


def _norm(q: Tensor, norm: str) -> Tensor:
    """|q| over the last axis: [..., 3] -> [...]."""
    if norm == "linf":
        return q.abs().amax(dim=-1)
    if norm == "l2":
        return torch.linalg.vector_norm(q, dim=-1)
    raise ValueError(f"norm must be one of {NORMS}, not {norm!r}.")


def contract(q: Tensor, norm: str, border: float) -> Tensor:
    """Contract unbounded space into [-(1 + border), 1 + border]^3.

    f(q) = q for n <= 1, (1 + b - b / n) q / n beyond, with n = |q|

    Args:
        q: Normalised coordinates [..., 3]; the inner box is [-1, 1]^3.
        norm: "none" (identity everywhere), "linf" or "l2".
        border: Width b of the shell that holds everything beyond n = 1.

    Returns:
        Contracted coordinates [..., 3].
    """
    if norm == "none":
        return q
    n = _norm(q, norm)[..., None]  # [..., 1]
    n_outside = n.clamp_min(1.0)  # keeps the branch not taken, and its derivative, finite at q = 0
    return torch.where(n <= 1.0, q, (1.0 + border - border / n_outside) * q / n_outside)


def jacobian_determinant(q: Tensor, norm: str, border: float) -> Tensor:
    """|det df/dq| of `contract`, in closed form (the same for both norms).

    |det| = 1 for n <= 1, b ((1 + b) n - b)^2 / n^6 beyond

    Args:
        q: Normalised coordinates [..., 3].
        norm: "none", "linf" or "l2".
        border: Width b of the shell.

    Returns:
        Determinants [...], > 0.
    """
    if norm == "none":
        return torch.ones_like(q[..., 0])
    n = _norm(q, norm).clamp_min(1.0)
    outside = border * ((1.0 + border) * n - border) ** 2 / n**6
    return torch.where(n <= 1.0, torch.ones_like(n), outside)


def jacobian_determinant_autograd(q: Tensor, norm: str, border: float) -> Tensor:
    """|det df/dq| of `contract`, from its Jacobian by torch.func.jacrev.

    Args:
        q: Normalised coordinates [..., 3].
        norm: "none", "linf" or "l2".
        border: Width b of the shell.

    Returns:
        Determinants [...].
    """

    def contract_point(point: Tensor) -> Tensor:
        return contract(point, norm, border)

    points = q.reshape(-1, 3)
    jacobians = torch.func.vmap(torch.func.jacrev(contract_point))(points)  # [n_points, 3, 3]
    return torch.linalg.det(jacobians).abs().reshape(q.shape[:-1])


def normalized_coordinates(points: Tensor, box_min: Tensor, box_max: Tensor) -> Tensor:
    """q = (p - centre) / half extent, per axis.

    Args:
        points: World points [..., 3], scene units.
        box_min: Lower corner of the inner box [3], scene units.
        box_max: Upper corner of the inner box [3], scene units.

    Returns:
        q [..., 3]; the box is [-1, 1]^3.
    """
    centre = (box_min + box_max) / 2.0
    half_extent = (box_max - box_min) / 2.0
    return (points - centre) / half_extent


def grid_coordinates(
    points: Tensor,
    box_min: Tensor,
    box_max: Tensor,
    shape: Sequence[int],
    norm: str,
    border: float,
) -> Tensor:
    """World points to continuous node indices; node i of an axis sits at u = i.

    u = (p - box_min) / (box_max - box_min) (size - 1)       without contraction
    u = (f(q) / (1 + b) + 1) / 2 (size - 1)                  with contraction

    Args:
        points: World points [..., 3], scene units.
        box_min: Lower corner of the box [3], scene units; of the inner box under contraction.
        box_max: Upper corner of the box [3], scene units; of the inner box under contraction.
        shape: Nodes per axis (X, Y, Z); further entries are ignored.
        norm: "none", "linf" or "l2".
        border: Width b of the shell; unused when norm is "none".

    Returns:
        u [..., 3]; within [0, size - 1] exactly for the points that the grid covers.
    """
    last = torch.tensor([size - 1 for size in shape[:3]], dtype=points.dtype, device=points.device)
    if norm == "none":
        return (points - box_min) / (box_max - box_min) * last
    contracted = contract(normalized_coordinates(points, box_min, box_max), norm, border)
    return (contracted / (1.0 + border) + 1.0) / 2.0 * last


class SampleDistances(NamedTuple):
    """Samples along a ray; `t` has the axes of `offset` in front, [n_steps] for a single one."""

    t: Tensor
    """Distance of each sample [..., n_steps], scene units."""
    dt: Tensor
    """Length each sample stands for [n_steps], scene units."""
    before_far: Tensor
    """t < far [..., n_steps], bool."""


def sample_distances(
    near: float,
    far: float,
    step: float,
    growth: float,
    n_linear: int,
    n_steps: int,
    offset: float | Tensor = 0.5,
    dtype: torch.dtype = torch.float64,
) -> SampleDistances:
    """Distances of the samples: equal steps, and from edge n_linear on geometrically growing ones.

    edge(k) = near + k step                                 for growth = 0, or k <= n_linear
    edge(k) = edge(n_linear) (1 + growth)^(k - n_linear)    beyond
    t_k = edge(k) + offset (edge(k + 1) - edge(k)),  dt_k = edge(k + 1) - edge(k)

    Edges are computed in float64 and rounded once, to dtype.

    Args:
        near: Distance of the first edge, scene units.
        far: Samples at or beyond it are marked as such, scene units; may be infinite.
        step: Step length, scene units.
        growth: Each edge beyond n_linear is (1 + growth) times the one before; 0: steps are equal.
        n_linear: Number of equal steps; unused when growth is 0.
        n_steps: Number of samples.
        offset: Place within the step in [0, 1): 0.5 is the midpoint; [n_rays] for one per ray.
        dtype: Of the result.

    Returns:
        SampleDistances with t [..., n_steps], dt [n_steps] and before_far [..., n_steps].
    """
    k = torch.arange(n_steps + 1, dtype=torch.float64)
    edges = near + k * step
    if growth > 0.0:
        grown = (near + n_linear * step) * (1.0 + growth) ** (k - n_linear).clamp_min(0.0)
        edges = torch.where(k <= n_linear, edges, grown)
    dt = edges[1:] - edges[:-1]
    within = torch.as_tensor(offset, dtype=torch.float64).cpu()[..., None]  # [..., 1]
    t = (edges[:-1] + within * dt).to(dtype)
    return SampleDistances(t, dt.to(dtype), t < far)


class Frustum(NamedTuple):
    """Normalised device coordinates e = (x / w, y / w, depth (1 - near / w)).

    (x, y, w) = axes (p - origin) for a point p of the scene.
    """

    origin: Tensor
    """[3] scene units."""
    axes: Tensor
    """[3, 3] unit vectors in rows."""
    near: float
    """Depth w of the near plane, scene units."""
    depth: float
    """e_z of what is infinitely far."""

    def of_points(self, points: Tensor) -> Tensor:
        """Points [..., 3] in its coordinates [..., 3]."""
        x, y, w = ((points - self.origin) @ self.axes.T).unbind(-1)
        return torch.stack([x / w, y / w, self.depth * (1.0 - self.near / w)], dim=-1)

    def to_points(self, e: Tensor) -> Tensor:
        """The inverse."""
        w = self.near / (1.0 - e[..., 2] / self.depth)
        return torch.stack([e[..., 0] * w, e[..., 1] * w, w], dim=-1) @ self.axes + self.origin

    def samples(
        self,
        origins: Tensor,
        directions: Tensor,
        near: float,
        step: float,
        n_steps: int,
        offset: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Samples at equal distances in its coordinates, from where rays are beyond its near plane.

        Found from two points of each ray and the straight line through them in these coordinates.

        Args:
            origins: [n_rays, 3] scene units.
            directions: [n_rays, 3] unit vectors.
            near: Rays begin no nearer to their origins, scene units.
            step: In its coordinates.
            n_steps: Samples of a ray.
            offset: [n_rays] place within the step.

        Returns:
            e [n_rays, n_steps, 3], and t [n_rays, n_steps] in scene units; not numbers for rays
            never beyond the near plane, and t below 0 or infinite where a line has left space.
        """
        w, slope = (origins - self.origin) @ self.axes[2], directions @ self.axes[2]
        begin = torch.full_like(w, near)
        before = w + near * slope < self.near
        begin = torch.where(before, (self.near - w) / slope, begin)
        begin = torch.where(before & (slope <= 0.0), torch.full_like(w, torch.nan), begin)
        first = self.of_points(origins + begin[:, None] * directions)
        second = self.of_points(origins + (begin + 0.3 * self.near)[:, None] * directions)
        along = second - first
        along = along / torch.linalg.vector_norm(along, dim=-1, keepdim=True)
        k = torch.arange(n_steps, dtype=origins.dtype) + offset[:, None]
        e = first[:, None] + (step * k)[..., None] * along[:, None]
        points = self.to_points(e)
        return e, ((points - origins[:, None]) * directions[:, None]).sum(-1)
