"""What a rendered ray is held against, and how that flows back."""

import warp as wp

from ..base.types import real, vec3


@wp.func
def squared_error(rgb: vec3, target_rgb: vec3) -> real:
    """|rgb - target|^2, summed over the three channels."""
    return wp.length_sq(rgb - target_rgb)


@wp.func
def adj_squared_error(rgb: vec3, target_rgb: vec3, adj_error: real) -> vec3:
    """Adjoint of squared_error with respect to rgb."""
    return (real(2.0) * adj_error) * (rgb - target_rgb)
