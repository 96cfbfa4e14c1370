"""A model's parts, put together: the kernels, and all that the host needs to launch them."""

import warp as wp

from ..base.types import Rays
from ..volume.variant import Parts, Variant
from . import packed, scalar
from .variant import TrainOutputs, render_outputs_type, render_params_type, scratch_type, sink_type

__all__ = [
    "Parts",
    "Rays",
    "TrainOutputs",
    "Variant",
    "render_backward_kernel",
    "render_forward_kernel",
    "render_outputs_type",
    "render_params_type",
    "render_train_kernel",
    "scratch_type",
    "sink_type",
]


def render_forward_kernel(variant: Variant) -> wp.Kernel:
    """Render rays: (first, worker, n_rays, scene, rays, scratch, out_rendered).

    A thread takes as many rays as the variant's batch; what the kernel depends on of the variant is
    the parts and the space.
    """
    variant = variant._replace(scaling=0, jacobian=0)
    return packed.forward(variant) if variant.packed else scalar.forward(variant)


def render_backward_kernel(variant: Variant) -> wp.Kernel:
    """Adjoint of render_forward, replaying its rays; gradients of samples are scaled.

    (first, worker, scene, rays, rendered, adj_rgb, adj_opacity, adj_depth, scratch, out_gradient)
    """
    return packed.backward(variant) if variant.packed else scalar.backward(variant)


def render_train_kernel(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint of a batch in one launch.

    (first, worker, scene, rays, target_rgb, loss_weight, scratch, out_rays, out_gradient)
    """
    return packed.train(variant) if variant.packed else scalar.train(variant)
