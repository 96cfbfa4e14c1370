"""Which tiles may hold gradient, group by group, by their flags."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base.tiles import (
    AHEAD,
    GROUP,
    first_of,
    tiles_ahead,
    touched_tiles,
    without_first,
)


@wp.kernel(enable_backward=False)
def list_tiles(
    touched: wp.array(dtype=wp.uint8),  # [n_tiles]
    group: int,
    end: int,
    out_listed: wp.array2d(dtype=wp.int32),  # [2, GROUP] times that a tile is named
):
    tiles = touched_tiles(touched, group, end)
    while tiles != wp.uint64(0):
        out_listed[0, first_of(tiles)] += 1
        tiles = without_first(tiles)
    tiles = tiles_ahead(touched, group, end)
    while tiles != wp.uint64(0):
        out_listed[1, first_of(tiles)] += 1
        tiles = without_first(tiles)


def listed(flags: Any, group: int, end: int, device: str) -> Any:
    """[2, GROUP] as often as each tile is named, of a group and of the one ahead."""
    out = wp.zeros((2, GROUP), dtype=wp.int32, device=device)
    touched = wp.array(flags.astype(np.uint8), dtype=wp.uint8, device=device)
    wp.launch(list_tiles, 1, inputs=[touched, group, end, out], device=device)
    return out.numpy()


@pytest.mark.parametrize("share", [0.1, 0.5, 1.0])
def test_each_tile_that_may_hold_gradient_is_named_once(share: float, device: str) -> None:
    """Whole groups and parts of them, some ending with the grid, some ahead of its end."""
    n_tiles = AHEAD + 5 * GROUP + 3
    flags = np.random.default_rng(0).uniform(size=n_tiles) < share
    may_hold = flags | np.append(False, flags[:-1])
    named = 0
    for begin in (0, 1, GROUP, 3 * GROUP + 2, 4 * GROUP, n_tiles - GROUP, n_tiles - 2):
        for n in (1, 3, GROUP, 2 * GROUP):
            end = min(begin + n, n_tiles)
            expected = np.zeros((2, GROUP), int)
            for row, ahead in enumerate((0, AHEAD)):
                here = may_hold[begin + ahead : min(begin + GROUP, end) + ahead]
                if device == "cpu" or row == 0:
                    expected[row, : len(here)] = here
            assert np.array_equal(listed(flags, begin, end, device), expected)
            named += expected.sum()
    assert named > 0
