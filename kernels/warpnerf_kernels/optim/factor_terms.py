"""What regularises factors: total variation of planes, and magnitudes of planes and lines.

    sum_planes [ variation_p sum_c weight_c sum_{neighbours a, b} huber(x_a,c - x_b,c)
                 + magnitude_p sum_c sparsity_c sum_a |x_a,c| ] + magnitude_l sum_lines ...

These are the adjoints, at entries that have a gradient. Neighbours lie in one plane.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.tiles import prefetch, tile_loop
from ..base.types import gradient_type, real, vec3, vector
from .total_variation import adj_huber

wp.set_module_options({"enable_backward": False})


@wp.func
def slope_of_magnitude(x: Any):
    """d |x| / d x of each number."""
    slope = x - x
    for c in range(len(x)):
        slope[c] = wp.where(x[c] == real(0.0), real(0.0), wp.sign(x[c]))
    return slope


@cache
def plane_terms_kernel(width: int) -> wp.Kernel:
    """The adjoint at planes."""
    Entry, Gradient = vector(width), gradient_type(width)

    @wp.struct
    class Entries:
        planes: wp.array(dtype=Entry)
        size: wp.vec3i
        weight: Entry
        variation: vec3
        sparsity: Entry
        magnitude: vec3
        gradient: Gradient

    @wp.func
    def fetch(on: Entries, entry: int):
        prefetch(on.gradient.values, entry)
        prefetch(on.planes, entry)

    @wp.func
    def work(on: Entries, entry: int, begin: int, end: int):
        size = on.size
        xz, yz = size[0] * size[1], size[0] * (size[1] + size[2])
        for n in range(begin, end):
            adj = on.gradient.values[n]
            if not (adj == Entry()):
                plane = wp.where(n < xz, 0, wp.where(n < yz, 1, 2))
                first = wp.where(plane == 0, 0, wp.where(plane == 1, xz, yz))
                n_rows = wp.where(plane == 2, size[1], size[0])
                row = wp.where(plane == 0, size[1], size[2])
                i, j = (n - first) // row, (n - first) % row
                x = on.planes[n]
                pull = Entry()
                if i > 0:
                    pull += adj_huber(x - on.planes[n - row])
                if i + 1 < n_rows:
                    pull += adj_huber(x - on.planes[n + row])
                if j > 0:
                    pull += adj_huber(x - on.planes[n - 1])
                if j + 1 < row:
                    pull += adj_huber(x - on.planes[n + 1])
                adj += on.variation[plane] * wp.cw_mul(on.weight, pull)
                adj += on.magnitude[plane] * wp.cw_mul(on.sparsity, slope_of_magnitude(x))
                on.gradient.values[n] = adj

    over_tiles = tile_loop(fetch, work)

    @wp.kernel(module="unique", enable_backward=False)
    def plane_terms(
        # launch
        first: int,
        span: int,  # entries per thread
        # scene
        planes: wp.array(dtype=Entry),  # [X Y + X Z + Y Z]
        size: wp.vec3i,  # X, Y, Z
        # choices
        weight: Entry,  # of variation, per number
        variation: vec3,  # that times this, for each plane
        sparsity: Entry,  # of magnitudes, per number
        magnitude: vec3,  # that times this, for each plane
        # out
        gradient: Gradient,  # added to where not 0
    ):
        start = (first + wp.tid()) * span
        on = Entries()
        on.planes = planes
        on.size = size
        on.weight = weight
        on.variation = variation
        on.sparsity = sparsity
        on.magnitude = magnitude
        on.gradient = gradient
        over_tiles(on, gradient.touched, start, start + wp.min(span, planes.shape[0] - start))

    return plane_terms


@wp.kernel(enable_backward=False)
def line_terms(
    # launch
    first: int,
    # scene
    lines: wp.array(dtype=real),  # [n_entries * width]
    # choices
    width: int,  # of an entry
    n_sparse: int,  # the first numbers of an entry, whose magnitudes count
    magnitude: real,
    # out
    gradient: wp.array2d(dtype=real),  # [n_workers, n_entries * width] added to where not 0
):
    """The adjoint at lines: of the workers' gradients the first gets it."""
    n = first + wp.tid()
    got = real(0.0)
    for worker in range(gradient.shape[0]):
        got += wp.abs(gradient[worker, n])
    x = lines[n]
    if n % width < n_sparse and got != real(0.0) and x != real(0.0):
        gradient[0, n] += magnitude * wp.sign(x)
