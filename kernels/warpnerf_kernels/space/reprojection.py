"""Depth-image-based rendering (3D warping): a picture with depth, seen from another viewpoint.

Two launches. The first splats the source's points into the target's depth buffer. The second is an
inverse warp: each target pixel takes its depth from that buffer, finds its place in the source, and
reads the colour there. It is seen if the source's own surface lies at that place; elsewhere the
target shows what the source hid or did not hold.

Pictures are pinhole images without distortion; ``c2w`` has OpenGL axes (x right, y up, looking
along -z), pixel (u, v) has its centre at (u + 0.5, v + 0.5), row 0 at the top.
"""

import warp as wp

from ..base.types import mat33, real, vec2, vec3

wp.set_module_options({"enable_backward": False})

TRIES = 4
"""Places on a ray of the target that are tried: the depth buffer's, then where the source says."""

TOLERANCE = 0.04
"""Of a distance: surfaces that differ by less are one."""

NOTHING = 1.0e30
"""What the depth buffer holds where no point was splatted."""

COARSE = 2
"""Pixels along the edge of one of the depth buffer, and from one splatted point to the next."""

CRACK = 2
"""Pixels of the depth buffer: how far from a splatted point a stretched surface may show none."""


@wp.struct
class Pinhole:
    """The camera of a picture."""

    rotation: mat33  # camera to world
    position: vec3  # scene units
    focal: vec2  # fx, fy, pixels
    principal: vec2  # cx, cy, pixels
    width: int  # pixels
    height: int  # pixels


@wp.func
def project(view: Pinhole, local: vec3) -> vec2:
    """Image position of a point in the camera's axes, in front of it, in pixels."""
    inverse = real(-1.0) / local[2]
    return vec2(
        view.focal[0] * local[0] * inverse + view.principal[0],
        view.principal[1] - view.focal[1] * local[1] * inverse,
    )


@wp.kernel
def splat_depths(
    # launch
    first: int,  # an item is a row of the source, of every COARSE-th
    # scene
    source: Pinhole,
    buffer: Pinhole,  # the target's camera, with the pixels of the depth buffer
    distances: wp.array(dtype=real),  # [H * W] of the source, along rays, scene units; <= 0: none
    # out
    out_depths: wp.array(dtype=real),  # [h * w] of the buffer, along its axis; NOTHING before
):
    """The depth buffer of the target: each point of the source covers the four nearest pixels."""
    row = wp.static(COARSE) * (first + wp.tid()) + wp.static(COARSE // 2)
    row = wp.min(row, source.height - 1)
    # In the target's axes: rays of this row, 1 long along the source's axis, and where they begin.
    turn = wp.transpose(buffer.rotation) * source.rotation
    shift = wp.transpose(buffer.rotation) * (source.position - buffer.position)
    across = real(1.0) / source.focal[0]
    y = (source.principal[1] - real(row) - real(0.5)) / source.focal[1]
    for column in range(wp.static(COARSE // 2), source.width, wp.static(COARSE)):
        distance = distances[row * source.width + column]
        if distance > real(0.0):
            x = (real(column) + real(0.5) - source.principal[0]) * across
            along = distance / wp.sqrt(x * x + y * y + real(1.0))
            local = along * (turn * vec3(x, y, real(-1.0))) + shift
            if local[2] < real(0.0):
                at = project(buffer, local)
                if at[0] > real(-1.0) and at[0] < real(buffer.width + 1):
                    if at[1] > real(-1.0) and at[1] < real(buffer.height + 1):
                        # Rounded down: what is rounded towards 0 is made positive before.
                        left = int(at[0] + real(1.5)) - 2
                        above = int(at[1] + real(1.5)) - 2
                        for corner in range(4):
                            u = left + corner % 2
                            v = above + corner // 2
                            if u >= 0 and u < buffer.width and v >= 0 and v < buffer.height:
                                wp.atomic_min(out_depths, v * buffer.width + u, -local[2])


@wp.func
def pixel_at(pixels: wp.array(dtype=wp.uint8), i: int) -> vec3:
    """The colour of pixel i, in [0, 255]."""
    return vec3(real(pixels[3 * i]), real(pixels[3 * i + 1]), real(pixels[3 * i + 2]))


@wp.func
def mixed(pixels: wp.array(dtype=wp.uint8), view: Pinhole, u: real, v: real) -> vec3:
    """The colour at image position (u, v), by bilinear interpolation, in [0, 255]."""
    x = wp.clamp(u - real(0.5), real(0.0), real(view.width - 1))
    y = wp.clamp(v - real(0.5), real(0.0), real(view.height - 1))
    column = int(x)
    row = int(y)
    right = wp.where(column + 1 < view.width, 1, 0)
    below = wp.where(row + 1 < view.height, view.width, 0)
    i = row * view.width + column
    a = x - real(column)
    b = y - real(row)
    upper = (real(1.0) - a) * pixel_at(pixels, i) + a * pixel_at(pixels, i + right)
    i += below
    lower = (real(1.0) - a) * pixel_at(pixels, i) + a * pixel_at(pixels, i + right)
    return (real(1.0) - b) * upper + b * lower


@wp.func
def depth_beside(depths: wp.array(dtype=real), view: Pinhole, i: int) -> real:
    """The farthest depth of the nearest pixels that have one, in four directions, within CRACK."""
    found = real(wp.static(NOTHING))
    column = i % view.width
    row = i // view.width
    for r in range(1, wp.static(CRACK + 1)):
        farthest = real(0.0)
        for side in range(4):
            along = r - 2 * r * (side % 2)
            x = column + wp.where(side < 2, along, 0)
            y = row + wp.where(side < 2, 0, along)
            if x >= 0 and x < view.width and y >= 0 and y < view.height:
                depth = depths[y * view.width + x]
                if depth < real(wp.static(NOTHING)):
                    farthest = wp.max(farthest, depth)
        if farthest > real(0.0):
            found = farthest
            break
    return found


@wp.func
def distances_around(distances: wp.array(dtype=real), view: Pinhole, u: real, v: real) -> vec2:
    """The least and the greatest of the distances around image position (u, v)."""
    column = wp.max(int(u - real(0.5)), 0)
    row = wp.max(int(v - real(0.5)), 0)
    right = wp.min(column + 1, view.width - 1)
    below = wp.min(row + 1, view.height - 1)
    a = distances[row * view.width + column]
    b = distances[row * view.width + right]
    c = distances[below * view.width + column]
    d = distances[below * view.width + right]
    return vec2(wp.min(wp.min(a, b), wp.min(c, d)), wp.max(wp.max(a, b), wp.max(c, d)))


@wp.kernel
def inverse_warp(
    # launch
    first: int,  # an item is a row of the target
    # scene
    source: Pinhole,
    target: Pinhole,
    buffer: Pinhole,  # the target's camera, with the pixels of the depth buffer
    pixels: wp.array(dtype=wp.uint8),  # [H * W * 3] of the source
    distances: wp.array(dtype=real),  # [H * W] of the source, as of splat_depths
    depths: wp.array(dtype=real),  # of the buffer, by splat_depths
    # out
    out_pixels: wp.array(dtype=wp.uint8),  # [h * w * 3]
    out_seen: wp.array(dtype=wp.uint8),  # [h * w] 1: the source shows it; 0: it is made up
):
    """The target's pixels, read from the source where the surface of each is seen there."""
    row = first + wp.tid()
    # In the source's axes: rays of this row, 1 long along the target's axis, and where they begin.
    turn = wp.transpose(source.rotation) * target.rotation
    shift = wp.transpose(source.rotation) * (target.position - source.position)
    y = (target.principal[1] - real(row) - real(0.5)) / target.focal[1]
    across = real(1.0) / target.focal[0]
    for column in range(target.width):
        i = row * target.width + column
        seen = wp.uint8(0)
        near = (row // wp.static(COARSE)) * buffer.width + column // wp.static(COARSE)
        depth = depths[near]
        if depth >= real(wp.static(NOTHING)):
            depth = depth_beside(depths, buffer, near)
        if depth < real(wp.static(NOTHING)):
            x = (real(column) + real(0.5) - target.principal[0]) * across
            ray = turn * vec3(x, y, real(-1.0))
            for _ in range(wp.static(TRIES)):
                point = depth * ray + shift
                if point[2] >= real(0.0):
                    break
                at = project(source, point)
                if at[0] < real(0.0) or at[0] >= real(source.width):
                    break
                if at[1] < real(0.0) or at[1] >= real(source.height):
                    break
                between = distances_around(distances, source, at[0], at[1])
                if between[0] <= real(0.0):
                    break
                # Squares: a root takes as long as all else.
                square = wp.dot(point, point)
                if square * real(wp.static((1.0 + TOLERANCE) ** 2)) > between[0] * between[0]:
                    if square * real(wp.static((1.0 - TOLERANCE) ** 2)) < between[1] * between[1]:
                        colour = mixed(pixels, source, at[0], at[1])
                        for channel in range(3):
                            out_pixels[3 * i + channel] = wp.uint8(colour[channel] + real(0.5))
                        seen = wp.uint8(1)
                        break
                there = distances[int(at[1]) * source.width + int(at[0])]
                nearer = (there - wp.sqrt(square)) / wp.length(ray)
                depth = wp.max(depth + nearer, real(1.0e-6))
        out_seen[i] = seen
