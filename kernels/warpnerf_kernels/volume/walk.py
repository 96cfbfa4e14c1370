"""Volume rendering of a ray, and its adjoint: one walk, two passes, a sample at a time.

The forward pass composites samples front to back; the backward pass walks the same samples and
needs of the rest of the ray only what lies behind: it starts with that, and takes its own part away
at each sample. Both get their samples from ``next_sample``, the one place that decides where a ray
is sampled.

This is the specification. walk_packs.py does the same, sixteen samples at a time.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..base.activation import adj_softplus, alpha_of
from ..base.parts import Losses
from ..base.types import Ray, real, vec3, vector
from ..sampling.traversal import traversal
from .compositing import activate_density, advance_suffix
from .gradscale import distance_scale
from .render_params import render_params_type
from .sample_loss import NO_SAMPLE_LOSS
from .variant import Variant

wp.set_module_options({"enable_backward": False})


@cache
def accumulator_type(n_channels: int, losses: Losses) -> type:
    """What a ray has accumulated."""
    State, OfSamples = losses.on_ray.State, losses.on_samples.State

    @wp.struct
    class RayAccumulator:
        channels: vector(n_channels)  # sums of weight times channel, without background
        depth: real  # sum of weight times t
        transmittance: real  # what passes all samples
        n_samples: int
        loss: State  # sums of the loss over samples
        of_samples: OfSamples  # of the loss on their colours

    return RayAccumulator


@cache
def adjoint_type(n_channels: int) -> type:
    """The adjoint of what a ray has accumulated."""

    @wp.struct
    class RayAdjoint:
        channels: vector(n_channels)
        depth: real
        transmittance: real  # of what passes all samples
        loss: real  # of its losses, but for the photometric one
        content_distance: real  # scene units: by it what flows to samples is scaled

    return RayAdjoint


@cache
def walk(variant: Variant) -> SimpleNamespace:
    """The two passes of a variant.

    Returns:
        integrate, adj_integrate, and the types between them: RayAccumulator, and RayAdjoint, which
        flows back.
    """
    head, encoding, sampler, losses = variant.parts
    space, scaling, jacobian = variant.space, variant.scaling, variant.jacobian
    RenderParams = render_params_type(sampler, encoding, head, losses)
    Raw, ViewFeatures = vector(encoding.n_floats), head.ViewFeatures
    Gradient = encoding.Gradient
    loss, on_samples = losses.on_ray, losses.on_samples
    State = loss.State
    RayAccumulator, RayAdjoint = (
        accumulator_type(head.n_channels, losses),
        adjoint_type(head.n_channels),
    )
    next_sample = traversal(sampler, space).next_sample
    distance_of, length_of = space.distance_of, space.length_of
    edge, keep, keeps = sampler.edge, sampler.keep, sampler.keep is not None
    read, adj_read = encoding.read, encoding.adj_read
    prepare, adj_prepare = head.prepare, head.adj_prepare
    decode, adj_decode = head.decode, head.adj_decode
    add_loss, weighted, adj_loss, loss_bound = loss.add, loss.weighted, loss.adj_weight, loss.bound
    adj_light, adj_density = loss.adj_transmittance, loss.adj_density
    of_light, of_density = adj_light is not None, adj_density is not None
    has_sample_loss = on_samples is not NO_SAMPLE_LOSS
    add_sample, adj_sample = on_samples.add, on_samples.adj_channels
    weight_min = head.weight_min

    @wp.func
    def integrate(
        scene: RenderParams,
        ray: Ray,
        target_rgb: vec3,  # of the loss on samples
    ) -> RayAccumulator:
        """Alpha compositing of a ray's samples, front to back: sum_i T_i alpha_i c_i."""
        view = prepare(scene.head, ray.direction)
        total = RayAccumulator()
        total.transmittance = real(1.0)
        step = int(ray.begin)
        while step < ray.end:
            sample = next_sample(scene.box, scene.free, scene.march, ray, step)
            step = sample.step + 1
            if sample.step < ray.end:
                raw = read(scene.field, sample.position)
                activated = activate_density(scene.density, raw[0], sample.dt)
                alpha = alpha_of(activated.sigma * sample.dt, activated.attenuation)
                weight = total.transmittance * alpha
                if wp.static(keeps):
                    keep(scene.march, ray, sample.step, weight)
                if weight > real(weight_min):
                    channels = decode(scene.head, view, raw)
                    total.channels += weight * channels
                    total.of_samples = add_sample(
                        scene.loss.on_samples, total.of_samples, weight, channels, target_rgb
                    )
                length = length_of(ray, sample.t, sample.dt)
                total.loss = add_loss(
                    scene.loss.on_ray, total.loss, weight, sample.t, length, raw[0]
                )
                total.depth += weight * sample.t
                total.transmittance *= activated.attenuation
                total.n_samples += 1
                if total.transmittance < scene.march.transmittance_min:
                    step = ray.end
        return total

    @wp.func
    def adj_integrate(
        scene: RenderParams,
        ray: Ray,
        total: RayAccumulator,
        adj: RayAdjoint,
        target_rgb: vec3,  # of the loss on samples
        gradient: Gradient,  # added to
    ):
        """Adjoint of integrate. With G_i = dL/dw_i = <adj.channels, c_i> + adj.depth t_i + loss,

        dL/dsigma_i = dt_i (T_{i+1} G_i - sum_{j>i} w_j G_j - T_end dL/dT_end),
        dL/dc_i = w_i (adj.channels, and the loss on samples),

        both multiplied by the distance scaling. The two sums are what lies behind sample i.
        """
        view = prepare(scene.head, ray.direction)
        adj_view = ViewFeatures()
        on_ray = scene.loss.on_ray
        adj_end = adj.transmittance
        if wp.static(of_light):
            adj_end += adj.loss * adj_light(on_ray, total.transmittance)
        suffix_sum = (
            wp.dot(adj.channels, total.channels)
            + adj.depth * total.depth
            + adj_end * total.transmittance
            + adj.loss * weighted(on_ray, total.loss)
        )
        end = distance_of(ray, edge(scene.march, ray, ray.end))
        limit = suffix_limit(
            adj_end,
            adj.channels,
            adj.depth * end,
            adj.loss * loss_bound(on_ray, total.loss, end),
        )
        before = State()
        transmittance = real(1.0)
        step = int(ray.begin)
        for _n in range(total.n_samples):
            sample = next_sample(scene.box, scene.free, scene.march, ray, step)
            step = sample.step + 1
            raw = read(scene.field, sample.position)
            activated = activate_density(scene.density, raw[0], sample.dt)
            weight = transmittance * alpha_of(activated.sigma * sample.dt, activated.attenuation)
            transmittance *= activated.attenuation
            scale = distance_scale(
                sample.t, adj.content_distance, sample.det_jacobian, scaling, jacobian
            )
            length = length_of(ray, sample.t, sample.dt)
            adj_weight = adj.depth * sample.t + adj.loss * adj_loss(
                on_ray, total.loss, before, weight, sample.t, length
            )
            before = add_loss(on_ray, before, weight, sample.t, length, raw[0])
            adj_raw = Raw()
            if weight > real(weight_min):
                channels = decode(scene.head, view, raw)
                adj_weight += wp.dot(adj.channels, channels)
                adj_own = adj.channels
                if wp.static(has_sample_loss):
                    adj_own += adj_sample(scene.loss.on_samples, channels, target_rgb, adj.loss)
                adj_sample_channels = scale * (weight * adj_own)
                adj_raw, adj_sample_view = adj_decode(
                    scene.head, view, raw, channels, adj_sample_channels, gradient
                )
                adj_view += adj_sample_view
            suffix_sum = advance_suffix(suffix_sum, weight, adj_weight, limit, transmittance)
            adj_sigma = scale * (sample.dt * (transmittance * adj_weight - suffix_sum))
            adj_raw[0] = adj_softplus(activated.sigma_slope, adj_sigma)
            if wp.static(of_density):
                adj_raw[0] += scale * (adj.loss * adj_density(on_ray, sample.t))
            adj_read(scene.field, sample.position, adj_raw, gradient)
        adj_prepare(scene.head, ray.direction, adj_view, gradient)

    return SimpleNamespace(
        integrate=integrate,
        adj_integrate=adj_integrate,
        RayAccumulator=RayAccumulator,
        RayAdjoint=RayAdjoint,
    )


@wp.func
def suffix_limit(adj_transmittance: real, adj_channels: Any, of_depth: real, of_loss: real) -> real:
    """A bound on the suffix sum behind a sample, for each unit of light that gets there.

    Channels lie in [0, 1].
    """
    of_channels = real(0.0)
    for c in range(len(adj_channels)):
        of_channels += wp.abs(adj_channels[c])
    return wp.max(wp.abs(adj_transmittance), of_channels + wp.abs(of_depth) + wp.abs(of_loss))
