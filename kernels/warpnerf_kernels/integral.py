"""The volume rendering integral along a ray, and its adjoint: one walk, two passes.

The forward pass composites samples front to back; the backward pass walks the same samples and
needs of the rest of the ray only what lies behind: it starts with that, and sheds it on its way.
Both get their samples from ``next_sample``, the one place that decides where a ray is sampled.

This is the specification, a sample at a time. integral_packed.py does the same, sixteen at a time.
"""

import warp as wp

from .activation import (
    adj_sigmoid,
    adj_softplus,
    opacity_of,
    sigmoid,
    softplus,
    softplus_slope,
)
from .contraction import NONE, contract, det_jacobian_of
from .gradscale import distance_scale
from .interp import adj_gather, flat_index, gather, lowest_node
from .march import (
    free_distance,
    free_length,
    step_after,
    step_edge,
    step_length,
)
from .types import FreeSpace, Gradient, Grid, Integral, March, Ray, Sample, real, vec3, vec4

wp.set_module_options({"enable_backward": False})


@wp.func
def shade(grid: Grid, sample: Sample) -> Sample:
    """Read the grid at a sample: density and colour."""
    raw = gather(grid.values, grid.size, sample.base, sample.fraction)
    raw_density = raw[0] + grid.density_shift
    sample.sigma = grid.density_scale * softplus(raw_density)
    sample.sigma_slope = grid.density_scale * softplus_slope(raw_density)
    sample.attenuation = wp.exp(-sample.sigma * sample.dt)
    sample.rgb = sigmoid(vec3(raw[1], raw[2], raw[3]))
    return sample


@wp.func
def adj_shade(
    grid: Grid,
    sample: Sample,
    adj_sigma: real,
    adj_rgb: vec3,
    gradient: Gradient,  # added to
):
    """Hand the gradients of a sample's density and colour to the nodes around it."""
    adj_density = adj_softplus(sample.sigma_slope, adj_sigma)
    adj_raw = adj_sigmoid(sample.rgb, adj_rgb)
    adj_gather(
        grid.size,
        sample.base,
        sample.fraction,
        vec4(adj_density, adj_raw[0], adj_raw[1], adj_raw[2]),
        gradient,
    )


@wp.func
def next_sample(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    first: int,  # step to begin looking at
    contraction: int,
) -> Sample:
    """The first sample at or after step `first` that is in the box and not in free space.

    Its step is ray.end where there is none.
    """
    sample = Sample()
    sample.step = ray.end
    step = int(first)
    while step < ray.end:
        t0 = step_edge(march, step)
        dt = step_length(march, step)
        t = t0 + ray.offset * dt
        if t >= march.far:
            return sample
        q = ray.q_origin + t * ray.q_direction
        inside = (
            wp.abs(q[0]) <= real(1.0) and wp.abs(q[1]) <= real(1.0) and wp.abs(q[2]) <= real(1.0)
        )
        if inside or contraction != NONE:
            c = contract(q, grid.border, contraction)
            m = wp.cw_mul(c, free.to_cells) + real(0.5) * vec3(
                real(free.size[0]), real(free.size[1]), real(free.size[2])
            )
            distance = free_distance(free, m)
            if distance == 0:
                u = wp.cw_mul(c, grid.to_nodes) + grid.middle
                node = lowest_node(u, grid.size)
                sample.step = step
                sample.t = t
                sample.dt = dt
                sample.det_jacobian = det_jacobian_of(q, grid.border, contraction)
                sample.base = flat_index(node[0], node[1], node[2], grid.size)
                sample.fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
                return sample
            step = step_after(
                march, ray, t + free_length(free, ray, m, distance, contraction), step
            )
        else:
            step += 1
    return sample


@wp.func
def behind_limit(
    march: March, ray: Ray, adj_transmittance: real, adj_rgb: vec3, adj_depth: real
) -> real:
    """How much what lies behind a sample can be, for each unit of light that gets there.

    It is a sum over weights that add up to that light. Shed by subtraction it keeps a rest of
    rounding, which behind an opaque surface would be all there is; this bound removes it.
    """
    of_rgb = wp.abs(adj_rgb[0]) + wp.abs(adj_rgb[1]) + wp.abs(adj_rgb[2])
    of_depth = wp.abs(adj_depth) * step_edge(march, ray.end)
    return wp.max(wp.abs(adj_transmittance), of_rgb + of_depth)


@wp.func
def integrate(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    row: int,  # first entry of this ray's samples in `kept`
    capacity: int,  # how many samples of a ray are kept
    contraction: int,
    kept: wp.array(dtype=Sample),  # written
) -> Integral:
    """Composite a ray's samples front to back: rgb = sum_i T_i alpha_i c_i."""
    total = Integral()
    total.transmittance = real(1.0)
    step = int(ray.begin)
    while step < ray.end:
        sample = next_sample(grid, free, march, ray, step, contraction)
        step = sample.step + 1
        if sample.step < ray.end:
            sample = shade(grid, sample)
            if total.n_samples < capacity:
                kept[row + total.n_samples] = sample
            total.n_samples += 1
            weight = total.transmittance * opacity_of(sample.sigma * sample.dt, sample.attenuation)
            total.rgb += weight * sample.rgb
            total.depth += weight * sample.t
            total.transmittance *= sample.attenuation
            if total.transmittance < march.transmittance_min:
                step = ray.end
    return total


@wp.func
def adj_integrate(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    total: Integral,
    background: vec3,
    adj_rgb: vec3,  # of the colour, background included
    adj_opacity: real,
    adj_depth: real,
    content_distance: real,
    row: int,
    capacity: int,
    contraction: int,
    scaling: int,
    jacobian: int,
    kept: wp.array(dtype=Sample),  # read, as integrate left it
    worker: int,  # not used: all add to one gradient, on the CPU from one thread at a time
    gradient: Gradient,  # added to
):
    """Adjoint of integrate. With G_i = dL/dw_i = <adj_rgb, c_i> + adj_depth t_i,

    dL/dsigma_i = dt_i (T_{i+1} G_i - sum_{j>i} w_j G_j - T_end dL/dT_end),   dL/dc_i = w_i adj_rgb,

    both multiplied by the distance scaling. The two sums are what lies behind sample i.
    """
    adj_transmittance = wp.dot(adj_rgb, background) - adj_opacity
    behind = (
        wp.dot(adj_rgb, total.rgb)
        + adj_depth * total.depth
        + adj_transmittance * total.transmittance
    )
    limit = behind_limit(march, ray, adj_transmittance, adj_rgb, adj_depth)
    transmittance = real(1.0)
    step = int(ray.begin)
    for n in range(total.n_samples):
        sample = Sample()
        if n < capacity:
            sample = kept[row + n]
        else:
            sample = shade(grid, next_sample(grid, free, march, ray, step, contraction))
        step = sample.step + 1
        weight = transmittance * opacity_of(sample.sigma * sample.dt, sample.attenuation)
        transmittance *= sample.attenuation
        adj_weight = wp.dot(adj_rgb, sample.rgb) + adj_depth * sample.t
        behind = wp.clamp(
            behind - weight * adj_weight, -limit * transmittance, limit * transmittance
        )
        scale = distance_scale(sample.t, content_distance, sample.det_jacobian, scaling, jacobian)
        adj_sigma = scale * (sample.dt * (transmittance * adj_weight - behind))
        adj_sample_rgb = scale * (weight * adj_rgb)
        adj_shade(grid, sample, adj_sigma, adj_sample_rgb, gradient)
