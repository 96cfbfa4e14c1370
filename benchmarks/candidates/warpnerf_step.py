"""warpnerf: its training pass, and the zeroing that the optimiser does for it in training.

Adam has just read what it zeroes. Here it has left the caches, where nodes are wide; so it is
written past them, as reading it back would cost more than writing it.
"""

from functools import cache
from typing import Any

import numpy as np
import warp as wp
from warpnerf_kernels.base.tiles import (
    GROUP,
    NODES_PER_THREAD,
    TILE,
    first_of,
    tile_of,
    touched_tiles,
    without_first,
)
from warpnerf_kernels.base.types import gradient_type
from workload import MODELS, Workload

from warpnerf.fields.gradients import Gradients
from warpnerf.fields.storage import Storage
from warpnerf.rendering.render import TrainingPass, render_rays
from warpnerf.runtime.parallel import LaunchCache, Workers


@wp.func_native(
    """
constexpr size_t BYTES = sizeof(*values.data);
#if !defined(__CUDA_ARCH__)
typedef float line __attribute__((ext_vector_type(16)));
if (BYTES > 16 && count == TILE && ((size_t)values.data & 63) == 0) {  // past the caches
    char* tile = (char*)(values.data + node);
    for (size_t at = 0; at < TILE * BYTES; at += 64) {
        __builtin_nontemporal_store(line(0.0f), (line*)(tile + at));
    }
    return;
}
#endif
if (count == TILE) memset(values.data + node, 0, TILE * BYTES);  // as long as the compiler knows
else memset(values.data + node, 0, count * BYTES);
""".replace("TILE", str(TILE))
)
def clear_nodes(values: wp.array(dtype=Any), node: int, count: int):
    """Zero some nodes."""
    ...


@cache
def clear_kernel(n_floats: int) -> wp.Kernel:
    """What adam_step has to do with gradients of nodes with so many floats."""
    Gradient = gradient_type(n_floats)

    @wp.kernel(module="unique", enable_backward=False)
    def clear(
        first: int,
        span: int,  # nodes per thread
        gradient: Gradient,  # zeroed where it was touched
    ):
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
                tiles = without_first(tiles)

    return clear


def gradients_of(storage: Storage, gradients: Gradients) -> dict[str, np.ndarray]:
    """Of each array of what a field is stored in, entry by entry; of all workers together."""
    found = {}
    for name, values in storage.tensors().items():
        gradient = gradients.arrays[name].numpy()
        if storage.kind.rules[name] != "nodes":
            gradient = gradient.sum(axis=0)[: values.size]
        found[name] = gradient.reshape(values.shape)
    return found


class WarpStep:
    """A workload's training step in warpnerf."""

    def __init__(self, work: Workload, threads: int, device: str) -> None:
        """Load a workload."""
        self._workers = workers = Workers(device, threads)
        self._work = work
        self._size = work.values.shape
        self._model = work.warp_model()
        self._weights = work.weights(workers)
        self._grid = work.voxel_grid(workers)
        self._free = work.free_cells(workers)
        self._steps = work.steps()
        self._batch = work.batch(workers)
        self._launches = LaunchCache()
        scaling = "clamped" if work.scaled else "none"
        self._pass = TrainingPass(
            self._batch.count,
            self._model,
            self._grid,
            self._weights,
            self._steps,
            scaling,
            "none",
            workers,
        )

    def step(self) -> None:
        """Zero what the last step touched, then the training pass."""
        gradients = self._pass.gradients
        span = 1 if self._workers.device.is_cuda else NODES_PER_THREAD
        for name, rule in self._grid.kind.rules.items():
            array = gradients.arrays[name]
            if rule != "nodes":
                array.zero_()
                continue
            n, clear = -(-array.shape[0] // span), clear_kernel(array.dtype._length_)
            entries = gradients.entries(name, "touched")
            self._workers.launch(clear, n, span, entries, cache=self._launches)
        gradients.touched.zero_()
        gradients.weights.zero_()
        self._pass.run(self._free, self._batch)

    def gradient(self) -> np.ndarray:
        """[X, Y, Z, n_values] of a dense grid."""
        return self._pass.gradients.values.numpy().reshape(self._size)

    def gradients(self) -> dict[str, np.ndarray]:
        """Of each array of what a field is stored in, entry by entry; of all workers together."""
        return gradients_of(self._grid, self._pass.gradients)

    def network_gradient(self) -> np.ndarray:
        """[n_parameters], weights and biases in turn; of all workers together."""
        weights = self._pass.gradients.weights.numpy().sum(axis=0)[: self._weights.shape[0]]
        n_outputs = 4 * (MODELS[self._work.model].width + 1) if weights.size else 0
        before = weights.size - n_outputs
        return np.concatenate([weights[:before], weights[before:].reshape(-1, 4)[:, :3].ravel()])

    def rgb(self) -> np.ndarray:
        """[n_rays, 3]"""
        batch = self._batch
        return render_rays(
            self._model,
            self._grid,
            self._weights,
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
        return int(self.samples_of_rays().sum())

    def samples_of_rays(self) -> np.ndarray:
        """The same of each ray, [n_rays]."""
        return self._pass.n_samples.numpy()

    def scratch_bytes(self) -> tuple[int, int]:
        """Of the training pass but the gradient: what a step uses, and what it has room for."""
        gradients = self._pass.gradients
        arrays = [*vars(self._pass).values(), gradients.touched, gradients.weights]
        used = sum(array.capacity for array in arrays if isinstance(array, wp.array))
        sink = self._pass.launch.sink
        if sink is None:
            return used, used
        room = used + sink.records.capacity + sink.recipients.capacity
        records = sink.records.numpy()
        records = records.view(np.uint8).reshape(-1, records.dtype.itemsize)
        records.fill(255)
        sink.recipients.fill_(-1)
        self.step()
        used += int((records != 255).any(axis=1).sum()) * records.shape[1]
        used += 4 * int((sink.recipients.numpy() != -1).sum())
        return used, room


def obstacle(device: str) -> str | None:
    """It runs wherever the benchmark does."""
    return None


load = WarpStep
