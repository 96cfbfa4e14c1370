"""Factors: planes and lines whose products a matrix decodes, the VM decomposition of TensoRF.

    raw(x, y, z) = M^T [P_xy(x, y) L_z(z), P_xz(x, z) L_y(y), P_yz(y, z) L_x(x)]

Each plane has an entry of `width` numbers at every node of two axes of the lattice, bilinear in
between, each line one at every node of the third, linear in between; products are taken number by
number. The decoder M, [3 width, columns], is learned. Source: Chen et al. 2022 (ECCV), whose M is 1
from density's numbers to the raw density, and 0 from the others.

At the nodes of the lattice a product is that of two entries, and in a cell of the lattice it is
trilinear. So raw values are the trilinear interpolation of those at the nodes, as a dense grid's.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.atomics import add_to
from ..base.parts import Encoding
from ..base.tiles import tile_of
from ..base.types import real, vec3, vector
from ..networks.mlp import add_weight
from .decoder import columns_of, density_column
from .factor_packs import vectors_of
from .interp import lowest_node, place_along

wp.set_module_options({"enable_backward": False})


@cache
def factors_type(width: int) -> type:
    """Factors as kernels take them."""
    Entry = vector(width)

    @wp.struct
    class Factors:
        planes: wp.array(dtype=Entry)  # [X Y + X Z + Y Z] xy, xz, yz; second axis fastest
        lines: wp.array(dtype=real)  # [(Z + Y + X) width] that of each plane's third axis
        decoder: wp.array(dtype=real)  # [3 width columns] row by row
        transposed: wp.array2d(
            dtype=real
        )  # [n_workers, columns 3 width] scratch of the vector form
        size: wp.vec3i  # X, Y, Z, each >= 2
        to_nodes: vec3  # contracted coordinates to grid coordinates: u = c to_nodes + middle
        middle: vec3  # grid coordinates of the centre, (size - 1) / 2
        width: int  # of an entry
        n_decoded: int  # numbers of raw that are decoded; the others are padding

    return Factors


@cache
def gradient_type(width: int) -> type:
    """The gradient of a loss with respect to factors, and to the weights of a head."""

    @wp.struct
    class Gradient:
        planes: wp.array(dtype=vector(width))  # [X Y + X Z + Y Z]
        touched: wp.array(
            dtype=wp.uint8
        )  # [n_tiles] 1 where a pair of entries begins that got some
        lines: wp.array2d(dtype=real)  # [n_workers, (Z + Y + X) width] a copy for each worker
        decoder: wp.array2d(dtype=real)  # [n_workers, 3 width columns] likewise
        weights: wp.array2d(dtype=real)  # [n_workers, n_weights] likewise

    return Gradient


@wp.struct
class Corner:
    """Where a position lies in a plane and in its line."""

    entry: int  # the lowest of the plane's four entries around
    row: int  # entries of a row of the plane
    across: real  # position between the two rows, [0, 1]
    along: real  # position between the two entries of a row, [0, 1]
    line: int  # the lower of the line's two entries around
    up: real  # position between these, [0, 1]


@wp.func
def corner_of(params: Any, position: vec3, plane: int) -> Corner:
    """Where a position lies in plane 0, 1 or 2 and in its line."""
    size = params.size
    u = wp.cw_mul(position, params.to_nodes) + params.middle
    node = lowest_node(u, size)
    a = wp.where(plane == 2, 1, 0)
    b = wp.where(plane == 0, 1, 2)
    c = 2 - plane
    begin = wp.where(plane == 0, 0, size[0] * (size[1] + wp.where(plane == 1, 0, size[2])))
    at = Corner()
    at.row = size[b]
    at.entry = begin + node[a] * at.row + node[b]
    at.across = u[a] - real(node[a])
    at.along = u[b] - real(node[b])
    at.line = wp.where(plane == 0, 0, size[2] + wp.where(plane == 1, 0, size[1])) + node[c]
    at.up = u[c] - real(node[c])
    return at


@wp.func
def on_line(params: Any, at: Corner, n: int) -> real:
    """The mean of a line's two entries around a position, their number n."""
    low = at.line * params.width + n
    return (real(1.0) - at.up) * params.lines[low] + at.up * params.lines[low + params.width]


@wp.func
def place(params: Any, position: vec3) -> vec3:
    """Where a position lies in the lattice, [0, 1]^3."""
    u = wp.cw_mul(position, params.to_nodes) + params.middle
    return wp.cw_div(u, real(2.0) * params.middle)


@wp.func
def in_plane(params: Any, at: Corner):
    """The mean of a plane's four entries around a position, by where it lies between them."""
    n = at.entry
    rest = real(1.0) - at.along
    low = rest * params.planes[n] + at.along * params.planes[n + 1]
    high = rest * params.planes[n + at.row] + at.along * params.planes[n + at.row + 1]
    return (real(1.0) - at.across) * low + at.across * high


@wp.func
def adj_in_plane(at: Corner, adj: Any, gradient: Any):
    """Transpose of in_plane. Additions are atomic on CUDA; on the CPU one thread may call this."""
    n = at.entry
    gradient.touched[tile_of(n)] = wp.uint8(1)
    gradient.touched[tile_of(n + at.row)] = wp.uint8(1)
    high = at.across * adj
    low = adj - high
    add_to(gradient.planes, n, (real(1.0) - at.along) * low)
    add_to(gradient.planes, n + 1, at.along * low)
    add_to(gradient.planes, n + at.row, (real(1.0) - at.along) * high)
    add_to(gradient.planes, n + at.row + 1, at.along * high)


@cache
def factors(width: int, n_floats: int, n_decoded: int, by_sample: bool = False) -> Encoding:
    """The encoding whose entries hold so many numbers.

    Args:
        width: Of an entry, a multiple of 16.
        n_floats: Of a sample: 4, 8, 16, 32 or 64.
        n_decoded: How many of these are not padding.
        by_sample: Whether packs hold values after the first four sample by sample.
    """
    Factors, Gradient, Raw, Entry = (
        factors_type(width),
        gradient_type(width),
        vector(n_floats),
        vector(width),
    )
    columns = columns_of(n_floats)

    # Loops run to a number that compilers do not know, as in networks.mlp.

    @wp.func
    def read(params: Factors, position: vec3) -> Raw:
        """Raw values at a position."""
        n_numbers, n_decoded = params.width, params.n_decoded
        raw = Raw()
        for plane in range(3):
            at = corner_of(params, position, plane)
            around = in_plane(params, at)
            for n in range(n_numbers):
                product = around[n] * on_line(params, at, n)
                row = (plane * width + n) * columns
                for o in range(n_decoded):
                    raw[o] += product * params.decoder[row + o]
        return raw

    @wp.func
    def adj_read(params: Factors, position: vec3, adj_raw: Raw, gradient: Gradient):
        """Transpose of read."""
        n_numbers, n_decoded = params.width, params.n_decoded
        for plane in range(3):
            at = corner_of(params, position, plane)
            around = in_plane(params, at)
            adj = Entry()
            for n in range(n_numbers):
                line = on_line(params, at, n)
                row = (plane * width + n) * columns
                adj_product = real(0.0)
                for o in range(n_decoded):
                    adj_product += adj_raw[o] * params.decoder[row + o]
                    add_weight(gradient.decoder, row + o, around[n] * line * adj_raw[o])
                adj[n] = adj_product * line
                adj_line = adj_product * around[n]
                low = at.line * width + n
                add_weight(gradient.lines, low, (real(1.0) - at.up) * adj_line)
                add_weight(gradient.lines, low + width, at.up * adj_line)
            adj_in_plane(at, adj, gradient)

    return Encoding(
        n_floats=n_floats,
        Params=Factors,
        Gradient=Gradient,
        read=read,
        adj_read=adj_read,
        place=place,
        vectors=vectors_of(width, n_floats, n_decoded, columns, by_sample),
    )


@cache
def node_densities_kernel(width: int) -> wp.Kernel:
    """Raw densities at nodes of the lattice."""
    Factors, Entry, Density = factors_type(width), vector(width), vector(1)
    column = density_column(width)

    @wp.func
    def on_node(params: Factors, entry: int) -> Entry:
        """An entry of a line."""
        n_numbers = params.width
        out = Entry()
        for n in range(n_numbers):
            out[n] = params.lines[entry * width + n]
        return out

    @wp.kernel(module="unique", enable_backward=False)
    def node_densities(
        # launch
        first: int,
        # scene
        params: Factors,
        # choices
        columns: int,  # of the decoder
        begin: int,  # row of nodes along z that is the first of out
        # out
        out: wp.array(dtype=Density),  # [n_rows * Z]
    ):
        """Raw densities at the nodes of a row along z: fields.factors.read there."""
        size = params.size
        row = first + wp.tid()
        i = (begin + row) // size[1]
        j = (begin + row) % size[1]
        xz = size[0] * size[1] + i * size[2]
        yz = size[0] * (size[1] + size[2]) + j * size[2]
        of_xy = wp.cw_mul(params.planes[begin + row], column(params, 0, columns))
        line = on_node(params, size[2] + j)
        of_y = wp.cw_mul(line, column(params, 1, columns))
        line = on_node(params, size[2] + size[1] + i)
        of_x = wp.cw_mul(line, column(params, 2, columns))
        for k in range(size[2]):
            raw = wp.dot(of_xy, on_node(params, k))
            raw += wp.dot(params.planes[xz + k], of_y) + wp.dot(params.planes[yz + k], of_x)
            out[row * size[2] + k] = Density(raw)

    return node_densities


@cache
def resample_kernel(dtype: type) -> wp.Kernel:
    """An array read at other places along one of its axes."""

    @wp.kernel(module="unique", enable_backward=False)
    def resample(
        # launch
        first: int,
        # scene
        values: wp.array(dtype=dtype),  # [outer * size * inner]
        # choices
        size: int,  # of the axis
        inner: int,  # how far neighbours along the axis lie apart
        scale: real,  # u on the old axis = u on the new one * scale + offset
        offset: real,
        # out
        out_size: int,  # of the axis
        out_values: wp.array(dtype=dtype),  # [outer * out_size * inner]
    ):
        n = first + wp.tid()
        low, share = place_along(size, inner, scale, offset, out_size, n)
        out_values[n] = (real(1.0) - share) * values[low] + share * values[low + inner]

    return resample
