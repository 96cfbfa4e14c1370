"""The oracle: a dense, plain torch account of what the kernels must compute.

It shares no code with the package or its kernels, and prefers the textbook form to the fast one.
Everything works for any floating dtype; float64 is what it is meant for.

    geometry  contraction and its Jacobian, grid coordinates, distances along a ray, frusta
    render    trilinear interpolation, the paper's gradient scaling, integration along rays
    heads     the models: view encoding, spherical harmonics, networks, what they make of features
    training  photometric loss, total variation, one Adam step
    cameras   rays of a pinhole camera with lens distortion, and of a fisheye (numpy)
    numeric   directional derivatives by differences, relative error
"""

from .cameras import distort, fisheye_rays, pinhole_rays, undistort
from .geometry import (
    Frustum,
    SampleDistances,
    contract,
    grid_coordinates,
    jacobian_determinant,
    jacobian_determinant_autograd,
    normalized_coordinates,
    sample_distances,
)
from .heads import (
    DeferredHead,
    FeaturesHead,
    Head,
    Network,
    RgbHead,
    ShHead,
    mlp,
    random_network,
    spherical_harmonics,
    view_encoding,
)
from .losses import (
    distortion_loss,
    entropy_loss,
    huber_loss,
    near_clip_loss,
    opacity_loss,
    sample_colour_loss,
)
from .numeric import central_difference, relative_error
from .render import (
    GradientScaler,
    Light,
    Rendering,
    attenuate,
    distance_scale,
    integrate,
    occupied,
    render,
    softplus,
    trilinear,
)
from .training import adam, photometric_loss, total_variation

__all__ = [
    "DeferredHead",
    "FeaturesHead",
    "Frustum",
    "GradientScaler",
    "Head",
    "Light",
    "Network",
    "Rendering",
    "RgbHead",
    "SampleDistances",
    "ShHead",
    "adam",
    "attenuate",
    "central_difference",
    "contract",
    "distance_scale",
    "distort",
    "distortion_loss",
    "entropy_loss",
    "fisheye_rays",
    "grid_coordinates",
    "huber_loss",
    "integrate",
    "jacobian_determinant",
    "jacobian_determinant_autograd",
    "mlp",
    "near_clip_loss",
    "normalized_coordinates",
    "occupied",
    "opacity_loss",
    "photometric_loss",
    "pinhole_rays",
    "random_network",
    "relative_error",
    "render",
    "sample_colour_loss",
    "sample_distances",
    "softplus",
    "spherical_harmonics",
    "total_variation",
    "trilinear",
    "undistort",
    "view_encoding",
]
