"""warpnerf: its training launch, and the workers' rows folded into one as the optimiser does it."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from warpnerf_kernels.tiles import STRETCH, TILE, flagged, next_tile, prefetch_row, tile_of
from warpnerf_kernels.types import vec4
from workload import Workload

from warpnerf.parallel import Workers
from warpnerf.render import TrainingPass, render_rays


@wp.func_native("""
auto* sum = &rows.data[node].c[0];
auto* row = &rows.data[(size_t)worker * rows.shape[1] + node].c[0];
for (int n = 0; n < 4 * count; ++n) {
    sum[n] += row[n];
    row[n] = 0;
}
""")
def add_row(rows: wp.array2d(dtype=vec4), worker: int, node: int, count: int):
    """Add some nodes of a worker's row to the first row, and zero them."""
    ...


@wp.func_native("memset(&rows.data[node], 0, sizeof(rows.data[node]) * count);")
def clear_row(rows: wp.array2d(dtype=vec4), node: int, count: int):
    """Zero some nodes of the first row."""
    ...


@wp.kernel(enable_backward=False)
def fold(
    first: int,
    span: int,  # nodes per thread
    touched: wp.array2d(dtype=wp.uint8),  # [n_workers, n_tiles] as adj_gather left it
    gradients: wp.array2d(dtype=vec4),  # [n_workers, n_nodes] row 0 becomes the sum, the rest zero
):
    """Like adam_step, of which this is the part that has to do with gradients: tile by tile."""
    start = (first + wp.tid()) * span
    end = wp.min(start + span, gradients.shape[1])
    last = tile_of(end - 1) + 1
    tile = next_tile(touched, tile_of(start), last)
    while tile < last:
        prefetch_row(gradients, 0, tile * wp.static(TILE))
        for worker in range(1, gradients.shape[0]):
            if flagged(touched, worker, tile):
                prefetch_row(gradients, worker, tile * wp.static(TILE))
        tile = next_tile(touched, tile + 1, last)
    tile = next_tile(touched, tile_of(start), last)
    while tile < last:
        node = wp.max(start, tile * wp.static(TILE))
        count = wp.min(end, (tile + 1) * wp.static(TILE)) - node
        for worker in range(1, gradients.shape[0]):
            if flagged(touched, worker, tile):
                add_row(gradients, worker, node, count)
        tile = next_tile(touched, tile + 1, last)


@wp.kernel(enable_backward=False)
def clear(
    first: int,
    span: int,
    touched: wp.array2d(dtype=wp.uint8),  # [n_workers, n_tiles]
    gradients: wp.array2d(dtype=vec4),  # [n_workers, n_nodes] row 0 is zeroed
):
    """Make way for the next step; what was not touched is zero."""
    start = (first + wp.tid()) * span
    end = wp.min(start + span, gradients.shape[1])
    last = tile_of(end - 1) + 1
    tile = next_tile(touched, tile_of(start), last)
    while tile < last:
        node = wp.max(start, tile * wp.static(TILE))
        clear_row(gradients, node, wp.min(end, (tile + 1) * wp.static(TILE)) - node)
        tile = next_tile(touched, tile + 1, last)


class WarpStep:
    """A workload's training step in warpnerf."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._workers = workers = Workers(device, threads)
        self._size = work.values.shape
        self._grid = work.voxel_grid(workers)
        self._free = work.free_cells(workers)
        self._steps = work.steps()
        self._batch = work.batch(workers)
        self._span = 1 if workers.device.is_cuda else STRETCH
        scaling = "clamped" if work.scaled else "none"
        n_nodes = math.prod(self._size[:3])
        self._pass = TrainingPass(self._batch.count, n_nodes, scaling, "none", "none", workers)

    def step(self) -> None:
        """One launch between the zeroing and the adding up of what was touched."""
        self._for_touched(clear)
        self._pass.gradients.touched.zero_()
        self._pass.run(self._grid, self._free, self._steps, self._batch)
        self._for_touched(fold)

    def _for_touched(self, kernel: wp.Kernel) -> None:
        gradients = self._pass.gradients
        n = -(-gradients.rows.shape[1] // self._span)
        self._workers.launch(kernel, n, self._span, gradients.touched, gradients.rows)

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._pass.gradients.rows.numpy()[0].reshape(self._size)

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        batch = self._batch
        return render_rays(
            self._grid,
            self._free,
            self._steps,
            batch.origins,
            batch.directions,
            batch.offsets,
            batch.background,
            self._workers,
        ).rgb.numpy()

    def n_samples(self) -> int:
        """Visited steps of the last step."""
        return int(self._pass.n_samples.numpy().sum())

    def scratch_bytes(self) -> int:
        """All arrays of the training pass but the gradient."""
        arrays = [*vars(self._pass).values(), self._pass.gradients.touched]
        return sum(array.capacity for array in arrays if isinstance(array, wp.array))


def obstacle(device: str) -> str | None:
    """It runs wherever the benchmark does."""
    return None


load = WarpStep
