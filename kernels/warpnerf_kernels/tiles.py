"""Tiles: runs of nodes along z, flagged where gradient was added; the rest is passed over.

A pair of nodes along z flags the tile that its lower node lies in. So a tile may hold gradient if
it is flagged itself, or if the one before is, whose last pair may reach into it.
"""

from typing import Any

import warp as wp

TILE = 4
"""Nodes in a tile: in float32, a cache line."""

STRETCH = 256
"""Nodes that a thread on the CPU works on."""

GROUP = 8
"""Tiles whose flags are looked at together."""

AHEAD = 8 * GROUP
"""Tiles from those that are worked on to those whose memory is fetched meanwhile, on the CPU."""


@wp.func
def tile_of(node: int) -> int:
    """The tile that holds a node, given by its flat index."""
    return node // wp.static(TILE)


@wp.func_native(
    """
const wp::uint8* flags = touched.data + first;
wp::uint64 tiles = 0;
if (first + GROUP <= last) {
    memcpy(&tiles, flags, GROUP);  // the lowest byte is the first
    tiles |= tiles << 8;  // a flag stands for the next one, too
    if (first > 0) tiles |= flags[-1];
} else {
    for (int t = 0; first + t < last; ++t) {
        const wp::uint64 flag = flags[t] | (first + t > 0 ? flags[t - 1] : 0);
        tiles |= flag << 8 * t;
    }
}
return tiles;
""".replace("GROUP", str(GROUP))
)
def touched_tiles(touched: wp.array(dtype=wp.uint8), first: int, last: int) -> wp.uint64:
    """Which tiles of a group, from `first` on and before `last`, may hold gradient.

    Returns:
        A byte for each, the lowest for the first: 1, or 0 if there is none.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
return (__ffsll(tiles) - 1) / 8;
#else
return __builtin_ctzll(tiles) / 8;
#endif
""")
def first_of(tiles: wp.uint64) -> int:
    """Which is the first of some tiles of a group, from `touched_tiles`."""
    ...


@wp.func
def but_first(tiles: wp.uint64) -> wp.uint64:
    """The same tiles without the first."""
    return tiles & (tiles - wp.uint64(1))


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(values.data + node);
#endif
""")
def prefetch(values: wp.array(dtype=Any), node: int):
    """Bring a node's cache line in, ahead of its use; CUDA has other ways to wait."""
    ...
