"""Number types and the structs that kernels share.

Grids are [X, Y, Z] with z fastest. Lengths are scene units. ``q`` are normalised coordinates, in
which the box is [-1, 1]^3; ``u`` are grid coordinates, in which node (i, j, k) sits at (i, j, k).
"""

import warp as wp

real = wp.float64 if __name__.startswith("warpnerf_kernels_float64") else wp.float32
vec2 = wp.types.vector(2, real)
vec3 = wp.types.vector(3, real)
vec4 = wp.types.vector(4, real)
mat33 = wp.types.matrix((3, 3), real)


@wp.struct
class Grid:
    """A dense grid of raw values over a box."""

    values: wp.array(dtype=vec4)  # [X * Y * Z] raw density, raw rgb
    size: wp.vec3i  # X, Y, Z, each >= 2
    centre: vec3  # of the box
    half: vec3  # half the box's edges
    border: real  # width of the contracted shell, in half edges; 0 without contraction
    to_nodes: vec3  # contracted normalised coordinates to grid coordinates: u = c to_nodes + middle
    middle: vec3  # grid coordinates of the centre, (size - 1) / 2
    density_shift: real  # sigma = density_scale softplus(raw density + density_shift)
    density_scale: real  # 1 / scene unit


@wp.struct
class Gradient:
    """The gradient of a loss with respect to a grid's values; see tiles.py."""

    values: wp.array(dtype=vec4)  # [X * Y * Z]
    touched: wp.array(dtype=wp.uint8)  # [n_tiles] 1 where a pair of nodes begins that got some


@wp.struct
class FreeSpace:
    """Where nothing needs sampling: over the grid's domain, cells of their own size."""

    distance: wp.array(dtype=wp.uint8)  # [MX * MY * MZ] cells to the nearest occupied one, 0 there
    size: wp.vec3i  # MX, MY, MZ
    to_cells: vec3  # contracted normalised coordinates to cells: m = c to_cells + size / 2


@wp.struct
class March:
    """How rays are stepped. Edge k of the steps lies at ``step_edge(march, k)``."""

    near: real  # where step 0 begins
    far: real  # no sample at or beyond it
    step: real  # step length up to edge ``n_linear``
    growth: real  # from there on each step is (1 + growth) times the one before; 0: never
    n_linear: int  # steps of equal length
    transmittance_min: real  # nothing is sampled once less light than this passes


@wp.struct
class Ray:
    """A ray prepared for one grid: q(t) = q_origin + t q_direction."""

    q_origin: vec3
    q_direction: vec3
    offset: real  # where in its step a sample sits, [0, 1]; 0.5 is the midpoint
    begin: int  # first step that can lie in the box
    end: int  # one past the last


@wp.struct
class Sample:
    """A visited step: where it is, and what the grid holds there."""

    step: int
    t: real  # distance from the ray's origin
    dt: real  # step length
    det_jacobian: real  # |det J| of the contraction, 1 without
    base: int  # flat index of the lowest of the eight nodes around
    fraction: vec3  # position between the nodes, [0, 1]
    sigma: real  # 1 / scene unit
    sigma_slope: real  # d sigma / d raw density
    attenuation: real  # exp(-sigma dt)
    rgb: vec3  # [0, 1]


@wp.struct
class Integral:
    """What a ray has gathered."""

    rgb: vec3  # without background
    depth: real  # sum of weight times t
    transmittance: real  # what passes all samples
    n_samples: int
