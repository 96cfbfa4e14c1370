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

CRACK = 3
"""Pixels: how far from a splatted point a stretched surface may show none."""


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
def direction_of(view: Pinhole, u: real, v: real) -> vec3:
    """The ray through image position (u, v) in world axes, 1 long along the camera's axis."""
    x = (u - view.principal[0]) / view.focal[0]
    y = (v - view.principal[1]) / view.focal[1]
    return view.rotation * vec3(x, -y, real(-1.0))


@wp.func
def project(view: Pinhole, point: vec3) -> vec3:
    """Image position of a point, in pixels, and its depth along the axis; not in front: <= 0."""
    local = wp.transpose(view.rotation) * (point - view.position)
    depth = -local[2]
    inverse = real(1.0) / wp.max(depth, real(1.0e-12))
    return vec3(
        view.focal[0] * local[0] * inverse + view.principal[0],
        view.principal[1] - view.focal[1] * local[1] * inverse,
        depth,
    )


@wp.kernel
def splat_depths(
    # launch
    first: int,
    # scene
    source: Pinhole,
    target: Pinhole,
    distances: wp.array(dtype=real),  # [H * W] of the source, along rays, scene units; <= 0: none
    # out
    out_depths: wp.array(dtype=real),  # [h * w] of the target, along its axis; NOTHING before
):
    """The depth buffer of the target: each point of the source covers the four nearest pixels."""
    i = first + wp.tid()
    distance = distances[i]
    if distance <= real(0.0):
        return
    ray = direction_of(
        source, real(i % source.width) + real(0.5), real(i // source.width) + real(0.5)
    )
    at = project(target, source.position + distance * wp.normalize(ray))
    if at[2] <= real(0.0):
        return
    if at[0] < real(-1.0) or at[0] > real(target.width) + real(1.0):
        return
    if at[1] < real(-1.0) or at[1] > real(target.height) + real(1.0):
        return
    column = int(wp.floor(at[0] - real(0.5)))
    row = int(wp.floor(at[1] - real(0.5)))
    for corner in range(4):
        x = column + corner % 2
        y = row + corner // 2
        if x >= 0 and x < target.width and y >= 0 and y < target.height:
            wp.atomic_min(out_depths, y * target.width + x, at[2])


@wp.func
def mixed(pixels: wp.array(dtype=wp.uint8), view: Pinhole, u: real, v: real, channel: int) -> real:
    """A channel at image position (u, v), by bilinear interpolation, in [0, 255]."""
    x = wp.clamp(u - real(0.5), real(0.0), real(view.width - 1))
    y = wp.clamp(v - real(0.5), real(0.0), real(view.height - 1))
    column = wp.min(int(x), wp.max(view.width - 2, 0))
    row = wp.min(int(y), wp.max(view.height - 2, 0))
    right = wp.min(column + 1, view.width - 1)
    below = wp.min(row + 1, view.height - 1)
    a = x - real(column)
    b = y - real(row)
    upper = (real(1.0) - a) * real(pixels[3 * (row * view.width + column) + channel])
    upper += a * real(pixels[3 * (row * view.width + right) + channel])
    lower = (real(1.0) - a) * real(pixels[3 * (below * view.width + column) + channel])
    lower += a * real(pixels[3 * (below * view.width + right) + channel])
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
    first: int,
    # scene
    source: Pinhole,
    target: Pinhole,
    pixels: wp.array(dtype=wp.uint8),  # [H * W * 3] of the source
    distances: wp.array(dtype=real),  # [H * W] of the source, as of splat_depths
    depths: wp.array(dtype=real),  # [h * w] of the target, by splat_depths
    # out
    out_pixels: wp.array(dtype=wp.uint8),  # [h * w * 3]
    out_seen: wp.array(dtype=wp.uint8),  # [h * w] 1: the source shows it; 0: it is made up
):
    """The target's pixels, read from the source where the surface of each is seen there."""
    i = first + wp.tid()
    out_seen[i] = wp.uint8(0)
    depth = depths[i]
    if depth >= real(wp.static(NOTHING)):
        depth = depth_beside(depths, target, i)
        if depth >= real(wp.static(NOTHING)):
            return
    ray = direction_of(
        target, real(i % target.width) + real(0.5), real(i // target.width) + real(0.5)
    )
    stretch = wp.length(ray)
    ray = ray / stretch
    t = depth * stretch
    for _ in range(wp.static(TRIES)):
        point = target.position + t * ray
        at = project(source, point)
        if at[2] <= real(0.0):
            break
        if at[0] < real(0.0) or at[0] >= real(source.width):
            break
        if at[1] < real(0.0) or at[1] >= real(source.height):
            break
        expected = wp.length(point - source.position)
        between = distances_around(distances, source, at[0], at[1])
        if between[0] <= real(0.0):
            break
        slack = real(wp.static(TOLERANCE)) * expected
        if expected > between[0] - slack and expected < between[1] + slack:
            for channel in range(3):
                value = mixed(pixels, source, at[0], at[1], channel)
                out_pixels[3 * i + channel] = wp.uint8(value + real(0.5))
            out_seen[i] = wp.uint8(1)
            break
        there = distances[int(at[1]) * source.width + int(at[0])]
        t = wp.max(t + there - expected, real(1.0e-6))
