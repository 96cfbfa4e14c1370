"""Normalised device coordinates: space before a plane as a box, for forward-facing captures.

With (x, y, w) a point in the frame of the frustum (right, down, forward), n its near plane:

    e = (x / w, y / w, depth (1 - n / w))        from w = n, e_z = 0, to infinity, e_z = depth

Lines stay lines, so a ray is e(s) = e_0 + s direction, with s its length in these coordinates, and
is marched in them as in space that is not warped. Where s lies in the scene is a quotient: with the
ray's depth w and slope dw/dt where it enters, at t,

    t(s) = t + s w / (speed - s slope)

Source: Mildenhall et al. 2020, appendix C; Sun et al. 2022 (DVGOv2, multiplane images).
"""

import warp as wp

from ..base.parts import SpaceVectors
from ..base.types import Box, Frustum, Line, Ray, real, vec2, vec3
from .none import NONE, WITHIN

wp.set_module_options({"enable_backward": False})

FARTHEST = 1000.0
"""Depth of the far plane, where the grid ends, in near planes: with cameras half a near plane apart
and a focal length of 500 pixels, what is infinitely far is a quarter of a pixel beside it."""

LEAST = 0.5 / FARTHEST
"""No sample has a smaller share of its ray's speed left: the pole lies beyond the far plane."""


@wp.func
def line_in(frustum: Frustum, origin: vec3, direction: vec3):
    """Where a ray passes the near plane, or begins beyond it: its line, e_0 and its direction in e.

    A ray that never does is outside all along: before the near plane, or behind the far one.
    """
    line = Line()
    p = frustum.axes * (origin - frustum.origin)
    d = frustum.axes * direction
    line.slope = d[2]
    line.t = frustum.begin
    line.w = p[2] + line.t * line.slope
    if line.w < frustum.near and line.slope > real(0.0):
        line.t = (frustum.near - p[2]) / line.slope
        line.w = frustum.near
    p += line.t * d
    # e is straight in (t' / w), t' the distance from where the line begins:
    share = line.slope / line.w
    velocity = vec3(d[0] - p[0] * share, d[1] - p[1] * share, frustum.depth * frustum.near * share)
    line.speed = wp.length(velocity)
    velocity /= line.speed
    place = vec3(p[0] / line.w, p[1] / line.w, frustum.depth * (real(1.0) - frustum.near / line.w))
    return line, place, velocity


@wp.func
def distance_at(line: Line, s: real) -> real:
    """t(s), scene units; where the ray is beyond the far plane, some distance beyond it."""
    left = wp.max(line.speed - s * line.slope, real(wp.static(LEAST)) * line.speed)
    return line.t + s * line.w / left


@wp.func
def length_to(line: Line, t: real) -> real:
    """s(t), the inverse of distance_at; very long for a ray that turned back before."""
    w = line.w + (t - line.t) * line.slope
    if w <= real(0.0):
        return real(1.0e30)
    return line.speed * ((t - line.t) / w)


@wp.func
def stretch_at(line: Line, t: real) -> real:
    """dt/ds at distance t."""
    w = line.w + (t - line.t) * line.slope
    return w * w / (line.w * line.speed)


@wp.func
def enter(box: Box, ray: Ray, origin: vec3, interval: vec2):
    """The ray in the box's coordinates, up to where it is as far away as is sampled.

    There t is a length in the frustum's coordinates, from where the ray enters it.
    """
    line, place, along = line_in(box.frustum, origin, ray.direction)
    ray.line = line
    ray.q_origin = wp.cw_div(place - box.centre, box.half)
    ray.q_direction = wp.cw_div(along, box.half)
    return ray, vec2(interval[0], wp.min(interval[1], length_to(line, box.frustum.end)))


@wp.func
def distance_of(ray: Ray, t: real) -> real:
    """t(s), with s what steps are placed by."""
    return distance_at(ray.line, t)


@wp.func
def length_of(ray: Ray, distance: real, dt: real) -> real:
    """Of a step that is dt long in the frustum's coordinates."""
    return dt * stretch_at(ray.line, distance)


@wp.func
def ends(box: Box, distance: real) -> bool:
    """Steps know no distances, so the frustum says how far they go."""
    return distance >= box.frustum.end


DISTANCE = r"""
const vec left = max(ray.line.speed - t * ray.line.slope, splat(LEAST * ray.line.speed));
t = ray.line.t + t * ray.line.w / left;
active &= t < box.frustum.end;
""".replace("LEAST", f"{LEAST!r}f")

LENGTH = r"""
const vec w = ray.line.w + (t - ray.line.t) * ray.line.slope;
length *= w * w / (ray.line.w * ray.line.speed);
"""

NDC = NONE._replace(
    enter=enter,
    distance_of=distance_of,
    length_of=length_of,
    ends=ends,
    vectors=SpaceVectors(locate=WITHIN, distance=DISTANCE, length=LENGTH),
)
"""The space of forward-facing captures: in the frustum's coordinates nothing is contracted."""
