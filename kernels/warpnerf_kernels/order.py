"""Which worker of a CPU takes which rays, and in which order.

A batch's rays are random. Walked as they come, each finds the memory that it needs in no cache; so
rays whose middles lie close together follow each other. And the more of a ray goes through the part
of the grid that its worker owns, the less is left for others to add (see parcels.py); so the rays
are shared out along x, to each worker as much work.
"""

from functools import cache

import warp as wp

from .contraction import contract
from .march import prepare_ray, step_edge
from .types import Grid, March, real, vec3
from .vectors import LANES

wp.set_module_options({"enable_backward": False})

RAY = 4
"""What a ray takes besides its packs, in steps."""

BITS = 4
"""Of a cell's index along each axis."""

ACROSS = 1 << BITS
"""Cells along each axis."""

CELLS = ACROSS**3
"""Cells that the grid is divided into, to tell middles of rays apart."""


@wp.func
def cell_at(x: vec3) -> int:
    """The cell that holds a position, [0, 1]^3: its place on a Z-order curve (Morton 1966).

    Bits of its three indices in turn, those of x first; so numbers close by are cells close by.
    """
    cell = int(0)
    for axis in range(3):
        scaled = wp.clamp(x[axis], real(0.0), real(1.0)) * real(wp.static(ACROSS))
        index = wp.min(int(scaled), wp.static(ACROSS - 1))  # 1 lies in the last cell
        for bit in range(wp.static(BITS)):
            cell += ((index >> bit) & 1) << (3 * bit + 2 - axis)
    return cell


@wp.func
def slab_of(cell: int) -> int:
    """A cell's index along x: which slab of cells it lies in."""
    slab = int(0)
    for bit in range(wp.static(BITS)):
        slab += ((cell >> (3 * bit + 2)) & 1) << bit
    return slab


@cache
def measure_rays_kernel(contraction: int) -> wp.Kernel:
    """How much work rays are, and where their middle steps lie."""

    @wp.kernel(module="unique", enable_backward=False)
    def measure_rays(
        first: int,
        grid: Grid,
        march: March,
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        out_work: wp.array(dtype=wp.int32),  # [n_rays] steps in the grid in whole packs, and RAY
        out_cell: wp.array(dtype=wp.int32),  # [n_rays] of the middle step, by cell_at
    ):
        i = first + wp.tid()
        ray = prepare_ray(grid, march, origins[i], directions[i], real(0.0), contraction)
        t = wp.min(step_edge(march, (ray.begin + ray.end) // 2), march.far)
        q = contract(ray.q_origin + t * ray.q_direction, grid.border, contraction)
        u = wp.cw_mul(q, grid.to_nodes) + grid.middle
        # A pack more where the last one is full: a step more or less is a matter of rounding.
        n_packs = (ray.end - ray.begin) // wp.static(LANES) + 1
        out_work[i] = n_packs * wp.static(LANES) + wp.static(RAY)
        out_cell[i] = cell_at(wp.cw_div(u, real(2.0) * grid.middle))

    return measure_rays


@wp.kernel
def share_out(
    begin: int,  # ray to begin with
    end: int,  # after the last one, at most
    most_work: wp.int64,  # that there is room for
    work: wp.array(dtype=wp.int32),  # [n_rays] by measure_rays
    cells: wp.array(dtype=wp.int32),  # [n_rays] by measure_rays
    work_before: wp.array(dtype=wp.int64),  # [ACROSS] scratch
    rays_before: wp.array(dtype=wp.int32),  # [CELLS] scratch
    by_cell: wp.array(dtype=wp.int32),  # [n_rays] scratch
    owners: wp.array(dtype=wp.int32),  # [n_rays] scratch
    out_bounds: wp.array(dtype=wp.int32),  # [n_workers + 1] where in order each worker's begin
    out_order: wp.array(dtype=wp.int32),  # [n_rays] all of the first worker's, of the second's, ...
):
    """Give the workers the next rays by slab, each as much work, and each in the order of cells.

    These are as many as there is room for, but one at least. Rays of a cell keep their order.
    """
    n_workers = out_bounds.shape[0] - 1
    for slab in range(wp.static(ACROSS)):
        work_before[slab] = wp.int64(0)
    for cell in range(wp.static(CELLS)):
        rays_before[cell] = 0
    total = wp.int64(0)
    last = int(begin)
    while last < end and (last == begin or total + wp.int64(work[last]) <= most_work):
        total += wp.int64(work[last])
        work_before[slab_of(cells[last])] += wp.int64(work[last])
        rays_before[cells[last]] += 1
        last += 1
    before = wp.int64(0)
    for slab in range(wp.static(ACROSS)):  # from the work in a slab to that in lower ones
        here = work_before[slab]
        work_before[slab] = before
        before += here
    at = int(begin)
    for cell in range(wp.static(CELLS)):  # from the rays of a cell to where they begin
        n = rays_before[cell]
        rays_before[cell] = at
        at += n
    for i in range(begin, last):
        at = rays_before[cells[i]]
        rays_before[cells[i]] = at + 1
        by_cell[at] = i
    out_bounds[0] = begin
    for w in range(n_workers):
        out_bounds[w + 1] = 0
    for place in range(begin, last):
        i = by_cell[place]
        slab = slab_of(cells[i])
        before = work_before[slab]
        work_before[slab] = before + wp.int64(work[i])
        owners[place] = int(before * wp.int64(n_workers) // total)
        out_bounds[owners[place] + 1] += 1  # counts a worker's rays
    at = int(begin)
    for w in range(n_workers):
        n = out_bounds[w + 1]
        out_bounds[w + 1] = at  # where its next ray goes
        at += n
    for place in range(begin, last):
        at = out_bounds[owners[place] + 1]
        out_bounds[owners[place] + 1] = at + 1
        out_order[at] = by_cell[place]
