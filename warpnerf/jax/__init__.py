"""JAX operations: the paper's gradient scaling, and rendering through our own adjoint."""

from warpnerf.jax.rendering import RenderedRays, render_rays
from warpnerf.jax.scaling import scale_gradient
from warpnerf.rendering.arguments import Head, March

__all__ = ["Head", "March", "RenderedRays", "render_rays", "scale_gradient"]
