"""Interpolation of an encoding at given points, and its transpose.

For checking the two, and for whatever wants densities at the nodes of a grid.
"""

from functools import cache
from types import SimpleNamespace

import warp as wp

from ..base.parts import Encoding
from ..base.types import real, vec3, vector


@cache
def probe(encoding: Encoding) -> SimpleNamespace:
    """The kernels read_forward, read_backward and read_densities of an encoding."""
    Params, Raw, Gradient = encoding.Params, vector(encoding.n_floats), encoding.Gradient
    read, adj_read, Density = encoding.read, encoding.adj_read, vector(1)

    @wp.kernel(module="unique", enable_backward=False)
    def read_forward(
        # launch
        first: int,
        # scene
        params: Params,
        # rays
        points: wp.array(dtype=vec3),  # [n] contracted coordinates
        # out
        out: wp.array(dtype=Raw),  # [n]
    ):
        i = first + wp.tid()
        out[i] = read(params, points[i])

    @wp.kernel(module="unique", enable_backward=False)
    def read_backward(
        # launch
        first: int,
        # scene
        params: Params,
        # rays
        points: wp.array(dtype=vec3),  # [n] contracted coordinates
        adj_out: wp.array(dtype=Raw),  # [n]
        # out
        gradient: Gradient,  # added to
    ):
        i = first + wp.tid()
        adj_read(params, points[i], adj_out[i], gradient)

    @wp.kernel(module="unique", enable_backward=False)
    def read_densities(
        # launch
        first: int,
        # scene
        params: Params,
        # choices
        size: wp.vec3i,  # X, Y, Z of a grid over the whole field
        reach: real,  # contracted coordinates lie in [-reach, reach]
        # out
        out: wp.array(dtype=Density),  # [X * Y * Z]
    ):
        """Raw densities at the nodes of a grid."""
        n = first + wp.tid()
        k = n % size[2]
        j = (n // size[2]) % size[1]
        i = n // (size[2] * size[1])
        last = vec3(real(size[0] - 1), real(size[1] - 1), real(size[2] - 1))
        share = wp.cw_div(vec3(real(i), real(j), real(k)), last)
        raw = read(params, reach * (real(2.0) * share - vec3(real(1.0))))
        out[n] = Density(raw[0])

    return SimpleNamespace(
        read_forward=read_forward, read_backward=read_backward, read_densities=read_densities
    )
