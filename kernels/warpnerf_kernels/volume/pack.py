"""SIMD volume rendering, sixteen steps at a time: compositing.py in vectors, for a CPU's cores.

A core computes many numbers as fast as one, but only where code says so. It computes sixteen in
less time than eight twice, even where they take two instructions each: a sample is a long chain of
operations that wait for each other. Each function here is the vector form of the scalar one that
its docstring names, and tests compare the two. CUDA, where threads are the vector, and
float64, which is for checking, run the scalar ones.

The bodies are C++ on Clang's vector types, which compile for any processor. A native function
cannot return a vector: they pass on what they compute in a ``Pack``, scratch memory of a worker.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.parts import Encoding, Head, Losses
from ..base.simd import LANES, VECTORS, lanes, lanes_int
from ..base.types import Density, Ray, struct
from .ray_loss import NONE, vector_form
from .sample_loss import NO_SAMPLE_LOSS, lanes_form
from .walk import adjoint_type

wp.set_module_options({"enable_backward": False})


@cache
def pack_type(encoding: Encoding, head: Head, losses: Losses) -> type:
    """Sixteen consecutive steps of a ray, which of them are samples, and what those hold."""
    loss, on_samples = losses.on_ray, losses.on_samples
    by_channel = wp.types.matrix((head.n_channels, LANES), wp.float32)
    for_samples = {
        "colour_weight": lanes,  # the weight where a sample has a colour, else 0; forward
        "adj_channel": by_channel,  # what flows back to channels
    }
    return struct(
        "Pack",
        {
            "step": int,  # of the first lane
            "n_samples": int,
            "transmittance_out": wp.float32,  # light that passes the pack
            "suffix_sum": wp.float32,  # of what flows back, the part that lies behind the pack
            "depth": wp.float32,  # sum of weight times t
            "active": lanes_int,  # -1 where a step is a sample, 0 where it is not
            "t": lanes,  # distance from the ray's origin
            "dt": lanes,  # step length
            "det_jacobian": lanes,  # |det J| of the contraction, 1 without
            "x": lanes,  # position, contracted coordinates c
            "y": lanes,
            "z": lanes,
            "sigma_slope": lanes,  # d sigma / d raw density
            "weight": lanes,  # transmittance times alpha; 0 where not visited
            "transmittance": lanes,  # what passes the samples up to this one, it included
            "scale": lanes,  # of the gradient, by distance
            "raw": wp.types.matrix((encoding.vectors.n_by_lane, LANES), wp.float32),
            "adj_raw": wp.types.matrix((encoding.vectors.n_by_lane, LANES), wp.float32),
            "channel": by_channel,
            "sums": wp.types.vector(head.n_channels, wp.float32),  # of weight times channel
            **dict(encoding.vectors.pack_fields),
            **dict(head.vectors.pack_fields),
            **({"adj_weight": lanes} if loss is not NONE else {}),  # from the loss on the ray
            **({"length": lanes} if loss is not NONE else {}),  # of steps, scene units; for it
            **({"adj_density": lanes} if loss.adj_density else {}),  # likewise, of raw densities
            **dict(vector_form(loss).pack_fields),
            **(for_samples if on_samples is not NO_SAMPLE_LOSS else {}),
            **dict(lanes_form(on_samples, head.n_channels).pack_fields),
        },
        __name__,
    )


@cache
def ray_state_type(head: Head, losses: Losses) -> type:
    """The state of a ray between the two passes."""
    loss = losses.on_ray
    channels = wp.types.vector(head.n_channels, wp.float32)
    vec3 = wp.types.vector(3, wp.float32)
    of_samples = losses.on_samples
    return struct(
        "RayState",
        {
            "ray": Ray,
            "channels": channels,  # sums of weight times channel, without background
            "depth": wp.float32,  # sum of weight times t
            "transmittance": wp.float32,  # what passes all samples
            "n_samples": int,
            "slot": int,  # of its first pack
            "rgb": vec3,  # without background
            "target_rgb": vec3,  # for the loss on samples
            "adj_rgb": vec3,
            "adj_opacity": wp.float32,  # of the head
            "adj": adjoint_type(head.n_channels),
            **dict(head.vectors.row_fields),
            **({"loss": loss.State} if loss is not NONE else {}),  # sums over its samples
            **({"of_samples": of_samples.State} if of_samples is not NO_SAMPLE_LOSS else {}),
        },
        __name__,
    )


@wp.func_native(
    VECTORS
    + r"""
auto& pack = packs.data[slot];
const vec raw = load(pack.raw.data[0]) + density.shift;
vec e = exponential(-abs(raw));
vec sigma = density.scale * ((raw < 0.0f ? splat(0.0f) : raw) + log1p(e));
vec slope = (raw >= 0.0f ? splat(1.0f) : e) / (1.0f + e);
vec tau = sigma * load(pack.dt);
vec attenuation = exponential(-tau);
vec series = fma(splat(-1.0f / 24.0f), tau, splat(1.0f / 6.0f));
series = fma(fma(series, -tau, splat(0.5f)), -tau, splat(1.0f));
store(pack.sigma_slope, density.scale * slope);
const vec alpha = tau < 0.01f ? tau * series : 1.0f - attenuation;

ivec active = load_int(pack.active);
vec light = transmittance * running_product(active ? attenuation : splat(1.0f));
vec before = SHIFT_LANES_1(light, splat(transmittance));
ivec reached = ~(before < transmittance_min);
active &= reached;
store_int(pack.active, active);
store(pack.weight, active ? before * alpha : splat(0.0f));
store(pack.transmittance, light);
pack.n_samples = count(active);
pack.transmittance_out = pack.transmittance.c[count(reached) - 1];
"""
)
def weigh(
    density: Density,
    transmittance: wp.float32,  # of what lies before, at least transmittance_min
    transmittance_min: wp.float32,  # nothing is sampled once less light than this passes
    packs: wp.array(dtype=Any),
    slot: int,
):
    """activate_density and the weights of a pack's samples, from their raw densities."""
    ...


COMPOSITE = r"""
auto& pack = packs.data[slot];
constexpr int CHANNELS = sizeof(pack.channel) / sizeof(vec);
const vec weight = load(pack.weight);
#pragma clang loop unroll(full)
for (int c = 0; c < CHANNELS; ++c) {
    pack.sums.c[c] = sum(weight * load(pack.channel.data[c]));
}
pack.depth = sum(weight * load(pack.t));
OF_SAMPLES
"""

ADJ_COMPOSITE = r"""
auto& pack = packs.data[slot];
const auto& adj = rows.data[row].adj.channels;
constexpr int CHANNELS = sizeof(pack.channel) / sizeof(vec);
vec weight = load(pack.weight);
vec adj_weight = fma(splat(adj_depth), load(pack.t),
                     adj.c[CHANNELS - 1] * load(pack.channel.data[CHANNELS - 1]));
#pragma clang loop unroll(full)
for (int c = CHANNELS - 2; c >= 0; --c) {
    adj_weight = fma(splat(adj.c[c]), load(pack.channel.data[c]), adj_weight);
}
OF_LOSS
vec light = load(pack.transmittance);
vec left = suffix_sum - running_sum(weight * adj_weight);
left = min(max(left, -limit * light), limit * light);
vec adj_tau = fma(light, adj_weight, -left);
const vec adj_sigma = load(pack.scale) * (load(pack.dt) * adj_tau);
store(pack.adj_raw.data[0], load(pack.sigma_slope) * adj_sigma OF_DENSITY);
pack.suffix_sum = left[LANES - 1];
OF_SAMPLES
"""

COLOUR_WEIGHT = "store(pack.colour_weight, weight > WEIGHT_MIN ? weight : splat(0.0f));"
BY_SAMPLE = "for (int c = 0; c < CHANNELS; ++c) store(pack.adj_channel.data[c], splat(adj.c[c]));"
"""What both do for a loss on samples: it adds its own to the pack's adj_channel."""


@cache
def compositing(head: Head, losses: Losses) -> tuple[wp.Function, wp.Function]:
    """composite, what walk.integrate accumulates for the samples of a pack, and adj_composite.

    The latter does what walk.adj_integrate does with densities. Where there is a loss on the ray,
    the pack holds what it adds to the slopes of each weight and each raw density.
    """
    loss = losses.on_ray
    has_sample_loss = losses.on_samples is not NO_SAMPLE_LOSS
    colour_weight = COLOUR_WEIGHT.replace("WEIGHT_MIN", f"{float(head.weight_min)!r}f")
    forward = VECTORS + COMPOSITE.replace("OF_SAMPLES", colour_weight if has_sample_loss else "")
    of_loss = "" if loss is NONE else "adj_weight += load(pack.adj_weight);"
    of_density = "+ load(pack.scale) * load(pack.adj_density)" if loss.adj_density else ""
    backward = VECTORS + ADJ_COMPOSITE.replace("OF_LOSS", of_loss).replace("OF_DENSITY", of_density)
    backward = backward.replace("OF_SAMPLES", BY_SAMPLE if has_sample_loss else "")

    @wp.func_native(forward)
    def composite(packs: wp.array(dtype=Any), slot: int): ...

    @wp.func_native(backward)
    def adj_composite(
        adj_depth: wp.float32,
        suffix_sum: wp.float32,  # what lies behind the pack before this one
        limit: wp.float32,  # of what lies behind, for each unit of light
        rows: wp.array(dtype=Any),
        row: int,  # whose adj.channels flow back
        packs: wp.array(dtype=Any),
        slot: int,
    ): ...

    return composite, adj_composite
