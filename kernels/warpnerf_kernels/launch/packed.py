"""Kernels of the walk in packs, on the CPU.

A thread is a worker, or in forward kernels a batch of rays. Workers of a launch that ends in a
gradient all run at the same time.
"""

from functools import cache

import warp as wp

from ..base.types import Rays, real, vec3
from ..cpu.scatter import clear_records, record_applier
from ..cpu.schedule import ray_schedule
from ..volume.loss import squared_error
from ..volume.ray_loss import NONE
from ..volume.render_params import ray_getter, ray_value
from ..volume.sample_loss import NO_SAMPLE_LOSS
from ..volume.variant import Variant
from ..volume.walk_packs import walk_packs
from .variant import TrainOutputs, render_outputs_type, render_params_type, scratch_type, sink_type


@cache
def ray_taker(variant: Variant) -> wp.Function:
    """The function take_rays: what a worker does in a launch before its first ray."""
    parts = variant.parts
    RenderParams, Sink = render_params_type(parts), sink_type(variant)
    assign_rays = ray_schedule(parts.sampler, parts.encoding, variant.space).assign_rays
    begin_rows, begin = parts.head.vectors.begin_rows, parts.encoding.vectors.begin
    begins = begin is not None

    @wp.func
    def take_rays(worker: int, scene: RenderParams, rays: Rays, sink: Sink) -> int:
        """How many of the chunk are this worker's; sink.chunk.rays[worker] then holds which."""
        clear_records(worker, sink)
        begin_rows(scene.head, worker)
        if wp.static(begins):
            begin(scene.field, worker)
        return assign_rays(
            worker,
            sink.chunk,
            scene.box,
            scene.march,
            scene.field,
            rays.origins,
            rays.directions,
        )

    return take_rays


@cache
def ray_returner(variant: Variant) -> wp.Function:
    """The function return_rays: what a worker does with a batch of the head's from adj_rgb on."""
    parts = variant.parts
    RenderParams, Scratch, Sink = (
        render_params_type(parts),
        scratch_type(variant),
        sink_type(variant),
    )
    adj_shade_rows = parts.head.vectors.adj_shade_rows
    adj_integrate = walk_packs(variant).adj_integrate

    @wp.func
    def return_rays(
        scene: RenderParams,
        rays: Rays,
        scratch: Scratch,
        worker: int,
        begin: int,  # place of the first ray among the worker's
        n: int,
        sink: Sink,  # added to
    ):
        """Rows hold adj_rgb, and of adj what does not come from it."""
        row = worker * wp.static(variant.batch)
        end = (worker + 1) * scratch.capacity
        adj_shade_rows(scene.head, scratch.rows, row, n, worker, sink.gradient)
        for r in range(n):
            i = sink.chunk.rays[worker, begin + r]
            background = ray_value(rays.background, i)
            adj_transmittance = wp.dot(scratch.rows[row + r].adj_rgb, background)
            adj_transmittance += scratch.rows[row + r].adj.transmittance
            adj_transmittance -= scratch.rows[row + r].adj_opacity
            scratch.rows[row + r].adj.transmittance = adj_transmittance
            scratch.rows[row + r].adj.content_distance = ray_value(rays.content_distance, i)
            adj_integrate(scene, scratch.rows, row + r, scratch.packs, end, worker, sink)

    return return_rays


@cache
def forward(variant: Variant) -> wp.Kernel:
    """Render rays, a batch of the head's at a time."""
    parts, batch = variant.parts, variant.batch
    RenderParams, RenderOutputs, Scratch = (
        render_params_type(parts),
        render_outputs_type(parts.head.n_channels),
        scratch_type(variant),
    )
    ray_of = ray_getter(variant)
    integrate = walk_packs(variant).integrate
    shade_rows, n_packs = parts.head.vectors.shade_rows, parts.head.vectors.n_packs

    @wp.kernel(module="unique", enable_backward=False)
    def render_forward(
        # launch
        first: int,  # this launch works on batches first, first + 1, ...
        worker: int,  # row of scratch
        n_rays: int,
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        # out
        scratch: Scratch,
        out_rendered: RenderOutputs,
    ):
        begin = (first + wp.tid()) * batch
        n = wp.min(batch, n_rays - begin)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for r in range(n):
            i = begin + r
            scratch.rows[row + r].ray = ray_of(scene, rays, i)
            integrate(
                scene,
                scratch.rows,
                row + r,
                scratch.packs,
                end - n_packs,  # none is kept
                end,
            )
        shade_rows(scene.head, scratch.rows, row, n)
        for r in range(n):
            i = begin + r
            transmittance = scratch.rows[row + r].transmittance
            out_rendered.rgb[i] = scratch.rows[row + r].rgb + transmittance * ray_value(
                rays.background, i
            )
            out_rendered.transmittance[i] = transmittance
            out_rendered.depth[i] = scratch.rows[row + r].depth
            out_rendered.n_samples[i] = scratch.rows[row + r].n_samples
            out_rendered.channels[i] = scratch.rows[row + r].channels

    return render_forward


@cache
def backward(variant: Variant) -> wp.Kernel:
    """Adjoint of forward: of what flows back to its outputs."""
    parts, batch = variant.parts, variant.batch
    RenderParams, RenderOutputs, Scratch = (
        render_params_type(parts),
        render_outputs_type(parts.head.n_channels),
        scratch_type(variant),
    )
    Sink = sink_type(variant)
    ray_of = ray_getter(variant)
    take_rays, return_rays = ray_taker(variant), ray_returner(variant)
    apply_records, RayAdjoint = record_applier(parts.encoding), walk_packs(variant).RayAdjoint
    on_ray = parts.losses.on_ray
    has_loss, State = on_ray is not NONE, on_ray.State
    prepare_row = parts.head.vectors.prepare_row
    shade_rows, n_packs = parts.head.vectors.shade_rows, parts.head.vectors.n_packs

    @wp.kernel(module="unique", enable_backward=False)
    def render_backward(
        # launch
        first: int,
        worker: int,  # row of scratch; owner of a part of the gradient
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        rendered: RenderOutputs,
        adj_rgb: wp.array(dtype=vec3),  # [n_rays] what flows back
        adj_opacity: wp.array(dtype=real),  # [n_rays]
        adj_depth: wp.array(dtype=real),  # [n_rays]
        # out
        scratch: Scratch,
        out_gradient: Sink,  # added to
    ):
        chunk = out_gradient.chunk
        n_mine = take_rays(worker, scene, rays, out_gradient)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for begin in range(0, n_mine, batch):
            n = wp.min(batch, n_mine - begin)
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                scratch.rows[row + r].ray = ray_of(scene, rays, i)
                prepare_row(scene.head, scratch.rows, row + r)
                scratch.rows[row + r].slot = end - n_packs  # none was kept
                scratch.rows[row + r].channels = rendered.channels[i]
                scratch.rows[row + r].depth = rendered.depth[i]
                scratch.rows[row + r].transmittance = rendered.transmittance[i]
                scratch.rows[row + r].n_samples = rendered.n_samples[i]
                adj = RayAdjoint()
                adj.transmittance = -adj_opacity[i]
                adj.depth = adj_depth[i]
                scratch.rows[row + r].adj = adj
                scratch.rows[row + r].adj_rgb = adj_rgb[i]
                if wp.static(has_loss):  # whose part in the gradient is none here
                    scratch.rows[row + r].loss = State()
                scratch.rows[row + r].target_rgb = vec3()  # likewise, of that on samples
            shade_rows(scene.head, scratch.rows, row, n)
            return_rays(scene, rays, scratch, worker, begin, n, out_gradient)
        apply_records(scene.field, worker, out_gradient)

    return render_backward


@cache
def train(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint."""
    parts, batch = variant.parts, variant.batch
    RenderParams, Scratch = render_params_type(parts), scratch_type(variant)
    Sink = sink_type(variant)
    ray_of = ray_getter(variant)
    take_rays, return_rays = ray_taker(variant), ray_returner(variant)
    apply_records, walked = record_applier(parts.encoding), walk_packs(variant)
    integrate, RayAdjoint = walked.integrate, walked.RayAdjoint
    photometric, on_ray, on_samples = parts.losses
    photometric_value, adj_photometric = photometric.value, photometric.adj_value
    has_loss, ray_loss = on_ray is not NONE, on_ray.value
    has_sample_loss, sample_loss = on_samples is not NO_SAMPLE_LOSS, on_samples.value
    shade_rows = parts.head.vectors.shade_rows

    @wp.kernel(module="unique", enable_backward=False)
    def render_train(
        # launch
        first: int,
        worker: int,  # row of scratch; owner of a part of the gradient
        # scene
        scene: RenderParams,
        # rays
        rays: Rays,
        target_rgb: wp.array(dtype=vec3),  # [n_rays] in the field's colours
        # choices
        loss_weight: real,  # of one ray
        # out
        scratch: Scratch,
        out_rays: TrainOutputs,
        out_gradient: Sink,  # added to
    ):
        chunk = out_gradient.chunk
        n_mine = take_rays(worker, scene, rays, out_gradient)
        row = worker * batch
        end = (worker + 1) * scratch.capacity
        for begin in range(0, n_mine, batch):
            n = wp.min(batch, n_mine - begin)
            slot = worker * scratch.capacity
            for r in range(n):
                i = chunk.rays[worker, begin + r]
                scratch.rows[row + r].ray = ray_of(scene, rays, i)
                scratch.rows[row + r].target_rgb = target_rgb[i]
                slot = integrate(
                    scene,
                    scratch.rows,
                    row + r,
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
                out_rays.rgb[i] = rgb
                out_rays.error[i] = squared_error(rgb, target_rgb[i])
                loss = photometric_value(scene.loss.photometric, rgb, target_rgb[i])
                if wp.static(has_loss):
                    loss += ray_loss(
                        scene.loss.on_ray,
                        scratch.rows[row + r].loss,
                        scratch.rows[row + r].transmittance,
                    )
                if wp.static(has_sample_loss):
                    loss += sample_loss(
                        scene.loss.on_samples,
                        scratch.rows[row + r].of_samples,
                        scratch.rows[row + r].channels,
                        target_rgb[i],
                    )
                out_rays.loss[i] = loss
                out_rays.n_samples[i] = scratch.rows[row + r].n_samples
                adj = RayAdjoint()
                adj.loss = loss_weight
                scratch.rows[row + r].adj = adj
                scratch.rows[row + r].adj_rgb = adj_photometric(
                    scene.loss.photometric, rgb, target_rgb[i], loss_weight
                )
            return_rays(scene, rays, scratch, worker, begin, n, out_gradient)
        apply_records(scene.field, worker, out_gradient)

    return render_train
