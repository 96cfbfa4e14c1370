"""JAX operations: the paper's gradient scaling, and rendering through our own adjoint."""

from warpnerf.jax.rendering import (
    RenderedIntervals,
    RenderedRays,
    render_intervals,
    render_rays,
)
from warpnerf.jax.scaling import scale_gradient
from warpnerf.rendering.arguments import Head, March, StoredField
from warpnerf.rendering.stored import first_tensors

__all__ = [
    "Head",
    "March",
    "RenderedIntervals",
    "RenderedRays",
    "StoredField",
    "first_tensors",
    "render_intervals",
    "render_rays",
    "scale_gradient",
]
