"""Reduction: the gradients of several processes, each in memory that all of them can reach.

Each process sums a share of the tiles and writes the sums into the gradients of all. Shares are
blocks of tiles in turns, as what rays have touched lies close together.
"""

import warp as wp

from ..base.tiles import GROUP, TILE

wp.set_module_options({"enable_backward": False})

BLOCK = 32 * GROUP
"""Tiles that a thread works on."""

AHEAD = 8
"""Tiles from the one that is summed to the one whose memory is fetched meanwhile."""


@wp.func_native(
    f"constexpr int BLOCK = {BLOCK}, GROUP = {GROUP}, TILE = {TILE}, AHEAD = {AHEAD};"
    """
const int count = touched.shape[0];
const size_t floats = size_t(TILE) * width;
auto row = [&](int process) { return (float*)((char*)values.data + process * values.strides[0]); };
auto flags = [&](int process) { return touched.data + process * touched.strides[0]; };
auto flag = [&](int tile) {
    wp::uint8 any = 0;
    for (int k = 0; k < count && tile >= 0; ++k) any |= flags(k)[tile];
    return any;
};
int chosen[BLOCK], n_chosen = 0;
for (int group = begin; group < end; group += GROUP) {
    wp::uint8 before = flag(group - 1);
    wp::uint64 any = before;
    for (int k = 0; k < count; ++k) {
        wp::uint64 all;
        memcpy(&all, flags(k) + group, GROUP);  // rows end in zeros
        any |= all;
    }
    for (int tile = group; any && tile < group + GROUP && tile < end; ++tile) {
        const wp::uint8 here = flag(tile);
        if (here | before) chosen[n_chosen++] = tile;  // a flag stands for the next tile, too
        for (int k = 0; here && k < count; ++k) flags(k)[tile] = here;
        before = here;
    }
}
auto prefetch = [&](int tile) {
#if !defined(__CUDA_ARCH__)  // which has no memory that processes share
    for (int k = 0; k < count; ++k)
        for (size_t i = 0; i < floats; i += 16) __builtin_prefetch(row(k) + tile * floats + i, 1);
#endif
};
for (int i = 0; i < AHEAD && i < n_chosen; ++i) prefetch(chosen[i]);
for (int i = 0; i < n_chosen; ++i) {
    if (i + AHEAD < n_chosen) prefetch(chosen[i + AHEAD]);
    const size_t from = chosen[i] * floats, left = n_floats - from;
    const size_t n = left < floats ? left : floats;
    float* __restrict__ sum = row(0) + from;
    for (int k = 1; k < count; ++k) {
        const float* __restrict__ other = row(k) + from;
        for (size_t f = 0; f < n; ++f) sum[f] += other[f];
    }
    for (int k = 1; k < count; ++k) memcpy(row(k) + from, sum, sizeof(float) * n);
}
"""
)
def add_group(
    begin: int,
    end: int,
    width: int,
    n_floats: wp.int64,
    values: wp.array2d(dtype=wp.float32),
    touched: wp.array2d(dtype=wp.uint8),
):
    """Sum tiles begin to end - 1 of all processes, in the order of these."""
    ...


@wp.kernel
def add_tiles(
    # launch
    first: int,
    # choices
    process: int,  # this one
    n_tiles: int,
    width: int,  # floats of an entry
    n_floats: wp.int64,  # of all entries
    # out
    values: wp.array2d(dtype=wp.float32),  # [n_processes, n_floats or more] gradients, replaced
    touched: wp.array2d(dtype=wp.uint8),  # [n_processes, n_tiles and zeros] their flags, likewise
):
    """Replace gradients by their sums over processes, and flags by those of any, in this process's
    blocks of tiles."""
    block = (first + wp.tid()) * touched.shape[0] + process
    begin = block * wp.static(BLOCK)
    add_group(begin, wp.min(begin + wp.static(BLOCK), n_tiles), width, n_floats, values, touched)
