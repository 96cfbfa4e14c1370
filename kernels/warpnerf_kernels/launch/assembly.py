"""A model's parts, put together: the kernels, and all that the host needs to launch them."""

import warp as wp

from ..volume.scene import Rays
from . import packed, scalar
from .variant import Parts, Variant, scene_type, scratch_type, seen_type, sink_type

__all__ = [
    "Parts",
    "Rays",
    "Variant",
    "render_backward_kernel",
    "render_forward_kernel",
    "render_train_kernel",
    "scene_type",
    "scratch_type",
    "seen_type",
    "sink_type",
]


def render_forward_kernel(variant: Variant) -> wp.Kernel:
    """Render rays: (first, worker, n_rays, scene, rays, scratch, out_seen).

    A thread takes as many rays as the variant's batch; what the kernel depends on of the variant is
    the parts and the contraction.
    """
    variant = variant._replace(scaling=0, jacobian=0)
    return packed.forward(variant) if variant.packed else scalar.forward(variant)


def render_backward_kernel(variant: Variant) -> wp.Kernel:
    """Adjoint of render_forward, replaying its rays; gradients of samples are scaled.

    (first, worker, scene, rays, seen, adj_rgb, adj_opacity, adj_depth, scratch, out_gradient)
    """
    return packed.backward(variant) if variant.packed else scalar.backward(variant)


def render_train_kernel(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint of a batch in one launch.

    (first, worker, scene, rays, target_rgb, loss_weight, scratch, out_error, out_loss,
    out_n_samples, out_gradient)
    """
    return packed.train(variant) if variant.packed else scalar.train(variant)
