"""Occupancy grid: which cells of the domain hold nothing that could be seen (free space)."""

from functools import cache

import warp as wp

from ..base.activation import softplus
from ..base.parts import Sampler, Space
from ..base.types import Box, Density, real, vec3

wp.set_module_options({"enable_backward": False})

FAR = wp.constant(8)  # distances are counted up to here, cells


@cache
def mark_occupied_kernel(sampler: Sampler, space: Space) -> wp.Kernel:
    """Which cells hold something that a step could see."""
    Steps, longest, boxes_out = sampler.Params, sampler.longest, space.boxes_out

    @wp.kernel(module="unique", enable_backward=False)
    def mark_occupied(
        # launch
        first: int,
        span: int,  # cells per thread, in one row along z
        # scene
        box: Box,
        density: Density,
        highest: wp.array(dtype=real),  # [MX * MY * MZ] by find_highest, and join_highest twice
        size: wp.vec3i,  # cells
        march: Steps,
        # choices
        alpha_min: real,  # what counts as visible
        # out
        out_distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ] 0 where occupied, else FAR + 1
    ):
        """A cell is occupied if any node in it or next to it would give a step this much alpha."""
        start = (first + wp.tid()) * span
        row = start // size[2]
        half = vec3(real(size[0]), real(size[1]), real(size[2])) / real(2.0)
        cell = vec3(real(row // size[1]), real(row % size[1]), real(start % size[2]))
        for n in range(start, start + span):
            middle = cell + vec3(real(0.5)) - half
            outermost = vec3(
                (wp.abs(middle[0]) + real(0.5)) / half[0],
                (wp.abs(middle[1]) + real(0.5)) / half[1],
                (wp.abs(middle[2]) + real(0.5)) / half[2],
            )
            step = longest(march, boxes_out(box, (real(1.0) + box.border) * outermost))
            sigma = density.scale * softplus(highest[n] + density.shift)
            if real(1.0) - wp.exp(-step * sigma) <= alpha_min:
                out_distance[n] = wp.uint8(FAR + 1)
            else:
                out_distance[n] = wp.uint8(0)
            cell[2] += real(1.0)

    return mark_occupied


@wp.kernel
def spread_distance(
    # launch
    first: int,
    span: int,  # cells per thread, in one row along z
    # scene
    distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ]
    size: wp.vec3i,  # cells
    # choices
    axis: int,
    # out
    out_distance: wp.array(dtype=wp.uint8),  # [MX * MY * MZ]
):
    """One axis of the chessboard distance to the nearest occupied cell, up to FAR + 1.

    max(|dx|, |dy|, |dz|) separates: d'(p) = min over s of max(|s|, d(p + s along the axis)).
    """
    start = (first + wp.tid()) * span
    stride = int(1)
    if axis == 0:
        stride = size[1] * size[2]
    if axis == 1:
        stride = size[2]
    position = (start // stride) % size[axis]
    for n in range(start, start + span):
        best = int(distance[n])
        s = int(1)
        while s < best and s <= FAR:
            if position >= s:
                best = wp.min(best, wp.max(s, int(distance[n - s * stride])))
            if position + s < size[axis]:
                best = wp.min(best, wp.max(s, int(distance[n + s * stride])))
            s += 1
        out_distance[n] = wp.uint8(best)
        if axis == 2:
            position += 1
