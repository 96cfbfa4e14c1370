"""Background culling: which blocks of a photograph's pixels have rays that may meet something."""

import warp as wp

from ..base.types import Box, FreeSpace, Ray, real, vec2, vec3
from ..space.camera import CameraParams, pixel_direction
from .occupancy import FAR
from .traversal import free_distance, slab, straight_length

wp.set_module_options({"enable_backward": False})


@wp.kernel
def cover_blocks(
    # launch
    first: int,
    # scene
    view: CameraParams,
    box: Box,  # without contraction
    free: FreeSpace,
    # choices
    block: int,  # edge of a block, pixels
    first_block: int,  # how many the views before have
    # out
    out_covered: wp.array(dtype=wp.uint8),  # [n_blocks] of all views: 0 where rays meet nothing
):
    """Follows the cone around a block's rays through free space, up to the first occupied cell.

    A block's directions lie as near to that of its middle as those of its corners: lenses bend
    little within it. So at t its rays lie within t spread of the middle's, and in cells at most as
    far away, rounded up.
    """
    i = first + wp.tid()
    across = (view.width + block - 1) // block
    half = real(0.5) * real(block)
    u = real(i % across * block) + half
    v = real(i // across * block) + half
    ray = Ray()
    ray.direction = pixel_direction(view, u, v)
    spread = real(0.0)
    for corner in range(4):
        at_u = u + wp.where(corner < 2, half, -half)
        at_v = v + wp.where(corner % 2 == 0, half, -half)
        spread = wp.max(spread, wp.length(pixel_direction(view, at_u, at_v) - ray.direction))
    ray.q_origin = wp.cw_div(view.position - box.centre, box.half)
    ray.q_direction = wp.cw_div(ray.direction, box.half)
    # The cone meets the box where its middle meets a box that is larger by what it is wide there.
    far = wp.length(view.position - box.centre) + wp.length(box.half)
    interval = vec2(real(0.0), far)
    for axis in range(3):
        larger = real(1.0) + far * spread / box.half[axis]
        interval = slab(ray.q_origin[axis] / larger, ray.q_direction[axis] / larger, interval)
    edges = wp.cw_div(box.half, free.to_cells)
    edge = wp.min(edges[0], wp.min(edges[1], edges[2]))
    longest = real(FAR + 1) * wp.length(edges)  # no free length is longer
    middle = real(0.5) * vec3(real(free.size[0]), real(free.size[1]), real(free.size[2]))
    covered = wp.uint8(0)
    t = interval[0]
    while t <= interval[1]:
        m = wp.cw_mul(ray.q_origin + t * ray.q_direction, free.to_cells) + middle
        distance = free_distance(free, m)
        wide = int(wp.ceil((t + longest) * spread / edge))
        if distance <= wide:
            covered = wp.uint8(1)
            break
        free_way = straight_length(free, ray, m, distance - wide)
        # Over the edge between two cells, and by more than t is rounded to.
        t += wp.max(free_way, wp.max(real(1.0e-3) * edge, real(4.0e-7) * t))
    out_covered[first_block + i] = covered
