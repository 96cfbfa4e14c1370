"""integral.py for the CPU: the same walk, a pack of sixteen steps at a time."""

import warp as wp

from .gradscale import distance_scale
from .integral import behind_limit, next_sample
from .march import step_edge
from .packs import Pack, adj_composite, composite, place, shade
from .parcels import Parcels, hand_out
from .types import FreeSpace, Grid, Integral, March, Ray, real, vec3
from .vectors import LANES, lanes

wp.set_module_options({"enable_backward": False})


@wp.func
def next_pack(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    first: int,  # step to begin looking at
    dense: bool,  # the step before it is a sample, so that this one is likely to be
    transmittance: float,  # of what lies before
    contraction: int,
    packs: wp.array(dtype=Pack),  # written
    slot: int,
) -> int:
    """Fill a pack with sixteen steps from the next one worth a look; returns the step after them.

    That is ray.end where nothing is left, or not enough light. Free space is passed over as in the
    plain walk.
    """
    step = first
    if not dense:
        step = next_sample(grid, free, march, ray, first, contraction).step
    place(
        grid,
        free,
        march,
        ray,
        step,
        step_edge(march, wp.max(step, march.n_linear)),
        contraction,
        packs,
        slot,
    )
    shade(grid, packs, slot)
    composite(transmittance, march.transmittance_min, packs, slot)
    if packs[slot].passed < march.transmittance_min:
        return ray.end
    return wp.min(step + LANES, ray.end)


@wp.func
def integrate(
    grid: Grid,
    free: FreeSpace,
    march: March,
    ray: Ray,
    row: int,  # first slot of this worker
    capacity: int,  # its slots; all packs that do not fit share the last one
    contraction: int,
    packs: wp.array(dtype=Pack),  # [n_workers * capacity] written
) -> Integral:
    """integral.integrate, a pack at a time."""
    total = Integral()
    total.transmittance = real(1.0)
    step = int(ray.begin)
    n = int(0)
    dense = bool(False)
    while step < ray.end:
        slot = row + wp.min(n, capacity - 1)
        step = next_pack(
            grid, free, march, ray, step, dense, total.transmittance, contraction, packs, slot
        )
        n += 1
        dense = packs[slot].visited[LANES - 1] != 0
        integral = packs[slot].integral
        total.rgb += vec3(integral[0], integral[1], integral[2])
        total.depth += integral[3]
        total.transmittance = packs[slot].passed
        total.n_samples += packs[slot].n_samples
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
    packs: wp.array(dtype=Pack),  # as integrate left it
    worker: int,
    parcels: Parcels,  # added to, and what is in it
):
    """integral.adj_integrate, a pack at a time; those that shared the last slot are made again.

    What it has for other workers' parts of the grid it leaves in parcels.
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
    n = int(0)
    dense = bool(False)
    n_samples = int(0)
    while n_samples < total.n_samples and step < ray.end:
        slot = row + wp.min(n, capacity - 1)
        if n >= capacity - 1:
            step = next_pack(
                grid, free, march, ray, step, dense, transmittance, contraction, packs, slot
            )
        else:
            step = packs[slot].step + LANES
        n += 1
        dense = packs[slot].visited[LANES - 1] != 0
        n_samples += packs[slot].n_samples
        transmittance = packs[slot].passed
        t = packs[slot].t
        det_jacobian = packs[slot].det_jacobian
        scale = lanes()
        for lane in range(LANES):
            scale[lane] = distance_scale(
                t[lane], content_distance, det_jacobian[lane], scaling, jacobian
            )
        packs[slot].scale = scale
        adj_composite(adj_rgb, adj_depth, behind, limit, packs, slot)
        behind = packs[slot].behind
        later = row + wp.min(n + 1, capacity - 1)
        hand_out(grid.size, packs, slot, later, worker, parcels)
