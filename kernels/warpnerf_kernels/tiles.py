"""Tiles: runs of nodes along z, flagged where gradient was added; the rest is passed over.

A pair of nodes along z flags the tile that its lower node lies in. So a tile may hold gradient if
it is flagged itself, or if the one before is, whose last pair may reach into it.
"""

import warp as wp

from .types import vec4

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
if (tile >= end || flags[tile] || (tile > 0 && flags[tile - 1])) return tile;
++tile;
for (; tile + 8 <= end; tile += 8) {
    wp::uint64 eight;
    memcpy(&eight, flags + tile, 8);
    if (eight) break;
}
while (tile < end && !flags[tile]) ++tile;
return tile;
""")
def next_tile(touched: wp.array(dtype=wp.uint8), tile: int, end: int) -> int:
    """The first tile at or after `tile` that may hold gradient; `end` if none before it does."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(values.data + node);
#endif
""")
def prefetch(values: wp.array(dtype=vec4), node: int):
    """Bring a node's cache line in, ahead of its use; CUDA has other ways to wait."""
    ...


@wp.func_native("""
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(rows.data + (size_t)row * rows.shape[1] + node);
#endif
""")
def prefetch_row(rows: wp.array2d(dtype=vec4), row: int, node: int):
    """The same in one of several rows."""
    ...
