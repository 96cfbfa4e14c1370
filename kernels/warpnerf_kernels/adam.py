"""The optimiser step. Kingma & Ba 2015, algorithm 1; entries without a gradient are left alone."""

import warp as wp

from .tiles import TILE, next_tile, prefetch, tile_of
from .types import Gradient, real, vec4

wp.set_module_options({"enable_backward": False})


@wp.kernel
def adam_step(
    first: int,
    span: int,  # nodes per thread
    learning_rate: vec4,  # per channel
    beta1: real,
    beta2: real,
    epsilon: real,
    correction1: real,  # 1 / (1 - beta1^step)
    correction2: real,  # 1 / (1 - beta2^step)
    gradient: Gradient,  # zeroed
    values: wp.array(dtype=vec4),  # [n_nodes] updated
    mean: wp.array(dtype=vec4),  # [n_nodes] first moment, updated
    square: wp.array(dtype=vec4),  # [n_nodes] second moment, updated
):
    """One step. An entry whose gradient is exactly zero keeps its value and its moments."""
    start = (first + wp.tid()) * span
    end = start + wp.min(span, values.shape[0] - start)  # start + span might be beyond int
    last = tile_of(end - 1) + 1
    tile = next_tile(gradient.touched, tile_of(start), last)
    while tile < last:
        node = tile * wp.static(TILE)
        prefetch(gradient.values, node)
        prefetch(values, node)
        prefetch(mean, node)
        prefetch(square, node)
        tile = next_tile(gradient.touched, tile + 1, last)
    zero = vec4()
    tile = next_tile(gradient.touched, tile_of(start), last)
    while tile < last:
        node = tile * wp.static(TILE)
        for i in range(wp.max(start, node), wp.min(end, node + wp.static(TILE))):
            adj = gradient.values[i]
            if not (adj == zero):
                gradient.values[i] = zero
                value = values[i]
                m = mean[i]
                v = square[i]
                for channel in range(4):
                    g = adj[channel]
                    m_new = beta1 * m[channel] + (real(1.0) - beta1) * g
                    v_new = beta2 * v[channel] + (real(1.0) - beta2) * g * g
                    x_new = value[channel] - learning_rate[channel] * (correction1 * m_new) / (
                        wp.sqrt(correction2 * v_new) + epsilon
                    )
                    m[channel] = wp.where(g != real(0.0), m_new, m[channel])
                    v[channel] = wp.where(g != real(0.0), v_new, v[channel])
                    value[channel] = wp.where(g != real(0.0), x_new, value[channel])
                values[i] = value
                mean[i] = m
                square[i] = v
        tile = next_tile(gradient.touched, tile + 1, last)
