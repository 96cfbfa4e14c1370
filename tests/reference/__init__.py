"""The oracle: a dense, plain torch account of what the kernels must compute.

It shares no code with the package or its kernels, and prefers the textbook form to the fast one.
Everything works for any floating dtype; float64 is what it is meant for.

    geometry  contraction and its Jacobian, grid coordinates, distances along a ray
    render    trilinear interpolation, the paper's gradient scaling, integration along rays
    training  photometric loss, total variation, one Adam step
    cameras   rays of a pinhole camera with lens distortion (numpy)
    numeric   directional derivatives by differences, relative error
"""

from .cameras import distort, pinhole_rays, undistort
from .geometry import (
    SampleDistances,
    contract,
    grid_coordinates,
    jacobian_determinant,
    jacobian_determinant_autograd,
    normalized_coordinates,
    sample_distances,
)
from .numeric import central_difference, relative_error
from .render import (
    GradientScaler,
    Rendering,
    distance_scale,
    integrate,
    occupied,
    render,
    softplus,
    trilinear,
)
from .training import adam, photometric_loss, total_variation

__all__ = [
    "GradientScaler",
    "Rendering",
    "SampleDistances",
    "adam",
    "central_difference",
    "contract",
    "distance_scale",
    "distort",
    "grid_coordinates",
    "integrate",
    "jacobian_determinant",
    "jacobian_determinant_autograd",
    "normalized_coordinates",
    "occupied",
    "photometric_loss",
    "pinhole_rays",
    "relative_error",
    "render",
    "sample_distances",
    "softplus",
    "total_variation",
    "trilinear",
    "undistort",
]
