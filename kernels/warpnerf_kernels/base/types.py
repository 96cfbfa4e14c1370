"""Number types and the structs that kernels share.

Grids are [X, Y, Z] with z fastest. Lengths are scene units. ``q`` are normalised coordinates, in
which the box is [-1, 1]^3; ``c`` are these after folding, within [-(1 + border), 1 + border]^3;
``u`` are grid coordinates, in which node (i, j, k) sits at (i, j, k).
"""

from functools import cache
from typing import Any

import warp as wp

real = wp.float64 if __name__.startswith("warpnerf_kernels_float64") else wp.float32
vec2 = wp.types.vector(2, real)
vec3 = wp.types.vector(3, real)
mat33 = wp.types.matrix((3, 3), real)


@cache
def vector(n: int) -> type:
    """n numbers: what a node stores, features, channels, units of a layer."""
    return wp.types.vector(n, real)


def struct(name: str, fields: dict[str, Any], module: str) -> type:
    """A Warp struct whose fields depend on what it is made for.

    Args:
        name: Of the struct.
        fields: Names and types.
        module: Name of the Python module that makes it.
    """
    return wp.struct(type(name, (), {"__annotations__": fields, "__module__": module}))


@wp.struct
class Nothing:
    """What a part reads that has no parameters."""

    unused: int


@wp.struct
class Density:
    """From raw to density: sigma = scale softplus(raw + shift)."""

    shift: real
    scale: real  # 1 / scene unit


@wp.struct
class Frustum:
    """The frame of normalised device coordinates, see space.ndc; not used in others."""

    origin: vec3  # centre of projection, scene units
    axes: mat33  # rows: right, down, forward
    near: real  # depth of the near plane, scene units
    depth: real  # z of what is infinitely far
    begin: real  # nothing is sampled nearer to the ray's origin than this, scene units
    end: real  # nor at or beyond this


@wp.struct
class Box:
    """The region that is trained, and how space outside of it is contracted into a shell around it.

    Its coordinates are those of the scene, or those of the frustum.
    """

    centre: vec3
    half: vec3  # half of its edges
    border: real  # width of the shell, in half edges; 0 without contraction
    frustum: Frustum


@wp.struct
class FreeSpace:
    """Where nothing needs sampling: over the contracted box, cells of their own size."""

    distance: wp.array(dtype=wp.uint8)  # [MX * MY * MZ] cells to the nearest occupied one, 0 there
    size: wp.vec3i  # MX, MY, MZ
    to_cells: vec3  # contracted coordinates to cells: m = c to_cells + size / 2


@cache
def gradient_type(n_floats: int) -> type:
    """The gradient of a loss with respect to what a field stores, and to the weights of a head."""

    @wp.struct
    class Gradient:
        values: wp.array(dtype=vector(n_floats))  # [n_nodes]
        touched: wp.array(dtype=wp.uint8)  # [n_tiles] 1 where a pair of nodes begins that got some
        weights: wp.array2d(dtype=real)  # [n_workers, n_weights] a copy for each worker

    return Gradient


@wp.struct
class Rays:
    """Rays of a launch."""

    origins: wp.array(dtype=vec3)  # [n_rays] scene units
    directions: wp.array(dtype=vec3)  # [n_rays] unit vectors
    offsets: wp.array(dtype=real)  # [n_rays] or [1], in [0, 1)
    background: wp.array(dtype=vec3)  # [n_rays] or [1], rgb in [0, 1]
    content_distance: wp.array(dtype=real)  # [n_rays] or [1], scene units; for gradients


@wp.struct
class Line:
    """Where a ray enters a frustum, see space.ndc; not used without one."""

    t: real  # distance there from the ray's origin, scene units
    w: real  # depth there, scene units
    slope: real  # depth for each unit of distance
    speed: real  # how long de/d(t' / w) is


@wp.struct
class Ray:
    """A ray prepared for one box: q(t) = q_origin + t q_direction.

    In a frustum t is a length in its coordinates; samples have their distance in the scene.
    """

    index: int  # in its launch
    q_origin: vec3
    q_direction: vec3
    direction: vec3  # unit, in the scene
    offset: real  # where in its step a sample sits, [0, 1]; 0.5 is the midpoint
    begin: int  # first step that can lie in the box
    end: int  # one past the last
    line: Line


@wp.struct
class Sample:
    """A visited step."""

    step: int
    t: real  # distance from the ray's origin, scene units
    dt: real  # step length, in the coordinates of the box
    det_jacobian: real  # |det J| of the contraction, 1 without
    position: vec3  # contracted coordinates c
