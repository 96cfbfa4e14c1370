"""Models put together from parts, and the kernels made of them: the only place that does so.

What selects a variant (``contraction``, ``scaling``, ``jacobian``) is a constant in each kernel, so
the compiler drops what a variant does not use. So are the parts, and the choice between the scalar
walk and that in packs of sixteen, which is for the CPU.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from ..base.parts import Encoding, Head, RayLoss, Sampler
from ..base.types import gradient_type, real, vec3, vector
from ..cpu.scatter import delivery, leave_none
from ..cpu.schedule import ray_schedule
from ..sampling.steps import STEPS
from ..volume import scene as scenes
from ..volume.loss import adj_squared_error, squared_error
from ..volume.ray_loss import NONE
from ..volume.scene import Rays, ray_getter, ray_value
from ..volume.walk import walk
from ..volume.walk_packs import walk_packs


class Parts(NamedTuple):
    """What a model is made of."""

    encoding: Encoding
    head: Head
    sampler: Sampler = STEPS
    loss: RayLoss = NONE

    @property
    def have_packs(self) -> bool:
        """Whether all parts have a vector form; else the CPU runs the scalar one, on a thread."""
        return (
            self.sampler.place_pack is not None
            and self.encoding.vectors is not None
            and self.head.vectors is not None
        )


class Variant(NamedTuple):
    """What kernels are compiled for; the constants live in contraction.py and gradscale.py."""

    parts: Parts
    contraction: int
    scaling: int
    jacobian: int
    packed: bool  # sixteen samples at a time; float32 on the CPU only

    @property
    def batch(self) -> int:
        """Rays that a worker has in hand together."""
        return self.parts.head.vectors.batch if self.packed else 1


def scene_type(parts: Parts) -> type:
    """What rays are marched through."""
    return scenes.scene_type(parts.sampler, parts.encoding, parts.head)


def _ray_of(parts: Parts) -> wp.Function:
    return ray_getter(parts.sampler, parts.encoding, parts.head)


@cache
def seen_type(n_channels: int) -> type:
    """What rays see: written by forward kernels, read by backward ones."""

    @wp.struct
    class Seen:
        rgb: wp.array(dtype=vec3)  # [n_rays] with background
        transmittance: wp.array(dtype=real)  # [n_rays]
        depth: wp.array(dtype=real)  # [n_rays] scene units
        n_samples: wp.array(dtype=wp.int32)  # [n_rays]
        channels: wp.array(dtype=vector(n_channels))  # [n_rays] before the head's last part

    return Seen


@wp.struct
class Nowhere:
    """Scratch of the scalar walk, which keeps nothing."""

    unused: int


@cache
def scratch_type(variant: Variant) -> type:
    """What workers keep between the two passes."""
    if not variant.packed:
        return Nowhere
    parts = variant.parts
    walked = walk_packs(parts.sampler, parts.encoding, parts.head, parts.loss)

    @wp.struct
    class Scratch:
        capacity: int  # packs of each worker, n_packs of the head at least
        packs: wp.array(dtype=walked.Pack)  # [n_workers * capacity]
        rows: wp.array(dtype=walked.Row)  # [n_workers * batch]

    return Scratch


def sink_type(variant: Variant) -> type:
    """What kernels add to: the gradient, or that and records on their way to it."""
    parts = variant.parts
    if not variant.packed:
        return gradient_type(parts.encoding.n_floats)
    return walk_packs(parts.sampler, parts.encoding, parts.head, parts.loss).Sink


def render_forward_kernel(variant: Variant) -> wp.Kernel:
    """Render rays: (first, worker, n_rays, scene, rays, scratch, out_seen).

    A thread takes as many rays as the variant's batch; what the kernel depends on of the variant is
    the parts and the contraction.
    """
    variant = variant._replace(scaling=0, jacobian=0)
    return _forward_packs(variant) if variant.packed else _forward(variant)


def render_backward_kernel(variant: Variant) -> wp.Kernel:
    """Adjoint of render_forward, replaying its rays; gradients of samples are scaled.

    (first, worker, scene, rays, seen, adj_rgb, adj_opacity, adj_depth, scratch, out_gradient)
    """
    return _backward_packs(variant) if variant.packed else _backward(variant)


def render_train_kernel(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint of a batch in one launch.

    (first, worker, scene, rays, target_rgb, loss_weight, scratch, out_error, out_loss,
    out_n_samples, out_gradient)
    """
    return _train_packs(variant) if variant.packed else _train(variant)


# The scalar walk: a thread is a ray.


@cache
def _forward(variant: Variant) -> wp.Kernel:
    parts, contraction = variant.parts, variant.contraction
    Scene, Seen = scene_type(parts), seen_type(parts.head.n_channels)
    ray_of = _ray_of(parts)
    integrate = walk(parts.sampler, parts.encoding, parts.head, parts.loss).integrate
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
def _backward(variant: Variant) -> wp.Kernel:
    parts, contraction = variant.parts, variant.contraction
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Seen = scene_type(parts), seen_type(parts.head.n_channels)
    Gradient = gradient_type(parts.encoding.n_floats)
    ray_of = _ray_of(parts)
    walked = walk(parts.sampler, parts.encoding, parts.head, parts.loss)
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
            ray_value(rays.content_distance, i),
            contraction,
            scaling,
            jacobian,
            out_gradient,
        )

    return render_backward


@cache
def _train(variant: Variant) -> wp.Kernel:
    parts, contraction = variant.parts, variant.contraction
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene = scene_type(parts)
    Gradient = gradient_type(parts.encoding.n_floats)
    ray_of = _ray_of(parts)
    walked = walk(parts.sampler, parts.encoding, parts.head, parts.loss)
    integrate, adj_integrate = walked.integrate, walked.adj_integrate
    shade, adj_shade = parts.head.shade, parts.head.adj_shade
    has_loss, loss_value = parts.loss is not NONE, parts.loss.value

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
        out_loss: wp.array(dtype=real),  # [n_rays] of the samples; not written where there is none
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
        if wp.static(has_loss):
            out_loss[i] = loss_value(total.loss)
        out_n_samples[i] = total.n_samples
        adj_rgb = adj_squared_error(rgb, target_rgb[i], loss_weight)
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
            ray_value(rays.content_distance, i),
            contraction,
            scaling,
            jacobian,
            out_gradient,
        )

    return render_train


# The walk in packs: a thread is a worker, or in forward kernels a batch of rays. Workers of a
# launch that ends in a gradient all run at the same time.


@cache
def _forward_packs(variant: Variant) -> wp.Kernel:
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    Scene, Seen, Scratch = (
        scene_type(parts),
        seen_type(parts.head.n_channels),
        scratch_type(variant),
    )
    ray_of = _ray_of(parts)
    integrate = walk_packs(parts.sampler, parts.encoding, parts.head, parts.loss).integrate
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
def _backward_packs(variant: Variant) -> wp.Kernel:
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Seen, Scratch = (
        scene_type(parts),
        seen_type(parts.head.n_channels),
        scratch_type(variant),
    )
    Sink = sink_type(variant)
    ray_of = _ray_of(parts)
    take_share = ray_schedule(parts.sampler, parts.encoding).take_share
    deliver = delivery(parts.encoding)
    adj_integrate = walk_packs(parts.sampler, parts.encoding, parts.head, parts.loss).adj_integrate
    has_loss, State = parts.loss is not NONE, parts.loss.State
    begin_rows, prepare_row = parts.head.vectors.begin_rows, parts.head.vectors.prepare_row
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
        leave_none(worker, out_gradient)
        begin_rows(scene.head, worker)
        n_mine = take_share(
            worker,
            chunk,
            scene.box,
            scene.march,
            scene.field,
            rays.origins,
            rays.directions,
            contraction,
        )
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
def _train_packs(variant: Variant) -> wp.Kernel:
    parts, contraction, batch = variant.parts, variant.contraction, variant.batch
    scaling, jacobian = variant.scaling, variant.jacobian
    Scene, Scratch = scene_type(parts), scratch_type(variant)
    Sink = sink_type(variant)
    ray_of = _ray_of(parts)
    take_share = ray_schedule(parts.sampler, parts.encoding).take_share
    deliver = delivery(parts.encoding)
    walked = walk_packs(parts.sampler, parts.encoding, parts.head, parts.loss)
    integrate, adj_integrate = walked.integrate, walked.adj_integrate
    begin_rows = parts.head.vectors.begin_rows
    has_loss, loss_value = parts.loss is not NONE, parts.loss.value
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
        out_loss: wp.array(dtype=real),  # [n_rays] of the samples; not written where there is none
        out_n_samples: wp.array(dtype=wp.int32),  # [n_rays]
        out_gradient: Sink,  # added to
    ):
        chunk = out_gradient.chunk
        leave_none(worker, out_gradient)
        begin_rows(scene.head, worker)
        n_mine = take_share(
            worker,
            chunk,
            scene.box,
            scene.march,
            scene.field,
            rays.origins,
            rays.directions,
            contraction,
        )
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
                if wp.static(has_loss):
                    out_loss[i] = loss_value(scratch.rows[row + r].loss)
                out_n_samples[i] = scratch.rows[row + r].n_samples
                scratch.rows[row + r].adj_rgb = adj_squared_error(rgb, target_rgb[i], loss_weight)
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
