"""Trilinear interpolation between the eight nodes around a point, and its transpose."""

from typing import Any

import warp as wp

from ..base.atomics import add_to
from ..base.tiles import tile_of
from ..base.types import real, vec3

wp.set_module_options({"enable_backward": False})


@wp.func
def lowest_node(u: vec3, size: wp.vec3i) -> wp.vec3i:
    """Lowest corner of the cell that holds grid coordinates u; u on the far face counts inside."""
    return wp.vec3i(
        wp.clamp(int(u[0]), 0, size[0] - 2),
        wp.clamp(int(u[1]), 0, size[1] - 2),
        wp.clamp(int(u[2]), 0, size[2] - 2),
    )


@wp.func
def flat_index(i: int, j: int, k: int, size: wp.vec3i) -> int:
    """Index of node (i, j, k); z fastest."""
    return (i * size[1] + j) * size[2] + k


@wp.func
def gather(
    values: wp.array(dtype=Any),  # [X * Y * Z]
    size: wp.vec3i,
    base: int,  # flat index of the lowest node
    fraction: vec3,  # [0, 1]
):
    """Trilinear interpolation: weighted mean of the eight nodes around a point."""
    stride_y = size[2]
    stride_x = size[1] * size[2]
    fx = fraction[0]
    fy = fraction[1]
    fz = fraction[2]
    gx = real(1.0) - fx
    gy = real(1.0) - fy
    gz = real(1.0) - fz
    n00 = base
    n01 = base + stride_y
    n10 = base + stride_x
    n11 = base + stride_x + stride_y
    near_x = gy * (gz * values[n00] + fz * values[n00 + 1]) + fy * (
        gz * values[n01] + fz * values[n01 + 1]
    )
    far_x = gy * (gz * values[n10] + fz * values[n10 + 1]) + fy * (
        gz * values[n11] + fz * values[n11 + 1]
    )
    return gx * near_x + fx * far_x


@wp.func
def adj_gather(
    size: wp.vec3i,
    base: int,
    fraction: vec3,
    adj_value: Any,
    gradient: Any,  # added to
):
    """Transpose of gather (scatter-add): adj_value to the eight nodes, by the same weights.

    Additions are atomic on CUDA; on the CPU only one thread may call this at a time.
    """
    stride_y = size[2]
    stride_x = size[1] * size[2]
    fx = fraction[0]
    fy = fraction[1]
    fz = fraction[2]
    gx = real(1.0) - fx
    gy = real(1.0) - fy
    gz = real(1.0) - fz
    n00 = base
    n01 = base + stride_y
    n10 = base + stride_x
    n11 = base + stride_x + stride_y
    yes = wp.uint8(1)
    gradient.touched[tile_of(n00)] = yes
    gradient.touched[tile_of(n01)] = yes
    gradient.touched[tile_of(n10)] = yes
    gradient.touched[tile_of(n11)] = yes
    low = gx * gy * adj_value
    add_to(gradient.values, n00, gz * low)
    add_to(gradient.values, n00 + 1, fz * low)
    low = gx * fy * adj_value
    add_to(gradient.values, n01, gz * low)
    add_to(gradient.values, n01 + 1, fz * low)
    low = fx * gy * adj_value
    add_to(gradient.values, n10, gz * low)
    add_to(gradient.values, n10 + 1, fz * low)
    low = fx * fy * adj_value
    add_to(gradient.values, n11, gz * low)
    add_to(gradient.values, n11 + 1, fz * low)


@wp.func
def place_in(size: wp.vec3i, scale: vec3, offset: vec3, n: int, other_size: wp.vec3i):
    """Where another grid's node n lies in this one: lowest node around, and fraction.

    Outside of this one, its nearest face is meant.
    """
    k = n % other_size[2]
    j = (n // other_size[2]) % other_size[1]
    i = n // (other_size[2] * other_size[1])
    u = wp.cw_mul(vec3(real(i), real(j), real(k)), scale) + offset
    u = vec3(
        wp.clamp(u[0], real(0.0), real(size[0] - 1)),
        wp.clamp(u[1], real(0.0), real(size[1] - 1)),
        wp.clamp(u[2], real(0.0), real(size[2] - 1)),
    )
    node = lowest_node(u, size)
    fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
    return flat_index(node[0], node[1], node[2], size), fraction


@wp.func
def place_along(size: int, inner: int, scale: real, offset: real, out_size: int, n: int):
    """Where entry n of a resampled array lies: the lower of the two around, and how far up."""
    last = real(size - 1)
    u = wp.clamp(real((n // inner) % out_size) * scale + offset, real(0.0), last)
    k = wp.min(int(u), size - 2)
    low = ((n // (inner * out_size)) * size + k) * inner + n % inner
    return low, u - real(k)
