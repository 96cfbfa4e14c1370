"""Kernels of the scalar walk: on CUDA, in float64, and for parts without a vector form.

A thread is a ray.
"""

from functools import cache

import warp as wp

from ..base.types import Rays, real, vec3
from ..volume.loss import squared_error
from ..volume.render_params import ray_getter, ray_value
from ..volume.variant import Variant
from ..volume.walk import walk
from .variant import NoScratch, TrainOutputs, render_outputs_type, render_params_type


@cache
def forward(variant: Variant) -> wp.Kernel:
    """Render rays."""
    parts = variant.parts
    RenderParams, RenderOutputs = (
        render_params_type(parts),
        render_outputs_type(parts.head.n_channels),
    )
    ray_of = ray_getter(variant)
    integrate = walk(variant).integrate
    shade = parts.head.shade

    @wp.kernel(module="unique", enable_backward=False)
    def render_forward(
        # launch
        first: int,  # this launch works on rays first, first + 1, ...
        worker: int,
        n_rays: int,
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        # out
        scratch: NoScratch,
        out_rendered: RenderOutputs,
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i)
        total = integrate(scene, ray, vec3())
        rgb = shade(scene.head, ray.direction, total.channels, real(1.0) - total.transmittance)
        out_rendered.rgb[i] = rgb + total.transmittance * ray_value(rays.background, i)
        out_rendered.transmittance[i] = total.transmittance
        out_rendered.depth[i] = total.depth
        out_rendered.n_samples[i] = total.n_samples
        out_rendered.channels[i] = total.channels

    return render_forward


@cache
def backward(variant: Variant) -> wp.Kernel:
    """Adjoint of forward: of what flows back to its outputs."""
    parts = variant.parts
    RenderParams, RenderOutputs = (
        render_params_type(parts),
        render_outputs_type(parts.head.n_channels),
    )
    Gradient = parts.encoding.Gradient
    ray_of = ray_getter(variant)
    walked = walk(variant)
    adj_integrate, RayAccumulator, RayAdjoint = (
        walked.adj_integrate,
        walked.RayAccumulator,
        walked.RayAdjoint,
    )
    adj_shade = parts.head.adj_shade

    @wp.kernel(module="unique", enable_backward=False)
    def render_backward(
        # launch
        first: int,
        worker: int,
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        rendered: RenderOutputs,
        adj_rgb: wp.array(dtype=vec3),  # [n_rays] what flows back
        adj_opacity: wp.array(dtype=real),  # [n_rays]
        adj_depth: wp.array(dtype=real),  # [n_rays]
        # out
        scratch: NoScratch,
        out_gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i)
        total = RayAccumulator()
        total.channels = rendered.channels[i]
        total.transmittance = rendered.transmittance[i]
        total.depth = rendered.depth[i]
        total.n_samples = rendered.n_samples[i]
        adj_channels, adj_shaded_opacity = adj_shade(
            scene.head,
            ray.direction,
            total.channels,
            real(1.0) - total.transmittance,
            adj_rgb[i],
            out_gradient,
        )
        adj = RayAdjoint()
        adj.channels = adj_channels
        adj.transmittance = wp.dot(adj_rgb[i], ray_value(rays.background, i)) - adj_opacity[i]
        adj.transmittance -= adj_shaded_opacity
        adj.depth = adj_depth[i]
        adj.content_distance = ray_value(rays.content_distance, i)
        adj_integrate(scene, ray, total, adj, vec3(), out_gradient)

    return render_backward


@cache
def train(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint."""
    parts = variant.parts
    RenderParams = render_params_type(parts)
    Gradient = parts.encoding.Gradient
    ray_of = ray_getter(variant)
    walked = walk(variant)
    integrate, adj_integrate, RayAdjoint = walked.integrate, walked.adj_integrate, walked.RayAdjoint
    shade, adj_shade = parts.head.shade, parts.head.adj_shade
    photometric, on_ray, on_samples = parts.losses
    photometric_value, adj_photometric = photometric.value, photometric.adj_value
    ray_loss, sample_loss = on_ray.value, on_samples.value

    @wp.kernel(module="unique", enable_backward=False)
    def render_train(
        # launch
        first: int,
        worker: int,
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        target_rgb: wp.array(dtype=vec3),  # [n_rays] in the field's colours
        # choices
        loss_weight: real,  # of one ray
        # out
        scratch: NoScratch,
        out_rays: TrainOutputs,
        out_gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i)
        total = integrate(scene, ray, target_rgb[i])
        behind_all = ray_value(rays.background, i)
        opacity = real(1.0) - total.transmittance
        rgb = shade(scene.head, ray.direction, total.channels, opacity)
        rgb += total.transmittance * behind_all
        out_rays.rgb[i] = rgb
        out_rays.error[i] = squared_error(rgb, target_rgb[i])
        loss = photometric_value(scene.loss.photometric, rgb, target_rgb[i])
        loss += ray_loss(scene.loss.on_ray, total.loss, total.transmittance)
        loss += sample_loss(scene.loss.on_samples, total.of_samples, total.channels, target_rgb[i])
        out_rays.loss[i] = loss
        out_rays.n_samples[i] = total.n_samples
        adj_rgb = adj_photometric(scene.loss.photometric, rgb, target_rgb[i], loss_weight)
        adj_channels, adj_opacity = adj_shade(
            scene.head, ray.direction, total.channels, opacity, adj_rgb, out_gradient
        )
        adj = RayAdjoint()
        adj.channels = adj_channels
        adj.transmittance = wp.dot(adj_rgb, behind_all) - adj_opacity
        adj.loss = loss_weight
        adj.content_distance = ray_value(rays.content_distance, i)
        adj_integrate(scene, ray, total, adj, target_rgb[i], out_gradient)

    return render_train
