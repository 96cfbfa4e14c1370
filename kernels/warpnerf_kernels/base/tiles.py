"""Tiles: runs of nodes along z, flagged where gradient was added; the rest is skipped.

A pair of nodes along z flags the tile that its lower node lies in. So a tile may hold gradient if
it is flagged itself, or if the one before is, whose last pair may reach into it.
"""

from functools import cache
from typing import Any

import warp as wp

TILE = 4
"""Nodes in a tile: in float32, a cache line for every four numbers of a node."""

NODES_PER_THREAD = 256
"""Nodes that a thread on the CPU works on."""

GROUP = 8
"""Tiles whose flags are looked at together."""

AHEAD = 8 * GROUP
"""Tiles from those that are worked on to those whose memory is fetched meanwhile, on the CPU."""


@wp.func
def tile_of(node: int) -> int:
    """The tile that holds a node, given by its flat index."""
    return node // wp.static(TILE)


FIND = """
auto find = [&](int begin, int end) -> wp::uint64 {
    const wp::uint8* flags = touched.data + begin;
    wp::uint64 tiles = 0;
    if (begin + GROUP <= end) {
        memcpy(&tiles, flags, GROUP);  // the lowest byte is the first
        tiles |= tiles << 8;  // a flag stands for the next tile, too
        if (begin > 0) tiles |= flags[-1];
    } else {
        for (int t = 0; begin + t < end; ++t) {
            const wp::uint64 flag = flags[t] | (begin + t > 0 ? flags[t - 1] : 0);
            tiles |= flag << 8 * t;
        }
    }
    return tiles;
};
""".replace("GROUP", str(GROUP))
"""What touched_tiles and tiles_ahead begin with."""


@wp.func_native(FIND + "return find(group, end);")
def touched_tiles(touched: wp.array(dtype=wp.uint8), group: int, end: int) -> wp.uint64:
    """Which tiles of a group, given by its first one, may hold gradient; none from `end` on.

    Returns:
        A byte for each of the GROUP tiles, the lowest for the first: 1 if it may, else 0.
    """
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)  // has other ways to wait
return 0;
#else
FIND
const int ahead = end + AHEAD, n_tiles = touched.shape[0];
return find(group + AHEAD, ahead < n_tiles ? ahead : n_tiles);
#endif
""".replace("FIND", FIND).replace("AHEAD", str(AHEAD))
)
def tiles_ahead(touched: wp.array(dtype=wp.uint8), group: int, end: int) -> wp.uint64:
    """touched_tiles for the group and the end that lie AHEAD of the given ones; none on CUDA."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (__ffsll(tiles) - 1) / 8;
#else
return __builtin_ctzll(tiles) / 8;
#endif
""")
def first_of(tiles: wp.uint64) -> int:
    """The place in its group of the first of some tiles, of which there is one at least."""
    ...


@wp.func
def without_first(tiles: wp.uint64) -> wp.uint64:
    """The same tiles without the first."""
    return tiles & (tiles - wp.uint64(1))


@wp.func_native(
    f"constexpr int TILE = {TILE};"
    """
#if !defined(__CUDA_ARCH__)
const char* tile = (const char*)(values.data + node);
for (size_t at = 0; at < TILE * sizeof(*values.data); at += 64) __builtin_prefetch(tile + at);
#endif
"""
)
def prefetch(values: wp.array(dtype=Any), node: int):
    """Bring a tile's cache lines in, ahead of its use; CUDA has other ways to wait."""
    ...


@cache
def tile_loop(prefetch_tile: Any, work: Any) -> wp.Function:
    """The function over_tiles(on, touched, start, end): work on tiles that may hold gradient.

    Args:
        prefetch_tile: (on, node) prefetches, on the CPU, a tile that is worked on later.
        work: (on, node, begin, end) works on nodes begin to end - 1, of the tile that node begins.
    """

    @wp.func
    def over_tiles(
        on: Any,  # struct of what both functions take
        touched: wp.array(dtype=wp.uint8),  # [n_tiles]
        start: int,  # node to begin with
        end: int,  # one past the last
    ):
        last = tile_of(end - 1) + 1
        for group in range(tile_of(start), last, wp.static(GROUP)):
            # In turns: requests for all tiles at once would hold up what the work has to read.
            ahead = tiles_ahead(touched, group, last)
            tiles = touched_tiles(touched, group, last)
            while tiles != wp.uint64(0) or ahead != wp.uint64(0):
                if ahead != wp.uint64(0):
                    prefetch_tile(
                        on, (group + wp.static(AHEAD) + first_of(ahead)) * wp.static(TILE)
                    )
                    ahead = without_first(ahead)
                if tiles != wp.uint64(0):
                    node = (group + first_of(tiles)) * wp.static(TILE)
                    work(on, node, wp.max(start, node), wp.min(end, node + wp.static(TILE)))
                    tiles = without_first(tiles)

    return over_tiles
