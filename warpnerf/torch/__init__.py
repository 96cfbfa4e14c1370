"""Drop-in torch operations: the paper's gradient scaling, and rendering through our own adjoint."""

from warpnerf.rendering.arguments import Head, March
from warpnerf.torch.rendering import RenderedRays, render_rays
from warpnerf.torch.scaling import scale_gradient

__all__ = ["Head", "March", "RenderedRays", "render_rays", "scale_gradient"]
