"""The three kernels that render: forward, backward, and both with the loss between, for training.

What selects a variant (``scaling``, ``jacobian``, ``contraction``) is a constant in each kernel, so
the compiler drops what a variant does not use. So is the choice between the plain integral, a
sample at a time, and the packed one, sixteen at a time, which is for the CPU.
"""

from functools import cache
from typing import NamedTuple

import warp as wp

from . import integral, integral_packed, order, packs, parcels
from .loss import adj_squared_error, squared_error
from .march import prepare_ray
from .parcels import deliver, leave_none
from .types import FreeSpace, Gradient, Grid, Integral, March, Sample, real, vec3


class Variant(NamedTuple):
    """What a kernel is compiled for; the constants live in contraction.py and gradscale.py."""

    contraction: int
    scaling: int
    jacobian: int
    packed: bool  # sixteen samples at a time; float32 on the CPU only


def kept_type(variant: Variant) -> type:
    """What these kernels keep of a ray between the passes: samples or packs of sixteen."""
    return packs.Pack if variant.packed else Sample


def gradient_type(variant: Variant) -> type:
    """What these kernels add to: the gradient, or that and parcels on their way to it."""
    return parcels.Parcels if variant.packed else Gradient


@wp.func
def ray_value(values: wp.array(dtype=vec3), ray: int) -> vec3:
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


@wp.func
def ray_value(values: wp.array(dtype=real), ray: int) -> real:  # noqa: F811 (an overload)
    """One value for all rays, or one per ray."""
    return values[wp.min(ray, values.shape[0] - 1)]


# How a kernel that ends in a gradient takes rays, and what is left to do after them. Plain kernels
# have a ray for each thread, and nothing to do but to add to the gradient.


@wp.func
def take_rays(
    thread: int,
    worker: int,
    grid: Grid,
    march: March,
    origins: wp.array(dtype=vec3),
    directions: wp.array(dtype=vec3),
    contraction: int,
    gradient: Gradient,
) -> wp.vec2i:
    """Its places, from the first to before the second: one."""
    return wp.vec2i(thread, thread + 1)


@wp.func
def ray_at(place: int, worker: int, gradient: Gradient) -> int:
    """They come as they are."""
    return place


@wp.func
def finish(size: wp.vec3i, worker: int, gradient: Gradient):
    """Nothing."""


# Packed ones have a thread for each worker, all of which run at the same time.


@wp.func
def take_rays(  # noqa: F811 (an overload)
    thread: int,
    worker: int,
    grid: Grid,
    march: March,
    origins: wp.array(dtype=vec3),
    directions: wp.array(dtype=vec3),
    contraction: int,
    gradient: parcels.Parcels,
) -> wp.vec2i:
    """Its places: its share of the turn."""
    leave_none(worker, gradient)
    n = order.take_share(worker, gradient.turn, grid, march, origins, directions, contraction)
    return wp.vec2i(0, n)


@wp.func
def ray_at(place: int, worker: int, gradient: parcels.Parcels) -> int:  # noqa: F811 (an overload)
    """Each worker has a row of them."""
    return gradient.turn.rays[worker, place]


@wp.func
def finish(size: wp.vec3i, worker: int, gradient: parcels.Parcels):  # noqa: F811 (an overload)
    """Others have left something for it."""
    deliver(size, worker, gradient)


@cache
def render_forward_kernel(variant: Variant) -> wp.Kernel:
    """Render rays; what it depends on of the variant is the contraction."""
    contraction = variant.contraction
    walk = integral_packed if variant.packed else integral
    integrate = walk.integrate
    Kept = kept_type(variant)

    @wp.kernel(module="unique", enable_backward=False)
    def render_forward(
        first: int,  # this launch works on rays first, first + 1, ...
        worker: int,  # row of kept
        # scene
        grid: Grid,
        free: FreeSpace,
        march: March,
        # rays
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        offsets: wp.array(dtype=real),  # [n_rays] or [1], in [0, 1)
        background: wp.array(dtype=vec3),  # [n_rays] or [1], rgb in [0, 1]
        # scratch
        capacity: int,  # of kept, for each worker: 1 in packs, else 0; nothing is kept
        kept: wp.array(dtype=Kept),  # [n_workers * capacity]
        # out
        out_rgb: wp.array(dtype=vec3),  # [n_rays] with background
        out_transmittance: wp.array(dtype=real),  # [n_rays]
        out_depth: wp.array(dtype=real),  # [n_rays] scene units
        out_n_samples: wp.array(dtype=wp.int32),  # [n_rays]
    ):
        i = first + wp.tid()
        ray = prepare_ray(
            grid, march, origins[i], directions[i], ray_value(offsets, i), contraction
        )
        total = integrate(grid, free, march, ray, worker * capacity, capacity, contraction, kept)
        out_rgb[i] = total.rgb + total.transmittance * ray_value(background, i)
        out_transmittance[i] = total.transmittance
        out_depth[i] = total.depth
        out_n_samples[i] = total.n_samples

    return render_forward


@cache
def render_backward_kernel(variant: Variant) -> wp.Kernel:
    """Adjoint of render_forward, replaying its rays; gradients of samples are scaled."""
    contraction = variant.contraction
    walk = integral_packed if variant.packed else integral
    adj_integrate = walk.adj_integrate
    Kept = kept_type(variant)
    OutGradient = gradient_type(variant)
    scaling = variant.scaling
    jacobian = variant.jacobian

    @wp.kernel(module="unique", enable_backward=False)
    def render_backward(
        first: int,  # number of the first thread: a ray's, or where packed a worker's
        worker: int,  # row of kept; owner of a part of the gradient
        # scene
        grid: Grid,
        free: FreeSpace,
        march: March,
        # rays
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        offsets: wp.array(dtype=real),  # [n_rays] or [1], in [0, 1)
        background: wp.array(dtype=vec3),  # [n_rays] or [1], rgb in [0, 1]
        content_distance: wp.array(dtype=real),  # [n_rays] or [1], scene units
        # what render_forward wrote
        rgb: wp.array(dtype=vec3),  # [n_rays]
        transmittance: wp.array(dtype=real),  # [n_rays]
        depth: wp.array(dtype=real),  # [n_rays]
        n_samples: wp.array(dtype=wp.int32),  # [n_rays]
        # what flows back
        adj_rgb: wp.array(dtype=vec3),  # [n_rays]
        adj_opacity: wp.array(dtype=real),  # [n_rays]
        adj_depth: wp.array(dtype=real),  # [n_rays]
        # scratch
        capacity: int,  # of kept, for each worker: 1 in packs, else 0; nothing is kept
        kept: wp.array(dtype=Kept),  # [n_workers * capacity]
        # out
        out_gradient: OutGradient,  # of the grid's values, added to
    ):
        places = take_rays(
            first + wp.tid(), worker, grid, march, origins, directions, contraction, out_gradient
        )
        for place in range(places[0], places[1]):
            i = ray_at(place, worker, out_gradient)
            ray = prepare_ray(
                grid, march, origins[i], directions[i], ray_value(offsets, i), contraction
            )
            total = Integral()
            total.transmittance = transmittance[i]
            total.rgb = rgb[i] - transmittance[i] * ray_value(background, i)
            total.depth = depth[i]
            total.n_samples = n_samples[i]
            adj_integrate(
                grid,
                free,
                march,
                ray,
                total,
                ray_value(background, i),
                adj_rgb[i],
                adj_opacity[i],
                adj_depth[i],
                ray_value(content_distance, i),
                worker * capacity,
                capacity,
                contraction,
                scaling,
                jacobian,
                kept,
                worker,
                out_gradient,
            )
        finish(grid.size, worker, out_gradient)

    return render_backward


@cache
def render_train_kernel(variant: Variant) -> wp.Kernel:
    """Forward, loss and adjoint of a batch in one launch."""
    contraction = variant.contraction
    walk = integral_packed if variant.packed else integral
    integrate, adj_integrate = walk.integrate, walk.adj_integrate
    Kept = kept_type(variant)
    OutGradient = gradient_type(variant)
    scaling = variant.scaling
    jacobian = variant.jacobian

    @wp.kernel(module="unique", enable_backward=False)
    def render_train(
        first: int,  # number of the first thread: a ray's, or where packed a worker's
        worker: int,  # row of kept; owner of a part of the gradient
        # scene
        grid: Grid,
        free: FreeSpace,
        march: March,
        # rays
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        offsets: wp.array(dtype=real),  # [n_rays] or [1], in [0, 1)
        background: wp.array(dtype=vec3),  # [n_rays] or [1], rgb in [0, 1]
        content_distance: wp.array(dtype=real),  # [n_rays] or [1], scene units
        target_rgb: wp.array(dtype=vec3),  # [n_rays] in [0, 1]
        loss_weight: real,  # of one ray
        # scratch
        capacity: int,  # of kept, for each worker: what of a ray is kept between the passes
        kept: wp.array(dtype=Kept),  # [n_workers * capacity]
        # out
        out_error: wp.array(dtype=real),  # [n_rays] squared error
        out_n_samples: wp.array(dtype=wp.int32),  # [n_rays]
        out_gradient: OutGradient,  # of the grid's values, added to
    ):
        places = take_rays(
            first + wp.tid(), worker, grid, march, origins, directions, contraction, out_gradient
        )
        for place in range(places[0], places[1]):
            i = ray_at(place, worker, out_gradient)
            row = worker * capacity
            behind_all = ray_value(background, i)
            ray = prepare_ray(
                grid, march, origins[i], directions[i], ray_value(offsets, i), contraction
            )
            total = integrate(grid, free, march, ray, row, capacity, contraction, kept)
            rgb = total.rgb + total.transmittance * behind_all
            out_error[i] = squared_error(rgb, target_rgb[i])
            out_n_samples[i] = total.n_samples
            adj_integrate(
                grid,
                free,
                march,
                ray,
                total,
                behind_all,
                adj_squared_error(rgb, target_rgb[i], loss_weight),
                real(0.0),
                real(0.0),
                ray_value(content_distance, i),
                row,
                capacity,
                contraction,
                scaling,
                jacobian,
                kept,
                worker,
                out_gradient,
            )
        finish(grid.size, worker, out_gradient)

    return render_train
