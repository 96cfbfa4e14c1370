"""walk.py for the CPU: the same walk, a pack of sixteen steps at a time.

A worker has some rays in hand, one or a batch whose rows the head shades together. Of each it keeps
packs between the two passes, as many as there is room for; the others are made again.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.parts import Encoding, Head, Sampler
from ..base.simd import LANES, lanes
from ..base.types import Box, Density, FreeSpace, Ray
from ..cpu.scatter import deferred_type
from ..sampling.traversal import locate_pack, traversal
from .gradscale import distance_scale
from .pack import adj_composite, composite, pack_type, row_type, weigh
from .walk import behind_limit

wp.set_module_options({"enable_backward": False})


@cache
def walk_packs(sampler: Sampler, encoding: Encoding, head: Head) -> SimpleNamespace:
    """The two passes for a model's parts.

    Returns:
        integrate, adj_integrate, and what they keep: Pack, Row; and Deferred, what they add to.
    """
    Steps, Field, Params = sampler.Params, encoding.Params, head.Params
    Pack, Row = pack_type(encoding, head), row_type(head)
    Deferred = deferred_type(encoding)
    Channels = wp.types.vector(head.n_channels, wp.float32)
    next_sample = traversal(sampler).next_sample
    edge, place_pack = sampler.edge, sampler.place_pack
    read_pack, adj_read_pack = encoding.read_pack, encoding.adj_read_pack
    decode_pack, adj_decode_pack = head.decode_pack, head.adj_decode_pack
    n_packs = head.n_packs
    prepare_row, adj_prepare_row = head.prepare_row, head.adj_prepare_row

    @wp.func
    def next_pack(
        box: Box,
        free: FreeSpace,
        march: Steps,
        field: Field,
        density: Density,
        ray: Ray,
        first: int,  # step to begin looking at
        dense: bool,  # the step before it is a sample, so that this one is likely to be
        transmittance: float,  # of what lies before
        contraction: int,
        packs: wp.array(dtype=Pack),  # written
        slot: int,
    ) -> int:
        """Fill a pack with sixteen steps from the next one worth a look; the step after them.

        That is ray.end where nothing is left, or not enough light. Free space is passed over as in
        the scalar walk.
        """
        step = first
        if not dense:
            step = next_sample(box, free, march, ray, first, contraction).step
        place_pack(march, ray, step, packs, slot)
        locate_pack(box, free, ray, contraction, packs, slot)
        read_pack(field, ray, packs, slot)
        weigh(density, transmittance, march.transmittance_min, packs, slot)
        if packs[slot].passed < march.transmittance_min:
            return ray.end
        return wp.min(step + LANES, ray.end)

    @wp.func
    def integrate(
        box: Box,
        free: FreeSpace,
        march: Steps,
        field: Field,
        density: Density,
        params: Params,
        rows: wp.array(dtype=Row),
        row: int,  # whose ray is given, and what it gathers written
        contraction: int,
        packs: wp.array(dtype=Pack),  # written
        begin: int,  # first slot that is free
        end: int,  # one past the last; all packs that do not fit share that one
    ) -> int:
        """walk.integrate, a pack at a time. Returns the first slot that is still free."""
        prepare_row(params, rows, row)
        ray = rows[row].ray
        channels = Channels()
        depth = float(0.0)
        transmittance = float(1.0)
        n_samples = int(0)
        step = int(ray.begin)
        n = int(0)  # packs so far
        dense = bool(False)
        while step < ray.end:
            first = wp.min(begin + n, end - 1)
            last = wp.min(first + n_packs, end)
            slot = int(first)
            while slot < last and step < ray.end:
                step = next_pack(
                    box,
                    free,
                    march,
                    field,
                    density,
                    ray,
                    step,
                    dense,
                    transmittance,
                    contraction,
                    packs,
                    slot,
                )
                dense = packs[slot].visited[LANES - 1] != 0
                transmittance = packs[slot].passed
                n_samples += packs[slot].n_samples
                slot += 1
            decode_pack(params, rows, row, packs, first, slot - first)
            for k in range(first, slot):
                composite(packs, k)
                channels += packs[k].sums
                depth += packs[k].depth
            n += slot - first
        rows[row].channels = channels
        rows[row].depth = depth
        rows[row].transmittance = transmittance
        rows[row].n_samples = n_samples
        rows[row].slot = begin
        return wp.min(begin + n, end - 1)

    @wp.func
    def adj_integrate(
        box: Box,
        free: FreeSpace,
        march: Steps,
        field: Field,
        density: Density,
        params: Params,
        rows: wp.array(dtype=Row),
        row: int,  # as integrate left it, with what flows back to its channels
        adj_transmittance: float,  # of what passes all samples
        adj_depth: float,
        content_distance: float,
        contraction: int,
        scaling: int,
        jacobian: int,
        packs: wp.array(dtype=Pack),  # as integrate left it
        end: int,  # one past the last slot
        worker: int,
        deferred: Deferred,  # added to, and what is in it
    ):
        """walk.adj_integrate, a pack at a time; those that shared the last slot are made again.

        What it has for other workers' parts of the field it leaves in records.
        """
        ray = rows[row].ray
        begin = rows[row].slot
        adj_channels = rows[row].adj_channels
        behind = (
            wp.dot(adj_channels, rows[row].channels)
            + adj_depth * rows[row].depth
            + adj_transmittance * rows[row].transmittance
        )
        limit = behind_limit(
            adj_transmittance, adj_channels, adj_depth * edge(march, ray.end), float(0.0)
        )
        transmittance = float(1.0)
        step = int(ray.begin)
        n = int(0)
        dense = bool(False)
        n_samples = int(0)
        while n_samples < rows[row].n_samples and step < ray.end:
            first = wp.min(begin + n, end - 1)
            last = wp.min(first + n_packs, end)
            slot = int(first)
            while slot < last and n_samples < rows[row].n_samples and step < ray.end:
                if slot == end - 1:
                    if slot > first:
                        last = slot  # it is made again, for itself
                    else:
                        step = next_pack(
                            box,
                            free,
                            march,
                            field,
                            density,
                            ray,
                            step,
                            dense,
                            transmittance,
                            contraction,
                            packs,
                            slot,
                        )
                        decode_pack(params, rows, row, packs, slot, 1)
                else:
                    step = packs[slot].step + LANES
                if slot < last:
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
                    adj_composite(adj_depth, behind, limit, rows, row, packs, slot)
                    behind = packs[slot].behind
                    slot += 1
            adj_decode_pack(
                params, rows, row, packs, first, slot - first, worker, deferred.gradient
            )
            for k in range(first, slot):
                later = wp.min(k + 2, end - 1)
                adj_read_pack(field, packs, k, later, worker, deferred)
            n += slot - first
        adj_prepare_row(params, rows, row, worker, deferred.gradient)

    return SimpleNamespace(
        integrate=integrate, adj_integrate=adj_integrate, Pack=Pack, Row=Row, Deferred=Deferred
    )
