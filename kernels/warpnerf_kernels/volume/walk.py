"""The walk along a ray, and its adjoint: one walk, two passes, a sample at a time.

The forward pass composites samples front to back; the backward pass walks the same samples and
needs of the rest of the ray only what lies behind: it starts with that, and sheds it on its way.
Both get their samples from ``next_sample``, the one place that decides where a ray is sampled.

This is the specification. walk_packs.py does the same, sixteen samples at a time.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from ..base.activation import adj_softplus, alpha_of
from ..base.parts import Encoding, Head, Losses, Sampler
from ..base.types import Ray, gradient_type, real, vec3, vector
from ..sampling.traversal import distance_of, length_of, traversal
from .compositing import matter_of, shed
from .gradscale import distance_scale
from .sample_loss import ColourSums, adj_sample_loss
from .scene import scene_type

wp.set_module_options({"enable_backward": False})


@cache
def integral_type(n_channels: int, losses: Losses) -> type:
    """What a ray has gathered."""
    State = losses.on_ray.State

    @wp.struct
    class Integral:
        channels: vector(n_channels)  # sums of weight times channel, without background
        depth: real  # sum of weight times t
        transmittance: real  # what passes all samples
        n_samples: int
        loss: State  # sums of the loss over samples
        of_samples: ColourSums  # of the loss on their colours, where there is one

    return Integral


@cache
def walk(sampler: Sampler, encoding: Encoding, head: Head, losses: Losses) -> SimpleNamespace:
    """The two passes for a model's parts.

    Returns:
        integrate, adj_integrate, and Integral, the type between them.
    """
    Scene = scene_type(sampler, encoding, head, losses)
    Raw, Channels, View = vector(encoding.n_floats), vector(head.n_channels), head.View
    Gradient = gradient_type(encoding.n_floats)
    loss, on_samples = losses.on_ray, losses.on_samples
    State = loss.State
    Integral = integral_type(head.n_channels, losses)
    next_sample = traversal(sampler).next_sample
    edge = sampler.edge
    read, adj_read = encoding.read, encoding.adj_read
    prepare, adj_prepare = head.prepare, head.adj_prepare
    decode, adj_decode = head.decode, head.adj_decode
    add_loss, weighted, adj_loss, loss_bound = loss.add, loss.weighted, loss.adj_weight, loss.bound
    adj_light, adj_density = loss.adj_transmittance, loss.adj_density
    of_light, of_density = adj_light is not None, adj_density is not None
    weight_min = head.weight_min

    @wp.func
    def integrate(
        scene: Scene,
        ray: Ray,
        contraction: int,
    ) -> Integral:
        """Composite a ray's samples front to back: sum_i T_i alpha_i c_i."""
        view = prepare(scene.head, ray.direction)
        total = Integral()
        total.transmittance = real(1.0)
        step = int(ray.begin)
        while step < ray.end:
            sample = next_sample(scene.box, scene.free, scene.march, ray, step, contraction)
            step = sample.step + 1
            if sample.step < ray.end:
                raw = read(scene.field, sample.position)
                matter = matter_of(scene.density, raw[0], sample.dt)
                alpha = alpha_of(matter.sigma * sample.dt, matter.attenuation)
                weight = total.transmittance * alpha
                if weight > real(weight_min):
                    channels = decode(scene.head, view, raw)
                    total.channels += weight * channels
                    if wp.static(on_samples):
                        total.of_samples.weight += weight
                        total.of_samples.square += weight * wp.length_sq(channels)
                length = length_of(ray, sample.t, sample.dt, contraction)
                total.loss = add_loss(
                    scene.loss.on_ray, total.loss, weight, sample.t, length, raw[0]
                )
                total.depth += weight * sample.t
                total.transmittance *= matter.attenuation
                total.n_samples += 1
                if total.transmittance < scene.march.transmittance_min:
                    step = ray.end
        return total

    @wp.func
    def adj_integrate(
        scene: Scene,
        ray: Ray,
        total: Integral,
        adj_channels: Channels,
        adj_transmittance: real,  # of what passes all samples
        adj_depth: real,
        adj_loss_value: real,
        target_rgb: vec3,  # of the loss on samples
        content_distance: real,
        contraction: int,
        scaling: int,
        jacobian: int,
        gradient: Gradient,  # added to
    ):
        """Adjoint of integrate. With G_i = dL/dw_i = <adj_channels, c_i> + adj_depth t_i + loss,

        dL/dsigma_i = dt_i (T_{i+1} G_i - sum_{j>i} w_j G_j - T_end dL/dT_end),
        dL/dc_i = w_i (adj_channels, and the loss on samples),

        both multiplied by the distance scaling. The two sums are what lies behind sample i.
        """
        view = prepare(scene.head, ray.direction)
        adj_view = View()
        on_ray = scene.loss.on_ray
        adj_end = adj_transmittance
        if wp.static(of_light):
            adj_end += adj_loss_value * adj_light(on_ray, total.transmittance)
        behind = (
            wp.dot(adj_channels, total.channels)
            + adj_depth * total.depth
            + adj_end * total.transmittance
            + adj_loss_value * weighted(on_ray, total.loss)
        )
        end = distance_of(ray, edge(scene.march, ray, ray.end), contraction)
        limit = behind_limit(
            adj_end,
            adj_channels,
            adj_depth * end,
            adj_loss_value * loss_bound(on_ray, total.loss, end),
        )
        before = State()
        transmittance = real(1.0)
        step = int(ray.begin)
        for _n in range(total.n_samples):
            sample = next_sample(scene.box, scene.free, scene.march, ray, step, contraction)
            step = sample.step + 1
            raw = read(scene.field, sample.position)
            matter = matter_of(scene.density, raw[0], sample.dt)
            weight = transmittance * alpha_of(matter.sigma * sample.dt, matter.attenuation)
            transmittance *= matter.attenuation
            scale = distance_scale(
                sample.t, content_distance, sample.det_jacobian, scaling, jacobian
            )
            length = length_of(ray, sample.t, sample.dt, contraction)
            adj_weight = adj_depth * sample.t + adj_loss_value * adj_loss(
                on_ray, total.loss, before, weight, sample.t, length
            )
            before = add_loss(on_ray, before, weight, sample.t, length, raw[0])
            adj_raw = Raw()
            if weight > real(weight_min):
                channels = decode(scene.head, view, raw)
                adj_weight += wp.dot(adj_channels, channels)
                adj_own = adj_channels
                if wp.static(on_samples):
                    slope = real(2.0) * scene.loss.on_samples * adj_loss_value
                    adj_own += adj_sample_loss(slope, channels, target_rgb)
                adj_sample_channels = scale * (weight * adj_own)
                adj_raw, adj_sample_view = adj_decode(
                    scene.head, view, raw, channels, adj_sample_channels, gradient
                )
                adj_view += adj_sample_view
            behind = shed(behind, weight, adj_weight, limit, transmittance)
            adj_sigma = scale * (sample.dt * (transmittance * adj_weight - behind))
            adj_raw[0] = adj_softplus(matter.sigma_slope, adj_sigma)
            if wp.static(of_density):
                adj_raw[0] += scale * (adj_loss_value * adj_density(on_ray, sample.t))
            adj_read(scene.field, sample.position, adj_raw, gradient)
        adj_prepare(scene.head, ray.direction, adj_view, gradient)

    return SimpleNamespace(integrate=integrate, adj_integrate=adj_integrate, Integral=Integral)


@wp.func
def behind_limit(adj_transmittance: real, adj_channels: Any, of_depth: real, of_loss: real) -> real:
    """How much what lies behind a sample can be, for each unit of light that gets there.

    Channels lie in [0, 1].
    """
    of_channels = real(0.0)
    for c in range(len(adj_channels)):
        of_channels += wp.abs(adj_channels[c])
    return wp.max(wp.abs(adj_transmittance), of_channels + wp.abs(of_depth) + wp.abs(of_loss))
