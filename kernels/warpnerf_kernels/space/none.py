"""Space as it is, of which nothing outside the box is sampled."""

import warp as wp

from ..base.parts import Space, SpaceVectors
from ..base.types import Box, Ray, real, vec2, vec3

wp.set_module_options({"enable_backward": False})


@wp.func
def enter(box: Box, ray: Ray, origin: vec3, interval: vec2):
    """The ray in the box's coordinates; t is the distance."""
    ray.q_origin = wp.cw_div(origin - box.centre, box.half)
    ray.q_direction = wp.cw_div(ray.direction, box.half)
    return ray, interval


@wp.func
def contract(box: Box, q: vec3) -> vec3:
    """c = q."""
    return q


@wp.func
def det_jacobian(box: Box, q: vec3) -> real:
    """That of the identity."""
    return real(1.0)


@wp.func
def boxes_out(box: Box, c: vec3) -> real:
    """All is in the box."""
    return real(0.0)


@wp.func
def distance_of(ray: Ray, t: real) -> real:
    """t is the distance."""
    return t


@wp.func
def length_of(ray: Ray, distance: real, dt: real) -> real:
    """Steps are as long as they are."""
    return dt


@wp.func
def ends(box: Box, distance: real) -> bool:
    """Steps end where the march says."""
    return False


WITHIN = r"""
active &= (abs(qx) <= 1.0f) & (abs(qy) <= 1.0f) & (abs(qz) <= 1.0f);
"""

NONE = Space(
    contracts=False,
    enter=enter,
    contract=contract,
    det_jacobian=det_jacobian,
    boxes_out=boxes_out,
    distance_of=distance_of,
    length_of=length_of,
    ends=ends,
    vectors=SpaceVectors(locate=WITHIN),
)
"""The space of bounded scenes."""
