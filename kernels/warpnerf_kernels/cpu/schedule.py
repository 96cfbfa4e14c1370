"""Ray scheduling on the CPU: which worker takes which rays, and in which order.

A batch's rays are random. Walked as they come, each finds the memory that it needs in no cache; so
rays whose middles lie close together follow each other. And the more of a ray goes through the part
of the field that its worker owns, the less is left for others to add (see scatter.py); so the rays
are shared out along x, to each worker as much work.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.parts import Encoding, Sampler, Space
from ..base.simd import LANES
from ..base.types import Box, real, vec3
from ..cpu.barrier import wait_for_all
from ..sampling.traversal import traversal

wp.set_module_options({"enable_backward": False})

RAY = 4
"""What a ray takes besides its packs, in steps."""

BITS = 4
"""Of a cell's index along each axis."""

ACROSS = 1 << BITS
"""Cells along each axis."""

CELLS = ACROSS**3
"""Cells that the field is divided into, to tell middles of rays apart."""


@wp.struct
class Chunk:
    """The rays of a batch that are processed together: as many as there is room for."""

    begin: int  # ray to begin with
    end: int  # after the last one of the batch
    most_work: wp.int64  # that there is room for
    work: wp.array(dtype=wp.int32)  # [n_rays] steps in the grid in whole packs, and RAY
    cells: wp.array(dtype=wp.int32)  # [n_rays] of the middle step, by cell_at
    next: wp.array(dtype=wp.int32)  # [1] ray that the next chunk begins with
    # In a row for each worker:
    work_before: wp.array2d(dtype=wp.int64)  # [n_workers, ACROSS] scratch
    rays_before: wp.array2d(dtype=wp.int32)  # [n_workers, CELLS] scratch
    candidates: wp.array2d(dtype=wp.int32)  # [n_workers, n_rays] scratch: its rays as they come
    rays: wp.array2d(dtype=wp.int32)  # [n_workers, n_rays] its rays by cell
    barrier: wp.array(dtype=wp.int32)  # of the workers


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


@wp.func
def select_rays(worker: int, chunk: Chunk) -> int:
    """Put a worker's rays of the chunk into its row, in the order of cells; how many they are.

    The chunk's are the next ones, as many as there is room for, but one at least. One slab after
    the other, they are divided so that each worker has as much work, which is not 0 for any ray.
    Rays of a slab, and a worker's rays of a cell, keep their order. Each worker does this for
    itself, so that none waits for another. Written: its rows, and by worker 0 where the next chunk
    begins.
    """
    n_workers = chunk.rays.shape[0]
    for slab in range(wp.static(ACROSS)):
        chunk.work_before[worker, slab] = wp.int64(0)
    total = wp.int64(0)
    last = int(chunk.begin)
    while last < chunk.end and (
        last == chunk.begin or total + wp.int64(chunk.work[last]) <= chunk.most_work
    ):
        total += wp.int64(chunk.work[last])
        chunk.work_before[worker, slab_of(chunk.cells[last])] += wp.int64(chunk.work[last])
        last += 1
    if worker == 0:
        chunk.next[0] = last
    before = wp.int64(0)
    for slab in range(wp.static(ACROSS)):  # from the work in a slab to that in lower ones
        here = chunk.work_before[worker, slab]
        chunk.work_before[worker, slab] = before
        before += here
    for cell in range(wp.static(CELLS)):
        chunk.rays_before[worker, cell] = 0
    n_candidates = int(0)
    for i in range(chunk.begin, last):
        cell = chunk.cells[i]
        slab = slab_of(cell)
        before = chunk.work_before[worker, slab]
        chunk.work_before[worker, slab] = before + wp.int64(chunk.work[i])
        # A ray is that of worker n_workers * before // total.
        beyond = wp.int64(n_workers) * before - wp.int64(worker) * total
        if beyond >= wp.int64(0) and beyond < total:
            chunk.candidates[worker, n_candidates] = i
            n_candidates += 1
            chunk.rays_before[worker, cell] += 1
    place = int(0)
    for cell in range(wp.static(CELLS)):  # from the rays of a cell to where they begin
        n = chunk.rays_before[worker, cell]
        chunk.rays_before[worker, cell] = place
        place += n
    for k in range(n_candidates):
        i = chunk.candidates[worker, k]
        place = chunk.rays_before[worker, chunk.cells[i]]
        chunk.rays_before[worker, chunk.cells[i]] = place + 1
        chunk.rays[worker, place] = i
    return n_candidates


@cache
def ray_schedule(sampler: Sampler, encoding: Encoding, space: Space) -> SimpleNamespace:
    """The functions that look at rays: measure_ray, and assign_rays that uses it.

    Args:
        sampler: Where steps lie.
        encoding: Which place of the field a position has.
        space: What position a place has.
    """
    Steps, Field = sampler.Params, encoding.Params
    edge, place_in_field = sampler.edge, encoding.place
    prepare_ray, contract = traversal(sampler, space).prepare_ray, space.contract

    @wp.func
    def measure_ray(
        i: int,
        box: Box,
        march: Steps,
        field: Field,
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
        chunk: Chunk,  # its work and cells are written
    ):
        """How much work a ray is, and where its middle step lies."""
        ray = prepare_ray(box, march, i, origins[i], directions[i], real(0.0))
        t = wp.min(edge(march, ray, (ray.begin + ray.end) // 2), march.far)
        c = contract(box, ray.q_origin + t * ray.q_direction)
        # A pack more where the last one is full: a step more or less depends on rounding.
        n_packs = (ray.end - ray.begin) // wp.static(LANES) + 1
        chunk.work[i] = n_packs * wp.static(LANES) + wp.static(RAY)
        chunk.cells[i] = cell_at(place_in_field(field, c))

    @wp.func
    def assign_rays(
        worker: int,
        chunk: Chunk,
        box: Box,
        march: Steps,
        field: Field,
        origins: wp.array(dtype=vec3),  # [n_rays] scene units
        directions: wp.array(dtype=vec3),  # [n_rays] unit vectors
    ) -> int:
        """select_rays, once all rays are measured; 0 where a worker never came.

        All workers call it at the same time. A batch's rays are measured in its first chunk.
        """
        n_workers = chunk.rays.shape[0]
        if chunk.begin == 0:
            n = wp.int64(chunk.end)
            until = int(n * wp.int64(worker + 1) // wp.int64(n_workers))
            for i in range(int(n * wp.int64(worker) // wp.int64(n_workers)), until):
                measure_ray(i, box, march, field, origins, directions, chunk)
            if not wait_for_all(chunk.barrier, n_workers):
                return 0
        return select_rays(worker, chunk)

    return SimpleNamespace(measure_ray=measure_ray, assign_rays=assign_rays)
