"""warpnerf: its training pass, and the zeroing that the optimiser does for it in training."""

from __future__ import annotations

import numpy as np
import warp as wp
from warpnerf_kernels.tiles import (
    GROUP,
    STRETCH,
    TILE,
    but_first,
    first_of,
    tile_of,
    touched_tiles,
)
from warpnerf_kernels.types import Gradient, vec4
from workload import Workload

from warpnerf.parallel import Packed, Workers
from warpnerf.render import TrainingPass, render_rays


@wp.func_native(
    """
const size_t n = sizeof(*values.data);
if (count == TILE) memset(values.data + node, 0, TILE * n);  // as long as the compiler knows
else memset(values.data + node, 0, count * n);
""".replace("TILE", str(TILE))
)
def clear_nodes(values: wp.array(dtype=vec4), node: int, count: int):
    """Zero some nodes."""
    ...


@wp.kernel(enable_backward=False)
def clear(
    first: int,
    span: int,  # nodes per thread
    gradient: Gradient,  # zeroed
):
    """What adam_step has to do with gradients: zero what was touched."""
    n_nodes = gradient.values.shape[0]
    start = (first + wp.tid()) * span
    end = wp.min(start + span, n_nodes)
    last = tile_of(end - 1) + 1
    for group in range(tile_of(start), last, wp.static(GROUP)):
        tiles = touched_tiles(gradient.touched, group, last)
        while tiles != wp.uint64(0):
            tile = group + first_of(tiles)
            node = wp.max(start, tile * wp.static(TILE))
            clear_nodes(gradient.values, node, wp.min(end, (tile + 1) * wp.static(TILE)) - node)
            tiles = but_first(tiles)


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
        self._packed = Packed()
        scaling = "clamped" if work.scaled else "none"
        self._pass = TrainingPass(
            self._batch.count, self._grid, self._steps, scaling, "none", workers
        )

    def step(self) -> None:
        """Zero what the last step touched, then the training pass."""
        gradients = self._pass.gradients
        span = 1 if self._workers.device.is_cuda else STRETCH
        n = -(-gradients.values.shape[0] // span)
        self._workers.launch(clear, n, span, gradients.struct, packed=self._packed)
        gradients.touched.zero_()
        self._pass.run(self._free, self._batch)

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, 4]"""
        return self._pass.gradients.values.numpy().reshape(self._size)

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

    def scratch_bytes(self) -> tuple[int, int]:
        """Of the training pass but the gradient: what a step uses, and what it has room for."""
        arrays = [*vars(self._pass).values(), self._pass.gradients.touched]
        used = sum(array.capacity for array in arrays if isinstance(array, wp.array))
        parcels = self._pass.launch.parcels
        if parcels is None:
            return used, used
        room = used + parcels.contents.capacity + parcels.addressed.capacity
        contents = parcels.contents.numpy()
        contents = contents.view(np.uint8).reshape(-1, contents.dtype.itemsize)
        contents.fill(255)
        parcels.addressed.fill_(-1)
        self.step()
        used += int((contents != 255).any(axis=1).sum()) * contents.shape[1]
        used += 4 * int((parcels.addressed.numpy() != -1).sum())
        return used, room


def obstacle(device: str) -> str | None:
    """It runs wherever the benchmark does."""
    return None


load = WarpStep
