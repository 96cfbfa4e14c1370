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


@wp.func
def flagged(touched: wp.array2d(dtype=wp.uint8), worker: int, tile: int) -> bool:
    """Whether a worker may have added to a tile of its row."""
    if touched[worker, tile] != wp.uint8(0):
        return True
    if tile > 0:
        return touched[worker, tile - 1] != wp.uint8(0)
    return False


@wp.func_native("""
int first = end;
for (int worker = 0; worker < touched.shape[0]; ++worker) {
    const wp::uint8* flags = touched.data + (size_t)worker * touched.shape[1];
    int t = tile;
    if (t < end && !flags[t] && !(t > 0 && flags[t - 1])) {
        wp::uint64 eight = 0;
        for (++t; t + 8 <= first && !eight; t += 8) memcpy(&eight, flags + t, 8);
        if (eight) t -= 8;
        while (t < first && !flags[t]) ++t;
    }
    if (t < first) first = t;
}
return first;
""")
def next_tile(touched: wp.array2d(dtype=wp.uint8), tile: int, end: int) -> int:
    """The first tile at or after `tile` to which any worker may have added; `end` if there is none
    before it."""
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
