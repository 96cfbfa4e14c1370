"""Rendering problems in plain numbers, for the kernels and for the oracle."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpnerf.model.interface import Model
from warpnerf.model.models import Rgb
from warpnerf.rendering.losses import PHOTOMETRIC_ONLY, Objective
from warpnerf.rendering.steps import Steps
from warpnerf.scenes.extent.frustum import Frustum

Float64 = NDArray[np.float64]

N_SEEDS = 20


def none_free() -> NDArray[np.uint8]:
    """Free space of one cell that is occupied."""
    return np.zeros((1, 1, 1), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Rays through a grid."""

    raw: Float64  # [X, Y, Z, n_floats]
    box_min: Float64  # [3]
    box_max: Float64  # [3]
    origins: Float64  # [n_rays, 3]
    directions: Float64  # [n_rays, 3] unit
    background: Float64  # [n_rays, 3] or [1, 3]
    target: Float64  # [n_rays, 3]
    adj_rgb: Float64  # [n_rays, 3]
    adj_opacity: Float64  # [n_rays]
    adj_depth: Float64  # [n_rays]
    steps: Steps
    offsets: Float64 = field(default_factory=lambda: np.array([0.5]))  # [n_rays] or [1]
    content_distance: Float64 = field(default_factory=lambda: np.array([1.0]))  # likewise
    contraction: str = "none"
    border: float = 0.0
    frustum: Frustum | None = None  # with ndc: box_min and box_max are in its coordinates
    density_shift: float = 0.3
    density_scale: float = 1.0
    free: NDArray[np.uint8] = field(default_factory=none_free)  # [MX, MY, MZ] distances, cells
    model: Model = field(default_factory=Rgb)
    weights: Float64 = field(default_factory=lambda: np.zeros(0))  # [n_weights]
    objective: Objective = PHOTOMETRIC_ONLY

    @property
    def n_rays(self) -> int:
        return len(self.origins)


def unit(vectors: Float64) -> Float64:
    """Vectors over their length."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def make_problem(
    seed: int, n_rays: int = 12, size: tuple[int, int, int] = (5, 6, 4), **changes: Any
) -> Problem:
    """Random rays, half of them from inside an off-centre box, a random grid and adjoints."""
    rng = np.random.default_rng(seed)
    box_min, box_max = np.array([-1.0, -0.8, -1.1]), np.array([1.2, 0.9, 1.0])
    origins = 2.0 * unit(rng.normal(size=(n_rays, 3)))
    origins[::2] *= 0.2
    aim = 0.5 * rng.normal(size=(n_rays, 3))
    problem = Problem(
        raw=rng.normal(size=(*size, 4)),
        box_min=box_min,
        box_max=box_max,
        origins=origins,
        directions=unit(aim - origins),
        background=rng.uniform(size=(n_rays, 3)),
        target=rng.uniform(size=(n_rays, 3)),
        adj_rgb=rng.normal(size=(n_rays, 3)),
        adj_opacity=rng.normal(size=n_rays),
        adj_depth=rng.normal(size=n_rays),
        steps=Steps(near=0.07, far=2.9, step=0.11),
    )
    return replace(problem, **changes)


def in_frustum(problem: Problem, seed: int = 0) -> Problem:
    """The same rays through a grid in a turned frustum: they go away, come back, and pass by."""
    rng = np.random.default_rng(300 + seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes *= np.sign(np.linalg.det(axes))
    origin = 0.2 * rng.normal(size=3) - 1.4 * axes[2]
    return replace(
        problem,
        contraction="ndc",
        frustum=Frustum(origin=origin, axes=axes, near=0.6, depth=1.3),
        box_min=np.array([-1.1, -0.8, 0.06]),
        box_max=np.array([0.9, 1.0, 1.3 * 0.999]),
        steps=replace(problem.steps, near=0.07, far=40.0, step=0.043, in_ndc=True),
    )


def unbounded(problem: Problem, contraction: str, border: float) -> Problem:
    """The same in a contracted space, with growing steps; or in a frustum."""
    if contraction == "ndc":
        return in_frustum(problem)
    steps = Steps(near=0.07, far=40.0, step=0.11, n_linear=12, growth=0.09)
    return replace(problem, contraction=contraction, border=border, steps=steps)


def unscaled(p: Problem) -> Problem:
    """The same with a content distance that every sample lies beyond: there the clamped scaling is
    1, and no kernel without a scaling has to be compiled."""
    return replace(p, content_distance=np.array([1e-200]))


def in_float32(p: Problem) -> Problem:
    """The same with numbers that float32 holds, so that only arithmetic can differ."""
    if p.frustum is not None:
        origin, axes = (
            v.astype(np.float32).astype(np.float64) for v in (p.frustum.origin, p.frustum.axes)
        )
        p = replace(p, frustum=replace(p.frustum, origin=origin, axes=axes))
    rounded = {
        name: value.astype(np.float32).astype(np.float64)
        for name, value in vars(p).items()
        if isinstance(value, np.ndarray) and value.dtype == np.float64
    }
    return replace(p, **rounded)
