"""Launches of warpnerf that end in a gradient, scaled or not, on the same arrays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from candidates.warpnerf_step import gradients_of
from warpnerf_kernels.base.types import real, vec3
from warpnerf_kernels.launch import assembly
from workload import Workload

from warpnerf.config import Scaling
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.occupancy import FreeCells
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.render import TrainingPass
from warpnerf.rendering.structs import (
    FieldStructs,
    render_outputs_struct,
    render_params_struct,
    scratch_struct,
    variant_of,
)
from warpnerf.runtime.parallel import Workers

Call = Callable[[], object]


class WarpAdjoint:
    """The workload's launches in warpnerf, for each scaling, on the same arrays."""

    def __init__(self, work: Workload, device: str, threads: int, n_samples: int) -> None:
        """Load a workload and render its samples once, for what the adjoint starts from."""
        self._workers = workers = Workers(device, threads)
        self._model = work.warp_model()
        self._grid = work.voxel_grid(workers)
        self._weights = work.weights(workers)
        self._free = FreeCells.none(workers)
        self._steps = work.steps()
        self._batch = work.batch(workers)
        self._scene = render_params_struct(
            self._model,
            "float32",
            FieldStructs.of(self._grid, self._weights, self._free, self._steps, self._workers),
            self._steps,
            workers,
            stored=self._grid.kind,
        )
        self._seen = self._render()
        n = int(self._seen.n_samples.numpy().sum())
        if n != n_samples:
            raise SystemExit(f"gradient_scaling: {n} samples were visited, not {n_samples}.")
        rgb = self._seen.rgb.numpy()
        self._adj_rgb = wp.array(
            2.0 / len(rgb) * (rgb - work.target_rgb), dtype=vec3, device=workers.device
        )
        self._nothing = wp.zeros(len(rgb), dtype=real, device=workers.device)
        self._passes = {scaling: self._training_pass(scaling) for scaling in ("none", "clamped")}
        share_memory(self._passes["none"], self._passes["clamped"])

    def _variant(self, scaling: Scaling) -> assembly.Variant:
        packed = not self._workers.device.is_cuda
        return variant_of(
            *(self._model, "float32", "none", scaling, "none", packed), stored=self._grid.kind
        )

    def _render(self) -> Any:
        variant, n = self._variant("none"), self._batch.count
        seen = render_outputs_struct(variant, n, self._workers, assembly)
        self._workers.launch_owned(
            assembly.render_forward_kernel(variant),
            -(-n // variant.batch),
            n,
            self._scene,
            self._batch.struct,
            scratch_struct(variant, 1, self._workers, assembly),
            seen,
        )
        return seen

    def _training_pass(self, scaling: Scaling) -> TrainingPass:
        return TrainingPass(
            self._batch.count,
            self._model,
            self._grid,
            self._weights,
            self._steps,
            scaling,
            "none",
            self._workers,
        )

    @property
    def gradients(self) -> Gradients:
        """What all launches add to."""
        return self._passes["none"].gradients

    def train(self, scaling: Scaling) -> Call:
        """The fused launch."""
        training_pass = self._passes[scaling]
        return lambda: training_pass.run(self._free, self._batch)

    def backward(self, scaling: Scaling) -> Call:
        """The adjoint launch."""
        variant = self._variant(scaling)
        launch = AdjointLaunch(
            assembly.render_backward_kernel(variant),
            variant,
            self._model.most_steps(self._steps, self._grid.lattice.diagonal),
            self._batch.count,
            self._workers,
        )
        share_sink(self._passes["none"].launch, launch)
        arguments = (
            self._scene,
            self._batch.struct,
            self._seen,
            self._adj_rgb,
            self._nothing,
            self._nothing,
            scratch_struct(variant, 1, launch.workers, assembly),
        )
        gradient = self.gradients.struct
        return lambda: launch.run(self._batch.count, gradient, *arguments)

    def gradient_of(self, launch: Call) -> dict[str, np.ndarray]:
        """What a launch adds to each array of what the field is stored in, entry by entry."""
        for array in self.gradients.arrays.values():
            array.zero_()
        launch()
        return gradients_of(self._grid, self.gradients)


def share_memory(of: TrainingPass, to: TrainingPass) -> None:
    """Give one pass the other's arrays, so that the two differ in what they do and not where."""
    for name, value in vars(of).items():
        if isinstance(value, wp.array | Gradients):
            vars(to)[name] = value
    to._scene, to._outputs = of._scene, of._outputs
    if of.launch.sink is not None:
        to._scratch.packs, to._scratch.rows = of._scratch.packs, of._scratch.rows
    share_sink(of.launch, to.launch)


def share_sink(of: AdjointLaunch, to: AdjointLaunch) -> None:
    """Have two launches leave records in the same place, with where workers meet."""
    to.sink = of.sink
