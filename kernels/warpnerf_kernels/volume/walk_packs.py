"""SIMD volume rendering for the CPU: walk.py's walk, a pack of sixteen steps at a time.

A worker processes some rays at a time, one or a batch whose rows the head shades together. Of each
it keeps packs between the two passes, as many as there is room for: the last slots, as many as are
decoded together, are for packs that are not kept, and are recomputed.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.simd import LANES, lanes
from ..base.types import Ray
from ..cpu.scatter import sink_type
from ..sampling.traversal import pack_traversal, traversal
from .gradscale import scale_pack
from .pack import compositing, pack_type, ray_state_type, weigh
from .ray_loss import NONE, vector_form
from .render_params import render_params_type
from .sample_loss import NO_SAMPLE_LOSS, lanes_form
from .variant import Variant
from .walk import adjoint_type, suffix_limit

wp.set_module_options({"enable_backward": False})


@cache
def walk_packs(variant: Variant) -> SimpleNamespace:
    """The two passes of a variant.

    Returns:
        integrate, adj_integrate, and what they keep: Pack, RayState; RayAdjoint, which is in a row;
        and Sink, what they add to.
    """
    head, encoding, sampler, losses = variant.parts
    space, scaling, jacobian = variant.space, variant.scaling, variant.jacobian
    RenderParams = render_params_type(sampler, encoding, head, losses)
    loss, on_samples = losses.on_ray, losses.on_samples
    own, of_head = encoding.vectors, head.vectors
    Pack, RayState = pack_type(encoding, head, losses), ray_state_type(head, losses)
    Sink = sink_type(encoding)
    Channels = wp.types.vector(head.n_channels, wp.float32)
    next_sample = traversal(sampler, space).next_sample
    placed, distance_of = pack_traversal(space), space.distance_of
    locate_pack, measure_pack = placed.locate_pack, placed.measure_pack
    edge, place_pack = sampler.edge, sampler.place_pack
    keeps, keep_pack = sampler.keep is not None, sampler.keep_pack
    read_pack, adj_read_pack, prefetch_gradient = (
        own.read_pack,
        own.adj_read_pack,
        own.prefetch_gradient,
    )
    has_sample_loss, OfSamples = on_samples is not NO_SAMPLE_LOSS, on_samples.State
    add_samples, adj_add_samples = lanes_form(on_samples, head.n_channels)[:2]
    decode_pack, adj_decode_pack = of_head.decode_pack, of_head.adj_decode_pack(has_sample_loss)
    n_packs = of_head.n_packs
    prepare_row, adj_prepare_row = of_head.prepare_row, of_head.adj_prepare_row
    composite, adj_composite = compositing(head, losses)
    has_loss, State = loss is not NONE, loss.State
    weighted, loss_bound, adj_light = loss.weighted, loss.bound, loss.adj_transmittance
    of_light, of_density = adj_light is not None, loss.adj_density is not None
    add_pack, adj_add_pack = vector_form(loss)[:2]

    @wp.func
    def next_pack(
        scene: RenderParams,
        ray: Ray,
        first: int,  # step to begin looking at
        contiguous: bool,  # the step before it is a sample, so that this one is likely to be
        transmittance: float,  # of what lies before
        packs: wp.array(dtype=Pack),  # written
        slot: int,
    ) -> int:
        """Fill a pack with sixteen steps from the next one worth a look; the step after them.

        That is ray.end where nothing is left, or not enough light. Free space is skipped as in
        the scalar walk.
        """
        step = first
        if not contiguous:
            step = next_sample(scene.box, scene.free, scene.march, ray, first).step
        place_pack(scene.march, ray, step, packs, slot)
        locate_pack(scene.box, scene.free, ray, packs, slot)
        read_pack(scene.field, ray, packs, slot)
        weigh(scene.density, transmittance, scene.march.transmittance_min, packs, slot)
        if packs[slot].transmittance_out < scene.march.transmittance_min:
            return ray.end
        return wp.min(step + LANES, ray.end)

    @wp.func
    def integrate(
        scene: RenderParams,
        rows: wp.array(dtype=RayState),
        row: int,  # whose ray and target_rgb are given, and what it gathers written
        packs: wp.array(dtype=Pack),  # written
        begin: int,  # first slot that is free
        end: int,  # one past the last
    ) -> int:
        """walk.integrate, a pack at a time. Returns the first slot that is still free."""
        prepare_row(scene.head, rows, row)
        ray = rows[row].ray
        channels = Channels()
        state = State()
        of_samples = OfSamples()
        depth = float(0.0)
        transmittance = float(1.0)
        n_samples = int(0)
        step = int(ray.begin)
        n = int(0)  # packs so far
        contiguous = bool(False)
        while step < ray.end:
            first = wp.min(begin + n, end - n_packs)
            slot = int(first)
            while slot < first + n_packs and step < ray.end:
                step = next_pack(
                    scene,
                    ray,
                    step,
                    contiguous,
                    transmittance,
                    packs,
                    slot,
                )
                contiguous = packs[slot].active[LANES - 1] != 0
                transmittance = packs[slot].transmittance_out
                n_samples += packs[slot].n_samples
                if wp.static(keeps):
                    keep_pack(scene.march, ray, packs, slot)
                slot += 1
            decode_pack(scene.head, rows, row, packs, first, slot - first)
            for k in range(first, slot):
                composite(packs, k)
                channels += packs[k].sums
                depth += packs[k].depth
                if wp.static(has_loss):
                    measure_pack(ray, packs, k)
                    state = add_pack(scene.loss.on_ray, state, packs, k)
                if wp.static(has_sample_loss):
                    target_rgb = rows[row].target_rgb
                    of_samples = add_samples(
                        scene.loss.on_samples, of_samples, target_rgb, packs, k
                    )
            n += slot - first
        rows[row].channels = channels
        rows[row].depth = depth
        rows[row].transmittance = transmittance
        rows[row].n_samples = n_samples
        rows[row].slot = begin
        if wp.static(has_loss):
            rows[row].loss = state
        if wp.static(has_sample_loss):
            rows[row].of_samples = of_samples
        return wp.min(begin + n, end - n_packs)

    @wp.func
    def adj_integrate(
        scene: RenderParams,
        rows: wp.array(dtype=RayState),
        row: int,  # as integrate left it, with what flows back to it
        packs: wp.array(dtype=Pack),  # as integrate left it
        end: int,  # one past the last slot
        worker: int,
        sink: Sink,  # added to, and what is in it
    ):
        """walk.adj_integrate, a pack at a time; those that were not kept are recomputed.

        What it has for other workers' parts of the field it leaves in records.
        """
        ray = rows[row].ray
        begin = rows[row].slot
        adj = rows[row].adj
        on_ray = scene.loss.on_ray
        adj_end = adj.transmittance
        if wp.static(of_light):
            adj_end += adj.loss * adj_light(on_ray, rows[row].transmittance)
        suffix_sum = (
            wp.dot(adj.channels, rows[row].channels)
            + adj.depth * rows[row].depth
            + adj_end * rows[row].transmittance
        )
        of_loss = float(0.0)
        far_end = distance_of(ray, edge(scene.march, ray, ray.end))
        if wp.static(has_loss):
            suffix_sum += adj.loss * weighted(on_ray, rows[row].loss)
            of_loss = adj.loss * loss_bound(on_ray, rows[row].loss, far_end)
        limit = suffix_limit(adj_end, adj.channels, adj.depth * far_end, of_loss)
        before = State()
        short = rows[row].n_samples < 4 * LANES  # else adj_read_pack prefetches all but the first
        transmittance = float(1.0)
        step = int(ray.begin)
        n = int(0)
        contiguous = bool(False)
        n_samples = int(0)
        while n_samples < rows[row].n_samples and step < ray.end:
            first = wp.min(begin + n, end - n_packs)
            kept = first < end - n_packs
            last = wp.min(first + n_packs, end - n_packs)
            slot = int(first)
            if not kept:
                while slot < end and step < ray.end:
                    step = next_pack(scene, ray, step, contiguous, transmittance, packs, slot)
                    contiguous = packs[slot].active[LANES - 1] != 0
                    transmittance = packs[slot].transmittance_out
                    slot += 1
                decode_pack(scene.head, rows, row, packs, first, slot - first)
                last = slot
                slot = first
            while slot < last and n_samples < rows[row].n_samples:
                if kept:
                    step = packs[slot].step + LANES
                    contiguous = packs[slot].active[LANES - 1] != 0
                    transmittance = packs[slot].transmittance_out
                n_samples += packs[slot].n_samples
                scale_pack(adj.content_distance, scaling, jacobian, packs, slot)
                if short and n + slot - first < n_packs:
                    prefetch_gradient(scene.field, packs, slot, worker, sink)
                if wp.static(has_loss):
                    if not kept:
                        measure_pack(ray, packs, slot)
                    packs[slot].adj_weight = lanes()
                    if wp.static(of_density):
                        packs[slot].adj_density = lanes()
                    before = adj_add_pack(on_ray, rows[row].loss, before, adj.loss, packs, slot)
                adj_composite(adj.depth, suffix_sum, limit, rows, row, packs, slot)
                suffix_sum = packs[slot].suffix_sum
                if wp.static(has_sample_loss):
                    target_rgb = rows[row].target_rgb
                    adj_add_samples(scene.loss.on_samples, adj.loss, target_rgb, packs, slot)
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
        integrate=integrate,
        adj_integrate=adj_integrate,
        Pack=Pack,
        RayState=RayState,
        RayAdjoint=adjoint_type(head.n_channels),
        Sink=Sink,
    )
