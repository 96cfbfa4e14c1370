"""Which blocks of pixels are left out: none whose rays meet something, and hardly any too few."""

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.kernels.test_camera_rays import CX, CY, FX, FY, HEIGHT, LENSES, WIDTH, rays, view
from tests.kernels.test_free_space import chessboard
from tests.support.kernel_runner import Kernels
from warpnerf.fields.lattice import box_struct
from warpnerf.fields.occupancy import free_struct

BOX_MIN, BOX_MAX = np.array([-1.0, -0.8, -0.9]), np.array([1.2, 0.9, 0.7])
N_CELLS = (22, 17, 16)


def looking(seed: int, away: float, aside: float = 0.15) -> Any:
    """c2w of a camera at a distance from the box's middle, which it sees somewhere in its image."""
    rng = np.random.default_rng(seed)
    back = rng.normal(size=3)
    back /= np.linalg.norm(back)
    eye = 0.5 * (BOX_MIN + BOX_MAX) + away * back
    back += rng.normal(scale=aside, size=3)
    back /= np.linalg.norm(back)
    right = np.cross(rng.normal(size=3), back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, eye], axis=1)


def covered(kernels: Kernels, view: Any, occupied: Any, block: int) -> Any:
    """[rows, columns] bool, as the kernel finds it, between other views' blocks."""
    return covered_by(kernels, view, chessboard(occupied), block)


def covered_by(kernels: Kernels, view: Any, distances: Any, block: int, before: int = 3) -> Any:
    """The same of the distances of cells to occupied ones."""
    size = tuple(distances.shape)
    distance = wp.array(distances.ravel(), dtype=wp.uint8, device=kernels.device)
    shape = (-(-HEIGHT // block), -(-WIDTH // block))
    n = shape[0] * shape[1]
    out = wp.full(before + n + 2, 7, dtype=wp.uint8, device=kernels.device)
    kernels.workers.launch(
        kernels.module("sampling.coverage").cover_blocks,
        n,
        view,
        box_struct(kernels.types, BOX_MIN, BOX_MAX, 0.0),
        free_struct(kernels.types, distance, size, 0.0),
        *(block, before),
        out,
    )
    found = out.numpy()
    assert (found[:before] == 7).all() and (found[before + n :] == 7).all()
    assert np.isin(found[before : before + n], (0, 1)).all()
    return found[before : before + n].reshape(shape) == 1


def meeting(origins: Any, directions: Any, occupied: Any, margin: float = 0.0) -> Any:
    """[H, W] whether rays pass through occupied cells, each larger by a margin in cells.

    By the slabs of each cell, without any grid.
    """
    size = np.array(occupied.shape)
    edge = (BOX_MAX - BOX_MIN) / size
    found = np.zeros(directions.shape[:2], bool)
    for cell in np.argwhere(occupied):
        low = BOX_MIN + (cell - margin) * edge
        high = BOX_MIN + (cell + 1 + margin) * edge
        a, b = (low - origins) / directions, (high - origins) / directions
        enter = np.minimum(a, b).max(-1)
        found |= np.maximum(a, b).min(-1) >= np.maximum(enter, 0.0)
    return found


def of_blocks(pixels: Any, block: int) -> Any:
    """[rows, columns] whether any pixel of a block is one of them."""
    rows, columns = -(-HEIGHT // block), -(-WIDTH // block)
    padded = np.zeros((rows * block, columns * block), bool)
    padded[:HEIGHT, :WIDTH] = pixels
    return padded.reshape(rows, block, columns, block).any((1, 3))


@pytest.mark.parametrize(
    ("lens", "block"),
    [(LENSES[0], 4), (LENSES[0], 7), (LENSES[2], 4), (LENSES[6], 7)],
    ids=str,
)
def test_no_block_is_left_out_whose_rays_meet_something(
    lens: dict[str, float], block: int, kernels64: Kernels
) -> None:
    left_out = 0
    for seed in range(12):
        rng = np.random.default_rng(seed)
        away = (0.2, 1.5, 3.0, 6.0)[seed % 4]
        c2w = looking(seed, away)
        occupied = rng.random(N_CELLS) < (0.0005, 0.002, 0.02)[seed % 3]
        origins, directions = rays(kernels64, c2w, lens)
        meets = of_blocks(meeting(origins, directions, occupied), block)
        found = covered(kernels64, view(kernels64, c2w, lens), occupied, block)
        assert not (meets & ~found).any()
        # Without distortion a block is wide by a known number of cells, and so is what is covered.
        edge = ((BOX_MAX - BOX_MIN) / N_CELLS).min()
        wide = block * np.hypot(1 / FX, 1 / FY) / 2 * (away + 2.0 + 9 * 1.8 * edge) / edge
        near = of_blocks(meeting(origins, directions, occupied, np.ceil(wide) + 1.5), block)
        if not lens:
            assert not (found & ~near).any()
        left_out += int((~found).sum())
    assert left_out > 100


def test_a_block_is_as_wide_as_its_corners(kernels64: Kernels) -> None:
    """One cell before the camera, as large as a block: seen by it and its neighbours, no others."""
    size = np.array([40, 40, 40])
    occupied = np.zeros(size, bool)
    occupied[20, 20, 20] = True
    middle = BOX_MIN + 20.5 / 40 * (BOX_MAX - BOX_MIN)
    middle[2] += 3.0
    c2w = np.column_stack([np.eye(3), middle])
    found = covered(kernels64, view(kernels64, c2w, {}), occupied, 4)
    row, column = np.argwhere(found).mean(0)
    assert abs(4 * (row + 0.5) - CY) < 3 and abs(4 * (column + 0.5) - CX) < 3
    assert 1 <= found.sum() <= 25


def test_nothing_and_everything(kernels64: Kernels) -> None:
    here = view(kernels64, looking(1, 3.0), {})
    assert not covered(kernels64, here, np.zeros(N_CELLS, bool), 4).any()
    inside = view(kernels64, looking(1, 0.1), {})
    assert covered(kernels64, inside, np.ones(N_CELLS, bool), 4).all()
    # A camera that looks away from the box.
    away = looking(1, 3.0)
    away[:, [0, 2]] *= -1.0
    assert not covered(kernels64, view(kernels64, away, {}), np.ones(N_CELLS, bool), 4).any()


@pytest.mark.parametrize("away", [3.0, 3e2, 3e3, 3e4])
def test_it_ends_however_far_the_camera_is(packed: Kernels, away: float) -> None:
    """Through a long lens: at such t a thousandth of a cell is less than float32 tells apart."""
    occupied = np.zeros((80, 80, 80), bool)
    occupied[40, 40, 40] = occupied[30, 45, 38] = True
    distances = chessboard(occupied)
    lens = {"focal": packed.types.vec2(0.4 * FX * away, 0.4 * FY * away)}
    for seed in range(20):
        found = covered_by(
            packed, view(packed, looking(seed, away, 0.05 / away), {}, **lens), distances, 4
        )
        assert found.any()
