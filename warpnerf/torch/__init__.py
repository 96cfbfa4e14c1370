"""Drop-in torch operations: the paper's gradient scaling, and rendering through our own adjoint."""

from warpnerf.rendering.arguments import Head, March, StoredField
from warpnerf.rendering.stored import first_tensors
from warpnerf.torch.rendering import (
    RenderedIntervals,
    RenderedRays,
    render_intervals,
    render_rays,
)
from warpnerf.torch.scaling import scale_gradient

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
