"""Kernels of the walk in packs, on the CPU.

A thread is a worker, or in forward kernels a batch of rays. Workers of a launch that ends in a
gradient all run at the same time.
"""

from functools import cache

import warp as wp

from ..base.types import real, vec3
from ..cpu.scatter import delivery, leave_none
from ..cpu.schedule import ray_schedule
from ..volume.loss import squared_error
from ..volume.ray_loss import NONE
from ..volume.sample_loss import sample_loss
from ..volume.scene import Rays, ray_value
from ..volume.walk_packs import walk_packs
from .variant import Variant, ray_of_parts, scene_type, scratch_type, seen_type, sink_type


@cache
def ray_taker(variant: Variant) -> wp.Function:
    """The function take_rays: what a worker does in a launch before its first ray."""
    parts = variant.parts
    Scene, Sink = scene_type(parts), sink_type(variant)
    take_share = ray_schedule(parts.sampler, parts.encoding).take_share
    begin_rows = parts.head.vectors.begin_rows

    @wp.func
    def take_rays(worker: int, scene: Scene, rays: Rays, contraction: int, sink: Sink) -> int:
        """How many of the chunk are this worker's; sink.chunk.rays[worker] then holds which."""
        leave_none(worker, sink)
        begin_rows(scene.head, worker)
        return take_share(
            worker,
            sink.chunk,
            scene.box,
            scene.march,
            scene.field,
            rays.origins,
            rays.directions,
            contraction,
        )

    return take_rays


@cache
def forward(variant: Variant) -> wp.Kernel:
    """Render rays, a batch of the head's at a time."""
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    Scene, Seen, Scratch = (
        scene_type(parts),
        seen_type(parts.head.n_channels),
        scratch_type(variant),
    )
    ray_of = ray_of_parts(parts)
    integrate = walk_packs(parts.sampler, parts.encoding, parts.head, parts.losses).integrate
    shade_rows, n_packs = parts.head.vectors.shade_rows, parts.head.vectors.n_packs

    @wp.kernel(module="unique", enable_backward=False)
    def render_forward(
        first: int,  # this launch works on batches first, first + 1, ...
        worker: int,  # row of scratch
        n_rays: int,
        scene: Scene,
        rays: Rays,
        scratch: Scratch,
        out_seen: Seen,
    ):
        begin = (first + wp.tid()) * batch
        n = wp.min(batch, n_rays - begin)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for r in range(n):
            i = begin + r
            scratch.rows[row + r].ray = ray_of(scene, rays, i, contraction)
            integrate(
                scene,
                scratch.rows,
                row + r,
                contraction,
                scratch.packs,
                end - n_packs,  # none is kept
                end,
            )
        shade_rows(scene.head, scratch.rows, row, n)
        for r in range(n):
            i = begin + r
            transmittance = scratch.rows[row + r].transmittance
            out_seen.rgb[i] = scratch.rows[row + r].rgb + transmittance * ray_value(
                rays.background, i
            )
            out_seen.transmittance[i] = transmittance
            out_seen.depth[i] = scratch.rows[row + r].depth
            out_seen.n_samples[i] = scratch.rows[row + r].n_samples
            out_seen.channels[i] = scratch.rows[row + r].channels

    return render_forward


@cache
def backward(variant: Variant) -> wp.Kernel:
    """Adjoint of forward: of what flows back to its outputs."""
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Seen, Scratch = (
        scene_type(parts),
        seen_type(parts.head.n_channels),
        scratch_type(variant),
    )
    Sink = sink_type(variant)
    ray_of = ray_of_parts(parts)
    take_rays, deliver = ray_taker(variant), delivery(parts.encoding)
    adj_integrate = walk_packs(
        parts.sampler, parts.encoding, parts.head, parts.losses
    ).adj_integrate
    on_ray, on_samples = parts.losses.on_ray, parts.losses.on_samples
    has_loss, State = on_ray is not NONE, on_ray.State
    prepare_row = parts.head.vectors.prepare_row
    n_packs = parts.head.vectors.n_packs
    shade_rows, adj_shade_rows = parts.head.vectors.shade_rows, parts.head.vectors.adj_shade_rows

    @wp.kernel(module="unique", enable_backward=False)
    def render_backward(
        first: int,
        worker: int,  # row of scratch; owner of a part of the gradient
        scene: Scene,
        rays: Rays,
        seen: Seen,
        adj_rgb: wp.array(dtype=vec3),  # [n_rays] what flows back
        adj_opacity: wp.array(dtype=real),  # [n_rays]
        adj_depth: wp.array(dtype=real),  # [n_rays]
        scratch: Scratch,
        out_gradient: Sink,  # added to
    ):
        chunk = out_gradient.chunk
        n_mine = take_rays(worker, scene, rays, contraction, out_gradient)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for begin in range(0, n_mine, batch):
            n = wp.min(batch, n_mine - begin)
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                scratch.rows[row + r].ray = ray_of(scene, rays, i, contraction)
                prepare_row(scene.head, scratch.rows, row + r)
                scratch.rows[row + r].slot = end - n_packs  # none was kept
                scratch.rows[row + r].channels = seen.channels[i]
                scratch.rows[row + r].depth = seen.depth[i]
                scratch.rows[row + r].transmittance = seen.transmittance[i]
                scratch.rows[row + r].n_samples = seen.n_samples[i]
                scratch.rows[row + r].adj_rgb = adj_rgb[i]
                if wp.static(has_loss):  # whose part in the gradient is none here
                    scratch.rows[row + r].loss = State()
                if wp.static(on_samples):  # likewise
                    scratch.rows[row + r].target_rgb = vec3()
            shade_rows(scene.head, scratch.rows, row, n)
            adj_shade_rows(scene.head, scratch.rows, row, n, worker, out_gradient.gradient)
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                adj_transmittance = (
                    wp.dot(adj_rgb[i], ray_value(rays.background, i)) - adj_opacity[i]
                )
                adj_integrate(
                    scene,
                    scratch.rows,
                    row + r,
                    adj_transmittance - scratch.rows[row + r].adj_opacity,
                    adj_depth[i],
                    real(0.0),
                    ray_value(rays.content_distance, i),
                    contraction,
                    scaling,
                    jacobian,
                    scratch.packs,
                    end,
                    worker,
                    out_gradient,
                )
        deliver(scene.field, worker, out_gradient)

    return render_backward


@cache
def train(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint."""
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Scratch = scene_type(parts), scratch_type(variant)
    Sink = sink_type(variant)
    ray_of = ray_of_parts(parts)
    take_rays, deliver = ray_taker(variant), delivery(parts.encoding)
    walked = walk_packs(parts.sampler, parts.encoding, parts.head, parts.losses)
    integrate, adj_integrate = walked.integrate, walked.adj_integrate
    photometric, on_ray, on_samples = parts.losses
    photometric_value, adj_photometric = photometric.value, photometric.adj_value
    has_loss, ray_loss = on_ray is not NONE, on_ray.value
    shade_rows, adj_shade_rows = parts.head.vectors.shade_rows, parts.head.vectors.adj_shade_rows

    @wp.kernel(module="unique", enable_backward=False)
    def render_train(
        first: int,
        worker: int,  # row of scratch; owner of a part of the gradient
        scene: Scene,
        rays: Rays,
        target_rgb: wp.array(dtype=vec3),  # [n_rays] in [0, 1]
        loss_weight: real,  # of one ray
        scratch: Scratch,
        out_error: wp.array(dtype=real),  # [n_rays] squared error
        out_loss: wp.array(dtype=real),  # [n_rays]
        out_n_samples: wp.array(dtype=wp.int32),  # [n_rays]
        out_gradient: Sink,  # added to
    ):
        chunk = out_gradient.chunk
        n_mine = take_rays(worker, scene, rays, contraction, out_gradient)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for begin in range(0, n_mine, batch):
            n = wp.min(batch, n_mine - begin)
            slot = worker * scratch.capacity
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                scratch.rows[row + r].ray = ray_of(scene, rays, i, contraction)
                slot = integrate(
                    scene,
                    scratch.rows,
                    row + r,
                    contraction,
                    scratch.packs,
                    slot,
                    end,
                )
            shade_rows(scene.head, scratch.rows, row, n)
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                rgb = scratch.rows[row + r].rgb + scratch.rows[row + r].transmittance * ray_value(
                    rays.background, i
                )
                out_error[i] = squared_error(rgb, target_rgb[i])
                loss = photometric_value(scene.loss.photometric, rgb, target_rgb[i])
                if wp.static(has_loss):
                    loss += ray_loss(
                        scene.loss.on_ray,
                        scratch.rows[row + r].loss,
                        scratch.rows[row + r].transmittance,
                    )
                if wp.static(on_samples):
                    scratch.rows[row + r].target_rgb = target_rgb[i]
                    loss += sample_loss(
                        scene.loss.on_samples,
                        scratch.rows[row + r].of_samples,
                        scratch.rows[row + r].channels,
                        target_rgb[i],
                    )
                out_loss[i] = loss
                out_n_samples[i] = scratch.rows[row + r].n_samples
                scratch.rows[row + r].adj_rgb = adj_photometric(
                    scene.loss.photometric, rgb, target_rgb[i], loss_weight
                )
            adj_shade_rows(scene.head, scratch.rows, row, n, worker, out_gradient.gradient)
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                adj_transmittance = wp.dot(
                    scratch.rows[row + r].adj_rgb, ray_value(rays.background, i)
                )
                adj_integrate(
                    scene,
                    scratch.rows,
                    row + r,
                    adj_transmittance - scratch.rows[row + r].adj_opacity,
                    real(0.0),
                    loss_weight,
                    ray_value(rays.content_distance, i),
                    contraction,
                    scaling,
                    jacobian,
                    scratch.packs,
                    end,
                    worker,
                    out_gradient,
                )
        deliver(scene.field, worker, out_gradient)

    return render_train
