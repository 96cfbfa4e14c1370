"""Tiles: runs of nodes along z, flagged where gradient was added; the rest is passed over.

A pair of nodes along z flags the tile that its lower node lies in. So a tile may hold gradient if
it is flagged itself, or if the one before is, whose last pair may reach into it.
"""

from typing import Any

import warp as wp

TILE = 4
"""Nodes in a tile: in float32, a cache line."""

STRETCH = 256
"""Nodes that a thread on the CPU works on: their memory is fetched together, ahead of use."""


@wp.func
def tile_of(node: int) -> int:
    """The tile that holds a node, given by its flat index."""
    return node // wp.static(TILE)


@wp.func_native("""
const wp::uint8* flags = touched.data;
int t = tile;
if (t < end && t > 0 && flags[t - 1]) return t;
#if !defined(__CUDA_ARCH__)  // eight at a time
for (; t + 8 <= end; t += 8) {
    wp::uint64 eight;
    memcpy(&eight, flags + t, 8);
    if (eight) return t + __builtin_ctzll(eight) / 8;  // the lowest byte is the first
}
#endif
while (t < end && !flags[t]) ++t;
return t;
""")
def next_tile(touched: wp.array(dtype=wp.uint8), tile: int, end: int) -> int:
    """The first tile at or after `tile` that may hold gradient; `end` if there is none before."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(values.data + node);
#endif
""")
def prefetch(values: wp.array(dtype=Any), node: int):
    """Bring a node's cache line in, ahead of its use; CUDA has other ways to wait."""
    ...
