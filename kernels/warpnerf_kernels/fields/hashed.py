"""A hash: tables of entries by level of resolution, whose numbers a matrix decodes together.

    raw(c) = M^T [E_1(c), E_2(c), ..]                      or, with a hidden layer,
    raw(c) = M^T relu(H^T [E_1(c), E_2(c), ..])

Level l is a lattice of cubes over the field, finer from level to level, and E_l(c) the trilinear
mean of the eight entries around c. Where a level has more nodes than its table may have entries,
rows of nodes along z are hashed as wholes: a row begins where its i and j say, and its k runs on
from there. So the two nodes of a row around a sample lie side by side, as they do in a dense grid,
and in place of eight reads of an entry there are four of a pair. Rows share entries, shifted
against each other, and training finds out who needs them. The decoder M, [levels width, columns] or
[units, columns], and H, [levels width, units], are learned; neither layer has biases.

Source: Mueller et al. 2022 (SIGGRAPH), Instant-NGP, which hashes i, j and k, and has 64 units.
"""

from functools import cache
from typing import Any

import warp as wp

from ..base.atomics import add_to
from ..base.parts import Encoding
from ..base.tiles import tile_of
from ..base.types import real, vec3, vector
from ..networks.mlp import add_weight, relu
from .decoder import columns_of, density_column
from .hashed_packs import PRIME_X, PRIME_Y, vectors_of
from .interp import lowest_node

wp.set_module_options({"enable_backward": False})


@wp.struct
class Level:
    """A lattice of cubes over the field, and its entries."""

    size: wp.vec3i  # nodes along x, y, z, each >= 2
    to_nodes: vec3  # contracted coordinates to those of this lattice: u = c to_nodes + middle
    middle: vec3  # u of the field's centre
    begin: int  # of its entries
    mask: wp.uint32  # where rows may begin, of what hashing gives; 0: each node has its own entry


@cache
def hash_type(width: int) -> type:
    """A hash as kernels take it."""
    Entry = vector(width)

    @wp.struct
    class Hash:
        values: wp.array(dtype=Entry)  # [n_entries] level by level, rows along z
        hidden: wp.array(dtype=real)  # [n_levels width n_units] row by row; none without a layer
        decoder: wp.array(dtype=real)  # [n columns] row by row; n units, or numbers of all levels
        transposed: wp.array2d(dtype=real)  # [n_workers, n] scratch of the vector form
        levels: wp.array(dtype=Level)  # [n_levels] coarsest first
        n_active: int  # levels that are read; finer ones are not, and count as 0
        width: int  # of an entry
        n_units: int  # of the hidden layer
        n_decoded: int  # numbers of raw that are decoded; the others are padding

    return Hash


@cache
def gradient_type(width: int) -> type:
    """The gradient of a loss with respect to a hash, and to the weights of a head."""

    @wp.struct
    class Gradient:
        values: wp.array(dtype=vector(width))  # [n_entries]
        touched: wp.array(
            dtype=wp.uint8
        )  # [n_tiles] 1 where a pair of entries begins that got some
        hidden: wp.array2d(dtype=real)  # [n_workers, n_levels width n_units] each worker's own
        decoder: wp.array2d(dtype=real)  # [n_workers, n columns] likewise
        weights: wp.array2d(dtype=real)  # [n_workers, n_weights] likewise

    return Gradient


@wp.struct
class Corner:
    """Where a position lies in a level."""

    entries: wp.vec4i  # the lower entry of each of the four rows around, by x and y
    fraction: vec3  # position between the nodes, [0, 1]


@wp.func
def begin_of_row(level: Level, i: int, j: int) -> int:
    """The entry at which the row of nodes (i, j, 0), (i, j, 1), .. begins."""
    of_i = wp.uint32(i) * wp.static(wp.uint32(PRIME_X))
    hashed = of_i ^ (wp.uint32(j) * wp.static(wp.uint32(PRIME_Y)))
    own = (i * level.size[1] + j) * level.size[2]
    return level.begin + wp.where(level.mask == wp.uint32(0), own, int(hashed & level.mask))


@wp.func
def rows_around(level: Level, i: int, j: int) -> wp.vec4i:
    """Where the four rows begin that are next to positions in a cell."""
    return wp.vec4i(
        begin_of_row(level, i, j),
        begin_of_row(level, i, j + 1),
        begin_of_row(level, i + 1, j),
        begin_of_row(level, i + 1, j + 1),
    )


@wp.func
def corner_of(level: Level, position: vec3) -> Corner:
    """Where a position lies in a level."""
    u = wp.cw_mul(position, level.to_nodes) + level.middle
    node = lowest_node(u, level.size)
    at = Corner()
    k = node[2]
    at.entries = rows_around(level, node[0], node[1]) + wp.vec4i(k, k, k, k)
    at.fraction = u - vec3(real(node[0]), real(node[1]), real(node[2]))
    return at


@wp.func
def share_of(fraction: vec3, row: int) -> real:
    """How much one of the four rows around a position counts; together they count 1."""
    x = wp.where(row >= 2, fraction[0], real(1.0) - fraction[0])
    y = wp.where(row % 2 == 1, fraction[1], real(1.0) - fraction[1])
    return x * y


@wp.func
def in_level(params: Any, at: Corner):
    """The mean of a level's eight entries around a position, by where it lies between them."""
    up = at.fraction[2]
    total = params.values[at.entries[0]] * real(0.0)
    for row in range(4):
        n = at.entries[row]
        pair = (real(1.0) - up) * params.values[n] + up * params.values[n + 1]
        total += share_of(at.fraction, row) * pair
    return total


@wp.func
def adj_in_level(at: Corner, adj: Any, gradient: Any):
    """Transpose of in_level. Additions are atomic on CUDA; on the CPU one thread may call this."""
    up = at.fraction[2]
    for row in range(4):
        n = at.entries[row]
        gradient.touched[tile_of(n)] = wp.uint8(1)
        share = share_of(at.fraction, row) * adj
        add_to(gradient.values, n, (real(1.0) - up) * share)
        add_to(gradient.values, n + 1, up * share)


# Loops run to a number that compilers do not know, as in networks.mlp.


@wp.func
def times(params: Any, matrix: wp.array(dtype=real), stride: int, n: int, position: vec3, out: Any):
    """out + matrix^T [E_1, E_2, ..], the first n numbers, with the E_l around a position."""
    n_numbers = params.width
    for m in range(params.n_active):
        around = in_level(params, corner_of(params.levels[m], position))
        for i in range(n_numbers):
            row = (m * n_numbers + i) * stride
            for o in range(n):
                out[o] += around[i] * matrix[row + o]
    return out


@wp.func
def adj_times(
    params: Any,
    matrix: wp.array(dtype=real),
    stride: int,
    n: int,
    position: vec3,
    adj_out: Any,
    gradient: Any,
    adj_matrix: wp.array2d(dtype=real),  # of gradient; added to
):
    """Transpose of times."""
    n_numbers = params.width
    for m in range(params.n_active):
        at = corner_of(params.levels[m], position)
        around = in_level(params, at)
        adj = around * real(0.0)
        for i in range(n_numbers):
            row = (m * n_numbers + i) * stride
            total = real(0.0)
            for o in range(n):
                total += adj_out[o] * matrix[row + o]
                add_weight(adj_matrix, row + o, around[i] * adj_out[o])
            adj[i] = total
        adj_in_level(at, adj, gradient)


@wp.func
def place(params: Any, position: vec3) -> vec3:
    """Where a position lies in the field, [0, 1]^3."""
    level = params.levels[0]
    u = wp.cw_mul(position, level.to_nodes) + level.middle
    return wp.cw_div(u, real(2.0) * level.middle)


@cache
def hashed(
    width: int,
    n_levels: int,
    n_floats: int,
    n_decoded: int,
    by_sample: bool = False,
    hidden: int = 0,
) -> Encoding:
    """The encoding whose entries hold so many numbers.

    Args:
        width: Of an entry: 2, 4 or 8.
        n_levels: How many there are.
        n_floats: Of a sample: 4, 8, 16, 32 or 64.
        n_decoded: How many of these are not padding.
        by_sample: Whether packs hold values after the first four sample by sample.
        hidden: Units of the hidden layer, a multiple of 16; 0: there is none.
    """
    Hash, Gradient, Raw = hash_type(width), gradient_type(width), vector(n_floats)
    columns = columns_of(n_floats)
    read, adj_read = decoded(Hash, Gradient, Raw, columns)
    if hidden:
        read, adj_read = decoded_twice(Hash, Gradient, Raw, columns, hidden)
    return Encoding(
        n_floats=n_floats,
        Params=Hash,
        Gradient=Gradient,
        read=read,
        adj_read=adj_read,
        place=place,
        vectors=vectors_of(width, n_levels, n_floats, n_decoded, columns, by_sample, hidden),
    )


def decoded(Hash: type, Gradient: type, Raw: type, columns: int) -> tuple[wp.Function, wp.Function]:
    """read, by the decoder alone, and adj_read."""

    @wp.func
    def read(params: Hash, position: vec3) -> Raw:
        """Raw values at a position."""
        return times(params, params.decoder, columns, params.n_decoded, position, Raw())

    @wp.func
    def adj_read(params: Hash, position: vec3, adj_raw: Raw, gradient: Gradient):
        """Transpose of read."""
        n = params.n_decoded
        adj_times(params, params.decoder, columns, n, position, adj_raw, gradient, gradient.decoder)

    return read, adj_read


def decoded_twice(
    Hash: type, Gradient: type, Raw: type, columns: int, hidden: int
) -> tuple[wp.Function, wp.Function]:
    """The same with a hidden layer."""
    Units = vector(hidden)

    @wp.func
    def read(params: Hash, position: vec3) -> Raw:
        """Raw values at a position."""
        n_units, n_decoded = params.n_units, params.n_decoded
        before = times(params, params.hidden, hidden, n_units, position, Units())
        raw = Raw()
        for u in range(n_units):
            unit = relu(before[u])
            for o in range(n_decoded):
                raw[o] += unit * params.decoder[u * columns + o]
        return raw

    @wp.func
    def adj_read(params: Hash, position: vec3, adj_raw: Raw, gradient: Gradient):
        """Transpose of read's slope."""
        n_units, n_decoded = params.n_units, params.n_decoded
        before = times(params, params.hidden, hidden, n_units, position, Units())
        adj = Units()
        for u in range(n_units):
            unit, total = relu(before[u]), real(0.0)
            for o in range(n_decoded):
                total += adj_raw[o] * params.decoder[u * columns + o]
                add_weight(gradient.decoder, u * columns + o, unit * adj_raw[o])
            adj[u] = wp.where(unit > real(0.0), total, real(0.0))
        adj_times(params, params.hidden, hidden, n_units, position, adj, gradient, gradient.hidden)

    return read, adj_read


@cache
def node_densities_kernel(width: int, n_levels: int, hidden: int) -> wp.Kernel:
    """Raw densities at nodes of the lattice of the field."""
    if hidden:
        return hidden_densities_kernel(width, n_levels, hidden)
    Hash, Density, column = hash_type(width), vector(1), density_column(width)

    @wp.kernel(module="unique", enable_backward=False)
    def node_densities(
        # launch
        first: int,
        # scene
        params: Hash,
        # choices
        columns: int,  # of the decoder
        size: wp.vec3i,  # X, Y, Z of the field's lattice
        reach: real,  # contracted coordinates lie in [-reach, reach]
        begin: int,  # row of nodes along z that is the first of out
        # out
        out: wp.array(dtype=Density),  # [n_rows * Z]
    ):
        """Raw densities at the nodes of a row along z: fields.hashed.read there."""
        row = first + wp.tid()
        x = real((begin + row) // size[1]) / real(size[0] - 1)
        y = real((begin + row) % size[1]) / real(size[1] - 1)
        for k in range(size[2]):
            out[row * size[2] + k] = Density(real(0.0))
        for m in range(params.n_active):
            level = params.levels[m]
            decoder = column(params, m, columns)
            corner = reach * vec3(real(2.0) * x - real(1.0), real(2.0) * y - real(1.0), real(-1.0))
            at = corner_of(level, corner)
            step = real(2.0) * level.middle[2] / real(size[2] - 1)
            for k in range(size[2]):
                u = real(k) * step
                low = wp.clamp(int(u), 0, level.size[2] - 2)
                up = u - real(low)
                raw = real(0.0)
                for side in range(4):
                    n = at.entries[side] + low
                    pair = (real(1.0) - up) * params.values[n] + up * params.values[n + 1]
                    raw += share_of(at.fraction, side) * wp.dot(pair, decoder)
                out[row * size[2] + k] += Density(raw)

    return node_densities


DENSITY_OF = r"""
typedef decltype(x.c[0] + x.c[0]) number;  // float, or in float64 double
number units[HIDDEN] = {};
for (int i = 0; i < n_inputs; ++i) {
    const number* row = hidden.data + i * HIDDEN;
    for (int u = 0; u < HIDDEN; ++u) units[u] += x.c[i] * row[u];
}
number raw = 0;
for (int u = 0; u < HIDDEN; ++u) {
    raw += (units[u] < 0 ? 0 : units[u]) * decoder.data[u * columns];
}
return raw;
"""


@cache
def hidden_densities_kernel(width: int, n_levels: int, hidden: int) -> wp.Kernel:
    """The same where there is a hidden layer, through which each node goes by itself."""
    Hash, Density = hash_type(width), vector(1)
    Numbers = vector(n_levels * width)

    @wp.func_native(f"constexpr int HIDDEN = {hidden};\n" + DENSITY_OF)
    def density_of(
        x: Numbers,
        n_inputs: int,  # how many of these there are
        hidden: wp.array(dtype=real),
        decoder: wp.array(dtype=real),
        columns: int,  # of the decoder
    ) -> real:
        """The raw density, in C++: compilers know the number of units, and compute some at once."""
        ...

    @wp.kernel(module="unique", enable_backward=False)
    def node_densities(
        # launch
        first: int,
        # scene
        params: Hash,
        # choices
        columns: int,  # of the decoder
        size: wp.vec3i,  # X, Y, Z of the field's lattice
        reach: real,  # contracted coordinates lie in [-reach, reach]
        begin: int,  # row of nodes along z that is the first of out
        # out
        out: wp.array(dtype=Density),  # [n_rows * Z]
    ):
        """Raw densities at the nodes of a row along z: fields.hashed.read there."""
        row, n_numbers = first + wp.tid(), params.width
        x = real((begin + row) // size[1]) / real(size[0] - 1)
        y = real((begin + row) % size[1]) / real(size[1] - 1)
        numbers = Numbers()
        for k in range(size[2]):
            share = vec3(x, y, real(k) / real(size[2] - 1))
            position = reach * (real(2.0) * share - vec3(real(1.0)))
            for m in range(params.n_active):
                around = in_level(params, corner_of(params.levels[m], position))
                for i in range(n_numbers):
                    numbers[m * n_numbers + i] = around[i]
            n = params.n_active * n_numbers
            raw = density_of(numbers, n, params.hidden, params.decoder, columns)
            out[row * size[2] + k] = Density(raw)

    return node_densities
