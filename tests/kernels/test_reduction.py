"""Gradients of several processes, summed tile by tile in memory that all of them reach."""

from typing import Any

import numpy as np
import pytest
import warp as wp
from warpnerf_kernels.base.tiles import GROUP, TILE
from warpnerf_kernels.optim.reduction import BLOCK, add_tiles


def reduced(values: Any, flags: Any, n_entries: int, width: int) -> tuple[Any, Any]:
    """What is left of gradients [n_processes, ...] and flags, once each process has had its turn,
    the last one first."""
    values, flags = values.copy(), flags.copy()
    n_tiles = -(-n_entries // TILE)
    n_processes = len(values)
    arrays = (
        wp.array(values, dtype=wp.float32, device="cpu", copy=False),
        wp.array(flags, dtype=wp.uint8, device="cpu", copy=False),
    )
    for process in reversed(range(n_processes)):
        n_blocks = len(range(process, -(-n_tiles // BLOCK), n_processes))
        inputs = [0, process, n_tiles, width, n_entries * width, *arrays]
        wp.launch(add_tiles, n_blocks, inputs=inputs, device="cpu")
    return values, flags


@pytest.mark.parametrize("share", [0.003, 0.3, 1.0])
@pytest.mark.parametrize("n_processes", [2, 3])
@pytest.mark.parametrize("width", [1, 16])
def test_sums_of_what_any_process_has_touched(width: int, n_processes: int, share: float) -> None:
    """In all processes, in the order of these; a flag stands for the next tile, too. The last tile
    is no whole one, and what lies after the entries stays."""
    n_tiles = 3 * BLOCK + GROUP + 3
    n_entries = TILE * n_tiles - 1
    n_floats, room = n_entries * width, TILE * n_tiles * width + 5
    rng = np.random.default_rng(0)
    flags = np.zeros((n_processes, n_tiles + GROUP), np.uint8)
    flags[:, :n_tiles] = rng.uniform(size=(n_processes, n_tiles)) < share
    flags[0, BLOCK - 1] = 1  # of which the next block of tiles may hold some
    holds = flags[:, :n_tiles] | np.insert(flags[:, : n_tiles - 1], 0, 0, axis=1)
    values = rng.normal(size=(n_processes, room)).astype(np.float32)
    of_tile = np.arange(n_floats) // (TILE * width)
    values[:, :n_floats] *= holds[:, of_tile]
    kept = values[:, n_floats:].copy()

    found, found_flags = reduced(values, flags, n_entries, width)
    expected = values[0, :n_floats]
    for other in values[1:, :n_floats]:
        expected = expected + other
    assert np.count_nonzero(expected) > 0
    for row, of_row in zip(found, found_flags, strict=True):
        assert np.array_equal(row[:n_floats], expected)
        assert np.array_equal(of_row, flags.max(axis=0))
    assert np.array_equal(found[:, n_floats:], kept)


def test_tiles_that_none_has_touched_are_not_looked_at() -> None:
    n_entries = TILE * (BLOCK + 2)
    flags = np.zeros((2, BLOCK + GROUP), np.uint8)
    flags[1, 3] = 1
    values = np.ones((2, n_entries), np.float32)
    found, found_flags = reduced(values, flags, n_entries, 1)
    expected = np.ones(n_entries)
    expected[3 * TILE : 5 * TILE] = 2.0
    assert np.array_equal(found, [expected, expected])
    assert found_flags[:, 3].tolist() == [1, 1] and found_flags.sum() == 2
