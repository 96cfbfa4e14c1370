"""Kernels of the scalar walk: on CUDA, in float64, and for parts without a vector form.

A thread is a ray.
"""

from functools import cache

import warp as wp

from ..base.types import gradient_type, real, vec3
from ..volume.loss import squared_error
from ..volume.sample_loss import sample_loss
from ..volume.scene import Rays, ray_value
from ..volume.walk import walk
from .variant import Nowhere, Variant, ray_of_parts, scene_type, seen_type


@cache
def forward(variant: Variant) -> wp.Kernel:
    """Render rays."""
    parts, contraction = variant.parts, variant.contraction
    Scene, Seen = scene_type(parts), seen_type(parts.head.n_channels)
    ray_of = ray_of_parts(parts)
    integrate = walk(parts.sampler, parts.encoding, parts.head, parts.losses).integrate
    shade = parts.head.shade

    @wp.kernel(module="unique", enable_backward=False)
    def render_forward(
        first: int,  # this launch works on rays first, first + 1, ...
        worker: int,
        n_rays: int,
        scene: Scene,
        rays: Rays,
        scratch: Nowhere,
        out_seen: Seen,
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i, contraction)
        total = integrate(
            scene,
            ray,
            contraction,
        )
        rgb = shade(scene.head, ray.direction, total.channels, real(1.0) - total.transmittance)
        out_seen.rgb[i] = rgb + total.transmittance * ray_value(rays.background, i)
        out_seen.transmittance[i] = total.transmittance
        out_seen.depth[i] = total.depth
        out_seen.n_samples[i] = total.n_samples
        out_seen.channels[i] = total.channels

    return render_forward


@cache
def backward(variant: Variant) -> wp.Kernel:
    """Adjoint of forward: of what flows back to its outputs."""
    parts, contraction = variant.parts, variant.contraction
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Seen = scene_type(parts), seen_type(parts.head.n_channels)
    Gradient = gradient_type(parts.encoding.n_floats)
    ray_of = ray_of_parts(parts)
    walked = walk(parts.sampler, parts.encoding, parts.head, parts.losses)
    adj_integrate, Integral = walked.adj_integrate, walked.Integral
    adj_shade = parts.head.adj_shade

    @wp.kernel(module="unique", enable_backward=False)
    def render_backward(
        first: int,
        worker: int,
        scene: Scene,
        rays: Rays,
        seen: Seen,
        adj_rgb: wp.array(dtype=vec3),  # [n_rays] what flows back
        adj_opacity: wp.array(dtype=real),  # [n_rays]
        adj_depth: wp.array(dtype=real),  # [n_rays]
        scratch: Nowhere,
        out_gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i, contraction)
        total = Integral()
        total.channels = seen.channels[i]
        total.transmittance = seen.transmittance[i]
        total.depth = seen.depth[i]
        total.n_samples = seen.n_samples[i]
        adj_channels, adj_shaded_opacity = adj_shade(
            scene.head,
            ray.direction,
            total.channels,
            real(1.0) - total.transmittance,
            adj_rgb[i],
            out_gradient,
        )
        adj_transmittance = wp.dot(adj_rgb[i], ray_value(rays.background, i)) - adj_opacity[i]
        adj_integrate(
            scene,
            ray,
            total,
            adj_channels,
            adj_transmittance - adj_shaded_opacity,
            adj_depth[i],
            real(0.0),
            vec3(),
            ray_value(rays.content_distance, i),
            contraction,
            scaling,
            jacobian,
            out_gradient,
        )

    return render_backward


@cache
def train(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint."""
    parts, contraction = variant.parts, variant.contraction
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene = scene_type(parts)
    Gradient = gradient_type(parts.encoding.n_floats)
    ray_of = ray_of_parts(parts)
    walked = walk(parts.sampler, parts.encoding, parts.head, parts.losses)
    integrate, adj_integrate = walked.integrate, walked.adj_integrate
    shade, adj_shade = parts.head.shade, parts.head.adj_shade
    photometric, on_ray, on_samples = parts.losses
    photometric_value, adj_photometric = photometric.value, photometric.adj_value
    ray_loss = on_ray.value

    @wp.kernel(module="unique", enable_backward=False)
    def render_train(
        first: int,
        worker: int,
        scene: Scene,
        rays: Rays,
        target_rgb: wp.array(dtype=vec3),  # [n_rays] in [0, 1]
        loss_weight: real,  # of one ray
        scratch: Nowhere,
        out_error: wp.array(dtype=real),  # [n_rays] squared error
        out_loss: wp.array(dtype=real),  # [n_rays]
        out_n_samples: wp.array(dtype=wp.int32),  # [n_rays]
        out_gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        ray = ray_of(scene, rays, i, contraction)
        total = integrate(
            scene,
            ray,
            contraction,
        )
        behind_all = ray_value(rays.background, i)
        opacity = real(1.0) - total.transmittance
        rgb = shade(scene.head, ray.direction, total.channels, opacity)
        rgb += total.transmittance * behind_all
        out_error[i] = squared_error(rgb, target_rgb[i])
        loss = photometric_value(scene.loss.photometric, rgb, target_rgb[i])
        loss += ray_loss(scene.loss.on_ray, total.loss, total.transmittance)
        if wp.static(on_samples):
            factor = scene.loss.on_samples
            loss += sample_loss(factor, total.of_samples, total.channels, target_rgb[i])
        out_loss[i] = loss
        out_n_samples[i] = total.n_samples
        adj_rgb = adj_photometric(scene.loss.photometric, rgb, target_rgb[i], loss_weight)
        adj_channels, adj_opacity = adj_shade(
            scene.head, ray.direction, total.channels, opacity, adj_rgb, out_gradient
        )
        adj_integrate(
            scene,
            ray,
            total,
            adj_channels,
            wp.dot(adj_rgb, behind_all) - adj_opacity,
            real(0.0),
            loss_weight,
            target_rgb[i],
            ray_value(rays.content_distance, i),
            contraction,
            scaling,
            jacobian,
            out_gradient,
        )

    return render_train
