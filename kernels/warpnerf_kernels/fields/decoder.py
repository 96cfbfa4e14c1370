"""The words of decoders in C++: a matrix on what encodings read, for packs of sixteen samples.

    raw = x decoder      x [n_inputs], decoder [n_inputs, COLUMNS] row by row

Numbers of a row fill the vectors, and rows, which are samples, go through side by side. Encodings
say before these words what FLOATS, the numbers of a sample, DECODED, those that are not padding,
COLUMNS and INPUTS are.
"""

from functools import cache
from typing import Any, NamedTuple

import warp as wp

from ..base.parts import EncodingVectors
from ..base.simd import LANES, VECTORS, lanes
from ..base.types import Ray, struct, vector

wp.set_module_options({"enable_backward": False})


def columns_of(n_floats: int) -> int:
    """Columns of a decoder: whole vectors."""
    return max(LANES, n_floats)


def padded(n_inputs: int) -> int:
    """Inputs of a decoder, in whole vectors."""
    return -(-n_inputs // LANES) * LANES


DECODER = (
    VECTORS
    + r"""
auto at = [&](const float* x) -> vec { return *(const vec_at*)x; };
auto put = [&](float* x, vec v) { *(vec_at*)x = v; };
// Rows that share what is loaded of the matrix: as many sums as registers hold.
struct Few { enum { value = 4 }; };
struct Many { enum { value = 8 }; };
#ifdef __AVX512F__
struct Most { enum { value = 16 }; };
#else
struct Most { enum { value = 8 }; };
#endif
// y[r] = x[r] matrix, sixteen of its columns, for rows of so many inputs. Up to three
// rows after the last one are computed as well, and not looked at.
auto multiply = [&](int n_rows, int n_inputs, auto&& x_of, const float* matrix, int stride,
                    auto&& y_of) {
    auto some = [&](auto rows, int r) {
        constexpr int N = decltype(rows)::value;
        vec y[N];
        #pragma clang loop unroll(full)
        for (int k = 0; k < N; ++k) y[k] = splat(0.0f);
        for (int i = 0; i < n_inputs; ++i) {
            const vec column = at(matrix + (size_t)i * stride);
            #pragma clang loop unroll(full)
            for (int k = 0; k < N; ++k) y[k] = fma(splat(x_of(r + k)[i]), column, y[k]);
        }
        #pragma clang loop unroll(full)
        for (int k = 0; k < N; ++k) put(y_of(r + k), y[k]);
    };
    int r = 0;
    for (; r + 12 < n_rows; r += Most::value) some(Most(), r);
    for (; r + 4 < n_rows; r += Many::value) some(Many(), r);
    if (r < n_rows) some(Few(), r);
};
struct Columns { enum { value = COLUMNS }; };
// to += x^T adj, the gradient of a matrix of so many rows. Of x whole eights are read.
auto add_products = [&](int n_rows, int n_inputs, auto&& x_of, auto&& adj_of, float* to,
                        auto columns_of) {
    constexpr int columns = decltype(columns_of)::value;
    for (int block = 0; block < columns; block += LANES) {
        for (int begin = 0; begin < n_inputs; begin += 8) {
            float* sums_at = to + (size_t)begin * columns + block;
            const int n_here = min(8, n_inputs - begin);
            vec sums[8];
            #pragma clang loop unroll(full)
            for (int n = 0; n < 8; ++n) {
                sums[n] = n < n_here ? at(sums_at + n * columns) : splat(0.0f);
            }
            for (int r = 0; r < n_rows; ++r) {
                const float* x = x_of(r) + begin;
                const vec adj = at(adj_of(r) + block);
                #pragma clang loop unroll(full)
                for (int n = 0; n < 8; ++n) sums[n] = fma(splat(x[n]), adj, sums[n]);
            }
            #pragma clang loop unroll(full)
            for (int n = 0; n < 8; ++n) {
                if (n < n_here) put(sums_at + n * columns, sums[n]);
            }
        }
    }
};
// Hand a pack the raw values of the lanes in lane_of, COLUMNS numbers each.
auto put_raw = [&](auto& pack, int n_rows, const int* lane_of, const auto& raw) {
    constexpr int BY_LANE = sizeof(pack.raw) / sizeof(vec);
    if constexpr (BY_LANE < FLOATS) {
        for (int r = 0; r < n_rows; ++r) {
            __builtin_memcpy(&pack.by_sample.data[lane_of[r]], raw[r], FLOATS * sizeof(float));
        }
    }
    float by_lane[LANES][BY_LANE] = {};
    for (int r = 0; r < n_rows; ++r) {
        __builtin_memcpy(by_lane[lane_of[r]], raw[r], BY_LANE * sizeof(float));
    }
    #pragma clang loop unroll(full)
    for (int f = 0; f < BY_LANE; f += 4) {
        float4 four[LANES];
        for (int n = 0; n < LANES; ++n) __builtin_memcpy(&four[n], by_lane[n] + f, sizeof(float4));
        vec a, b, c, d;
        float4_to_lanes(four, a, b, c, d);
        store(pack.raw.data[f], a);
        store(pack.raw.data[f + 1], b);
        store(pack.raw.data[f + 2], c);
        store(pack.raw.data[f + 3], d);
    }
};
// What flows back to the raw values of a pack, lane by lane; zeros where there is padding.
auto take_adj_raw = [&](const auto& pack, auto& adj_raw) {
    constexpr int BY_LANE = sizeof(pack.adj_raw) / sizeof(vec);
    if (COLUMNS > FLOATS) __builtin_memset(adj_raw, 0, sizeof(adj_raw));
    if constexpr (BY_LANE < FLOATS) {
        for (int n = 0; n < LANES; ++n) {
            __builtin_memcpy(adj_raw[n], &pack.adj_by_sample.data[n], FLOATS * sizeof(float));
        }
    }
    #pragma clang loop unroll(full)
    for (int f = 0; f < BY_LANE; f += 4) {
        float4 four[LANES];
        lanes_to_float4(load(pack.adj_raw.data[f]), load(pack.adj_raw.data[f + 1]),
                 load(pack.adj_raw.data[f + 2]), load(pack.adj_raw.data[f + 3]), four);
        for (int n = 0; n < LANES; ++n) __builtin_memcpy(adj_raw[n] + f, &four[n], sizeof(float4));
    }
};
"""
)
"""What native functions of encodings with a decoder begin with, after their constants."""

BEGIN = (
    VECTORS
    + r"""
float* to = params.transposed.data + (size_t)worker * params.transposed.shape[1];
// The next transpose: of a matrix of so many rows, the first numbers of each, in whole vectors.
auto transpose = [&](const float* matrix, int n_rows, int columns, int n_numbers) {
    const int padded = (n_rows + LANES - 1) / LANES * LANES;
    for (int n = 0; n < padded; ++n) {
        for (int o = 0; o < n_numbers; ++o) {
            to[o * padded + n] = n < n_rows ? matrix[n * columns + o] : 0.0f;
        }
    }
    to += n_numbers * padded;
};
"""
)
"""What laying out matrices again begins with."""

TRANSPOSE_DECODER = "transpose(params.decoder.data, INPUTS, COLUMNS, DECODED);"


class VectorCode(NamedTuple):
    """The C++ of an encoding with a decoder; see ``base.parts.EncodingVectors``."""

    read_pack: str
    adj_read_pack: str
    add_records: str
    begin: str = TRANSPOSE_DECODER


@cache
def record_type(name: str, n: int) -> type:
    """What a pack leaves for other workers: where samples lie, and n numbers of each.

    Args:
        name: Of these numbers, [16, n], sample by sample.
        n: How many.
    """
    return struct(
        "Record",
        {
            "active": wp.uint32,  # bit n: lane n is a sample
            "x": lanes,  # position, contracted coordinates c
            "y": lanes,
            "z": lanes,
            name: wp.types.matrix((LANES, n), wp.float32),
        },
        __name__,
    )


def decoded_vectors(
    words: str,
    code: VectorCode,
    Record: type,
    n_floats: int,
    by_sample: bool,
    pack_fields: tuple[tuple[str, Any], ...] = (),
) -> EncodingVectors:
    """The vector form of an encoding with a decoder.

    Args:
        words: Its constants, before all code.
        code: What its functions do.
        Record: From ``record_type``.
        n_floats: Of a sample: 4, 8, 16, 32 or 64.
        by_sample: Whether packs hold values after the first four sample by sample.
        pack_fields: Fields of a pack that are its own.
    """
    n_by_lane = 4 if by_sample else n_floats
    if n_by_lane < n_floats:
        rows = wp.types.matrix((LANES, n_floats), wp.float32)
        pack_fields += (("by_sample", rows), ("adj_by_sample", rows))

    @wp.func_native(words + code.read_pack)
    def read_pack(params: Any, ray: Ray, packs: wp.array(dtype=Any), slot: int):
        """read for the samples of a pack."""
        ...

    @wp.func_native(words + code.adj_read_pack)
    def adj_read_pack(
        params: Any,
        packs: wp.array(dtype=Any),
        slot: int,
        later: int,  # slot of the pack that comes next
        worker: int,
        sink: Any,  # added to, and what is in it
    ):
        """adj_read for a pack's samples, of what the worker owns; a record of the rest."""
        ...

    @wp.func_native(words + code.add_records)
    def add_records(params: Any, worker: int, sender: int, sink: Any):
        """Add what a sender has left for a worker."""
        ...

    @wp.func_native(words + BEGIN + code.begin)
    def begin(params: Any, worker: int):
        """Transpose what adj_read_pack needs so."""
        ...

    @wp.func
    def prefetch_gradient(
        params: Any, packs: wp.array(dtype=Any), slot: int, worker: int, sink: Any
    ):
        """Nothing is prefetched: planes stay in caches, and entries of tables lie anywhere."""

    return EncodingVectors(
        read_pack=read_pack,
        adj_read_pack=adj_read_pack,
        prefetch_gradient=prefetch_gradient,
        add_records=add_records,
        Record=Record,
        n_by_lane=n_by_lane,
        pack_fields=pack_fields,
        begin=begin,
    )


@cache
def density_column(width: int) -> wp.Function:
    """The function density_column: what of a decoder leads to the raw density."""
    Entry = vector(width)

    @wp.func
    def density_column(params: Any, part: int, columns: int) -> Entry:
        """Of the numbers of an entry of one plane, or level."""
        n_numbers = params.width  # unknown to compilers, as in networks.mlp
        out = Entry()
        for n in range(n_numbers):
            out[n] = params.decoder[(part * n_numbers + n) * columns]
        return out

    return density_column
