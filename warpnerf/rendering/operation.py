"""Differentiable rendering as launches over arrays, for frameworks with autograd.

A framework passes the memory of its arrays as Warp arrays, and makes those for the results. On
CUDA launches go to Warp's current stream: who works on another one sets it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import warp as wp

from warpnerf.config import Scaling
from warpnerf.fields.gradients import n_tiles, zero_weights
from warpnerf.fields.lattice import box_struct
from warpnerf.fields.occupancy import free_struct
from warpnerf.fields.storage import Storage, density_struct
from warpnerf.fields.storages import class_of
from warpnerf.model.interface import Load, loader
from warpnerf.model.sampler_kinds import MARCHED, Resampled
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.proposal import Intervals
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.stored import Layout
from warpnerf.rendering.structs import (
    AnySteps,
    FieldStructs,
    most_samples,
    render_params_struct,
    scratch_struct,
    variant_of,
)
from warpnerf.runtime import kernel_cache
from warpnerf.runtime.parallel import Workers


class Inputs(NamedTuple):
    """What is rendered, in the operation's precision and on its device."""

    stored: Mapping[str, wp.array]
    """What the field stores, by name, as ``Layout.arrays`` says."""
    weights: wp.array
    """[n_weights] of the model's head."""
    origins: wp.array
    """[n_rays] vec3, scene units."""
    directions: wp.array
    """[n_rays] vec3 of unit length."""
    background: wp.array
    """[n_rays] or [1] vec3, rgb."""
    content_distance: wp.array
    """[n_rays] or [1], scene units."""
    edges: wp.array
    """[n_rays, n_intervals + 1] in rising order, scene units; anything where rays are marched."""


class Outputs(NamedTuple):
    """What rays see; ``backward`` takes them as ``forward`` has written them."""

    rgb: wp.array
    """[n_rays] vec3, with background."""
    transmittance: wp.array
    """[n_rays] in [0, 1]."""
    depth: wp.array
    """[n_rays] sum of weight times t, scene units."""
    n_samples: wp.array
    """[n_rays] int32, visited steps."""
    channels: wp.array
    """[n_rays] vectors of ``Operation.n_channels``, what was accumulated along the ray."""


@dataclass(frozen=True, kw_only=True)
class Operation:
    """What a rendering depends on besides arrays: rays through a field in a box.

    Where the arrays of a call are, on the CPU or on a CUDA device, its launches are.
    """

    layout: Layout
    """How the field is stored."""
    precision: str
    """float32 or float64."""
    steps: Steps
    """How rays are marched; of this, near and far alone count for intervals."""
    n_intervals: int
    """Of each ray, with a sample in the middle of each; 0: rays are marched."""
    density_shift: float
    """Added to raw densities before their activation."""
    scaling: Scaling
    """Of each sample's gradient, by its distance."""

    def __post_init__(self) -> None:
        """Start Warp, without which no memory can be passed."""
        kernel_cache.start()

    @property
    def types(self) -> ModuleType:
        """``warpnerf_kernels.base.types`` in its precision: real, vec3, vector(n)."""
        return self._load("base.types")

    @property
    def n_channels(self) -> int:
        """Numbers of a ray that are accumulated along it."""
        return int(self._variant("none").parts.head.n_channels)

    def forward(self, inputs: Inputs, out: Outputs, interval_weights: wp.array) -> None:
        """Render rays.

        Args:
            inputs: What is rendered.
            out: Written.
            interval_weights: [n_rays, n_intervals] zeros, written where a sample is visited.
        """
        assembly, workers, n = self._assembly, _workers(inputs), inputs.origins.shape[0]
        variant = self._variant("none", workers)
        workers.launch_owned(
            assembly.render_forward_kernel(variant),
            -(-n // variant.batch),
            n,
            self._scene(
                inputs, self._storage(inputs), self._steps(inputs, interval_weights), workers
            ),
            self._rays(inputs),
            scratch_struct(variant, 0, workers, assembly),
            self._seen(out),
            rays=variant.batch,
        )

    def backward(
        self,
        inputs: Inputs,
        outputs: Outputs,
        output_gradients: tuple[wp.array, wp.array, wp.array],
        stored_gradient: Mapping[str, wp.array],
        weights_gradient: wp.array,
    ) -> None:
        """Compute the scaled gradients of what is stored and of weights; rays are rendered once
        more.

        Args:
            inputs: As ``forward`` had them.
            outputs: As ``forward`` wrote them.
            output_gradients: Gradients of rgb, of opacity and of depth.
            stored_gradient: Zeros like what is stored, written.
            weights_gradient: [n_weights] written.
        """
        n_rays, model, workers = inputs.origins.shape[0], self.layout.model, _workers(inputs)
        variant, storage = self._variant(self.scaling, workers), self._storage(inputs)
        nobody_asks = wp.empty((0, 0), dtype=self.types.real, device=inputs.origins.device)
        steps = self._steps(inputs, nobody_asks)
        launch = AdjointLaunch(
            self._assembly.render_backward_kernel(variant),
            variant,
            # Directions may be a little too short.
            most_samples(model, steps, 1.01 * self.layout.lattice.diagonal),
            n_rays,
            workers,
        )
        gradient = self.layout.kind.encoding(self._load, model).Gradient()
        shared = {"weights": weights_gradient}
        for parameter in storage.parameters(model, OptimConfig()):
            array, (name, *flags) = stored_gradient[parameter.name], parameter.gradient
            if flags:
                tiles = wp.zeros(n_tiles(array.shape[0]), dtype=wp.uint8, device=array.device)
                setattr(gradient, name, array)
                setattr(gradient, flags[0], tiles)
            else:
                shared[name] = array
        real = self.types.real
        for name, array in shared.items():  # a row for each worker
            setattr(gradient, name, zero_weights(array.shape[0], launch.workers, real))
        launch.run(
            n_rays,
            gradient,
            self._scene(inputs, storage, steps, launch.workers),
            self._rays(inputs),
            self._seen(outputs),
            *output_gradients,
            scratch_struct(variant, 0, launch.workers, self._assembly),
        )
        for name, array in shared.items():
            _sum_rows(getattr(gradient, name), array)

    @property
    def _load(self) -> Load:
        return loader(self.precision)

    @property
    def _assembly(self) -> ModuleType:
        return self._load("launch.assembly")

    def _variant(self, scaling: Scaling, workers: Workers | None = None) -> Any:
        on_cpu = workers is not None and not workers.device.is_cuda
        return variant_of(
            self.layout.model,
            self.precision,
            "none",
            scaling,
            "none",
            packed=self.precision == "float32" and on_cpu,
            stored=self.layout.kind,
            sampler=Resampled(samples=self.n_intervals) if self.n_intervals else MARCHED,
        )

    def _seen(self, outputs: Outputs) -> Any:
        rendered = self._assembly.render_outputs_type(self.n_channels)()
        for name, array in outputs._asdict().items():
            setattr(rendered, name, array)
        return rendered

    def _storage(self, inputs: Inputs) -> Storage:
        kind, model, lattice = self.layout.kind, self.layout.model, self.layout.lattice
        return class_of(kind).over(kind, model, lattice, inputs.stored).as_final()

    def _steps(self, inputs: Inputs, interval_weights: wp.array) -> AnySteps:
        """How rays are marched, or their intervals."""
        if not self.n_intervals:
            return self.steps
        return Intervals(
            kind=Resampled(samples=self.n_intervals),
            steps=self.steps,
            edges=inputs.edges,
            weights=interval_weights,
        )

    def _scene(self, inputs: Inputs, storage: Storage, steps: AnySteps, workers: Workers) -> Any:
        """What rays are marched through, as kernels take it."""
        types, lattice = self.types, self.layout.lattice
        occupied = wp.zeros(1, dtype=wp.uint8, device=inputs.origins.device)
        return render_params_struct(
            self.layout.model,
            self.precision,
            FieldStructs(
                box=box_struct(types, lattice.box_min, lattice.box_max, 0.0),
                free=free_struct(types, occupied, (1, 1, 1), 0.0),
                values=storage.struct_in(self._load, workers),
                density=density_struct(types, self.density_shift, 1.0),
                weights=inputs.weights,
            ),
            steps,
            workers,
            stored=self.layout.kind,
        )

    def _rays(self, inputs: Inputs) -> Any:
        """The rays, as kernels take them: samples sit in the middles of steps."""
        return rays_struct(
            self._assembly,
            inputs.origins,
            inputs.directions,
            wp.full(1, 0.5, dtype=self.types.real, device=inputs.origins.device),
            inputs.background,
            inputs.content_distance,
        )


def _sum_rows(rows: wp.array, out: wp.array) -> None:
    """Write the sum of rows, [n_workers, n or more], to [n]; on CUDA there is one."""
    n = out.shape[0]
    if rows.device.is_cuda:
        wp.copy(out, rows.flatten(), count=n)
    else:
        rows.numpy()[:, :n].sum(axis=0, out=out.numpy())


def _workers(inputs: Inputs) -> Workers:
    return workers_of(str(inputs.origins.device))


@cache
def workers_of(device: str) -> Workers:
    """All workers of a device; the same at each call."""
    return Workers(device)
