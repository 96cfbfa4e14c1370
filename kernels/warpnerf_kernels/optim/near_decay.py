"""How far updates lower densities besides: the further, the nearer the cameras are that see them.

    decay = strength (1 - S),    S = sum_c n_c min(1, d_c^2 / D_c^2) / sum_c n_c

over the cameras c whose frustum holds a place, at the distance d_c, of which n_c = fx fy / d_c^2
pixels see a unit area there; D_c is their content distance.
"""

import warp as wp

from ..base.types import mat33, real, vec2, vec3

wp.set_module_options({"enable_backward": False})

CLOSEST = 1e-3
"""In content distances: places nearer to a camera count as being there."""


@wp.struct
class Observer:
    """A training camera, by what it sees."""

    position: vec3
    axes: mat33  # rows: right, down, forward
    low: vec2  # of its picture on the plane at depth 1, towards right and down
    high: vec2
    fisheye: int  # 1: it sees all within an angle to its axis; low and high count for nothing
    cosine: real  # of that angle
    pixels: real  # of a unit area at distance 1 that faces it: fx fy
    content_distance: real


@wp.func
def sees(camera: Observer, away: vec3, margin: real) -> bool:
    """Whether a frustum, grown by a margin, holds a place that lies so far from its apex."""
    place = camera.axes * away
    depth = place[2]
    if camera.fisheye == 1:
        return depth + margin > camera.cosine * wp.length(away)
    right = place[0] > camera.low[0] * depth - margin and place[0] < camera.high[0] * depth + margin
    down = place[1] > camera.low[1] * depth - margin and place[1] < camera.high[1] * depth + margin
    return depth > -margin and right and down


@wp.kernel(enable_backward=False)
def find_near_decay(
    # launch
    first: int,
    # scene
    places: wp.array(dtype=vec3),  # [n] scene units
    margins: wp.array(dtype=real),  # [n] by which frusta are grown there, scene units
    cameras: wp.array(dtype=Observer),  # [n_cameras]
    # choices
    near: real,  # rays begin at this distance, scene units
    strength: real,  # where all see it from their position
    # out
    out_decay: wp.array(dtype=real),  # [n] 0 where none sees it
):
    """How far updates lower the densities at some places."""
    n = first + wp.tid()
    rays = real(0.0)
    scaled = real(0.0)
    for c in range(cameras.shape[0]):
        camera = cameras[c]
        away = places[n] - camera.position
        square = wp.dot(away, away)
        if square >= near * near and sees(camera, away, margins[n]):
            unit = camera.content_distance * camera.content_distance
            square = wp.max(square, real(wp.static(CLOSEST * CLOSEST)) * unit)
            rays += camera.pixels / square
            scaled += camera.pixels / wp.max(square, unit)
    out_decay[n] = real(0.0)
    if rays > real(0.0):
        out_decay[n] = strength * (real(1.0) - scaled / rays)
