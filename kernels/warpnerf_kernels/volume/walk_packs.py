"""walk.py for the CPU: the same walk, a pack of sixteen steps at a time.

A worker has some rays in hand, one or a batch whose rows the head shades together. Of each it keeps
packs between the two passes, as many as there is room for: the last slots, as many as are decoded
together, are for packs that are not kept, and are made again.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.parts import Encoding, Head, Losses, Sampler
from ..base.simd import LANES, lanes
from ..base.types import Ray
from ..cpu.scatter import sink_type
from ..sampling.traversal import distance_of, locate_pack, measure_pack, traversal
from .gradscale import scale_pack
from .pack import compositing, pack_type, row_type, weigh
from .ray_loss import NONE, vector_form
from .sample_loss import ColourSums
from .scene import scene_type
from .walk import behind_limit

wp.set_module_options({"enable_backward": False})


@cache
def walk_packs(sampler: Sampler, encoding: Encoding, head: Head, losses: Losses) -> SimpleNamespace:
    """The two passes for a model's parts.

    Returns:
        integrate, adj_integrate, and what they keep: Pack, Row; and Sink, what they add to.
    """
    Scene = scene_type(sampler, encoding, head, losses)
    loss, on_samples = losses.on_ray, losses.on_samples
    own, of_head = encoding.vectors, head.vectors
    Pack, Row = pack_type(encoding, head, losses), row_type(head, losses)
    Sink = sink_type(encoding)
    Channels = wp.types.vector(head.n_channels, wp.float32)
    next_sample = traversal(sampler).next_sample
    edge, place_pack = sampler.edge, sampler.place_pack
    read_pack, adj_read_pack, fetch_pack = own.read_pack, own.adj_read_pack, own.fetch_pack
    decode_pack = of_head.decode_pack
    adj_decode_pack = (
        of_head.adj_decode_pack_with_colours if on_samples else of_head.adj_decode_pack
    )
    n_packs = of_head.n_packs
    prepare_row, adj_prepare_row = of_head.prepare_row, of_head.adj_prepare_row
    composite, adj_composite = compositing(head, losses)
    has_loss, State = loss is not NONE, loss.State
    weighted, loss_bound, adj_light = loss.weighted, loss.bound, loss.adj_transmittance
    of_light, of_density = adj_light is not None, loss.adj_density is not None
    add_pack, adj_add_pack = vector_form(loss)[:2]

    @wp.func
    def next_pack(
        scene: Scene,
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
            step = next_sample(scene.box, scene.free, scene.march, ray, first, contraction).step
        place_pack(scene.march, ray, step, packs, slot)
        locate_pack(scene.box, scene.free, ray, contraction, packs, slot)
        read_pack(scene.field, ray, packs, slot)
        weigh(scene.density, transmittance, scene.march.transmittance_min, packs, slot)
        if packs[slot].passed < scene.march.transmittance_min:
            return ray.end
        return wp.min(step + LANES, ray.end)

    @wp.func
    def integrate(
        scene: Scene,
        rows: wp.array(dtype=Row),
        row: int,  # whose ray is given, and what it gathers written
        contraction: int,
        packs: wp.array(dtype=Pack),  # written
        begin: int,  # first slot that is free
        end: int,  # one past the last
    ) -> int:
        """walk.integrate, a pack at a time. Returns the first slot that is still free."""
        prepare_row(scene.head, rows, row)
        ray = rows[row].ray
        channels = Channels()
        state = State()
        of_samples = ColourSums()
        depth = float(0.0)
        transmittance = float(1.0)
        n_samples = int(0)
        step = int(ray.begin)
        n = int(0)  # packs so far
        dense = bool(False)
        while step < ray.end:
            first = wp.min(begin + n, end - n_packs)
            slot = int(first)
            while slot < first + n_packs and step < ray.end:
                step = next_pack(
                    scene,
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
            decode_pack(scene.head, rows, row, packs, first, slot - first)
            for k in range(first, slot):
                composite(packs, k)
                channels += packs[k].sums
                depth += packs[k].depth
                if wp.static(has_loss):
                    measure_pack(ray, contraction, packs, k)
                    state = add_pack(scene.loss.on_ray, state, packs, k)
                if wp.static(on_samples):
                    of_samples.weight += packs[k].of_samples[0]
                    of_samples.square += packs[k].of_samples[1]
            n += slot - first
        rows[row].channels = channels
        rows[row].depth = depth
        rows[row].transmittance = transmittance
        rows[row].n_samples = n_samples
        rows[row].slot = begin
        if wp.static(has_loss):
            rows[row].loss = state
        if wp.static(on_samples):
            rows[row].of_samples = of_samples
        return wp.min(begin + n, end - n_packs)

    @wp.func
    def adj_integrate(
        scene: Scene,
        rows: wp.array(dtype=Row),
        row: int,  # as integrate left it, with what flows back to its channels
        adj_transmittance: float,  # of what passes all samples
        adj_depth: float,
        adj_loss_value: float,  # of the loss on the ray
        content_distance: float,
        contraction: int,
        scaling: int,
        jacobian: int,
        packs: wp.array(dtype=Pack),  # as integrate left it
        end: int,  # one past the last slot
        worker: int,
        sink: Sink,  # added to, and what is in it
    ):
        """walk.adj_integrate, a pack at a time; those that were not kept are made again.

        What it has for other workers' parts of the field it leaves in records.
        """
        ray = rows[row].ray
        begin = rows[row].slot
        adj_channels = rows[row].adj_channels
        on_ray = scene.loss.on_ray
        adj_end = adj_transmittance
        if wp.static(of_light):
            adj_end += adj_loss_value * adj_light(on_ray, rows[row].transmittance)
        behind = (
            wp.dot(adj_channels, rows[row].channels)
            + adj_depth * rows[row].depth
            + adj_end * rows[row].transmittance
        )
        of_loss = float(0.0)
        far_end = distance_of(ray, edge(scene.march, ray, ray.end), contraction)
        if wp.static(has_loss):
            behind += adj_loss_value * weighted(on_ray, rows[row].loss)
            of_loss = adj_loss_value * loss_bound(on_ray, rows[row].loss, far_end)
        if wp.static(on_samples):
            rows[row].sample_slope = 2.0 * scene.loss.on_samples * adj_loss_value
        limit = behind_limit(adj_end, adj_channels, adj_depth * far_end, of_loss)
        before = State()
        short = rows[row].n_samples < 4 * LANES  # else adj_read_pack asks for all but the first
        transmittance = float(1.0)
        step = int(ray.begin)
        n = int(0)
        dense = bool(False)
        n_samples = int(0)
        while n_samples < rows[row].n_samples and step < ray.end:
            first = wp.min(begin + n, end - n_packs)
            kept = first < end - n_packs
            last = wp.min(first + n_packs, end - n_packs)
            slot = int(first)
            if not kept:
                while slot < end and step < ray.end:
                    step = next_pack(
                        scene, ray, step, dense, transmittance, contraction, packs, slot
                    )
                    dense = packs[slot].visited[LANES - 1] != 0
                    transmittance = packs[slot].passed
                    slot += 1
                decode_pack(scene.head, rows, row, packs, first, slot - first)
                last = slot
                slot = first
            while slot < last and n_samples < rows[row].n_samples:
                if kept:
                    step = packs[slot].step + LANES
                    dense = packs[slot].visited[LANES - 1] != 0
                    transmittance = packs[slot].passed
                n_samples += packs[slot].n_samples
                scale_pack(content_distance, scaling, jacobian, packs, slot)
                if short and n + slot - first < n_packs:
                    fetch_pack(scene.field, packs, slot, worker, sink)
                if wp.static(has_loss):
                    if not kept:
                        measure_pack(ray, contraction, packs, slot)
                    packs[slot].adj_weight = lanes()
                    if wp.static(of_density):
                        packs[slot].adj_density = lanes()
                    before = adj_add_pack(
                        on_ray, rows[row].loss, before, adj_loss_value, packs, slot
                    )
                adj_composite(adj_depth, behind, limit, rows, row, packs, slot)
                behind = packs[slot].behind
                slot += 1
            adj_decode_pack(
                scene.head, rows, row, packs, first, slot - first, worker, sink.gradient
            )
            for k in range(first, slot):
                later = wp.min(k + 1, end - 1)
                adj_read_pack(scene.field, packs, k, later, worker, sink)
            n += slot - first
        adj_prepare_row(scene.head, rows, row, worker, sink.gradient)

    return SimpleNamespace(
        integrate=integrate, adj_integrate=adj_integrate, Pack=Pack, Row=Row, Sink=Sink
    )
