"""Differentiable rendering as launches over arrays, for frameworks with autograd.

A framework passes the memory of its arrays as Warp arrays, and makes those for the results. On
CUDA launches go to Warp's current stream: who works on another one sets it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from warpnerf.config import Scaling
from warpnerf.fields.gradients import gradient_struct, n_tiles
from warpnerf.fields.lattice import box_struct, grid_struct
from warpnerf.fields.occupancy import free_struct
from warpnerf.fields.storage import density_struct
from warpnerf.model.interface import Load, Model, loader
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.structs import (
    FieldStructs,
    render_params_struct,
    scratch_struct,
    variant_of,
)
from warpnerf.runtime.parallel import Workers


class Inputs(NamedTuple):
    """What is rendered, in the operation's precision and on its device."""

    raw: wp.array
    """[n_nodes] vectors: raw density, raw features."""
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


@dataclass(frozen=True, kw_only=True, eq=False)
class Operation:
    """What a rendering depends on besides arrays: rays through a dense grid in a box."""

    model: Model
    """What the grid holds, and how that becomes colour."""
    precision: str
    """float32 or float64."""
    device: str
    """Where the arrays are: cpu, cuda:0, ..."""
    size: tuple[int, int, int]
    """Nodes of the grid along each axis."""
    corners: tuple[np.ndarray, np.ndarray]
    """[3] each of the box, scene units."""
    steps: Steps
    """How rays are marched."""
    density_shift: float
    """Added to raw densities before their activation."""
    scaling: Scaling
    """Of each sample's gradient, by its distance."""

    def __post_init__(self) -> None:
        """Start Warp, without which no memory can be passed."""
        workers_of(self.device)

    @property
    def types(self) -> ModuleType:
        """``warpnerf_kernels.base.types`` in its precision: real, vec3, vector(n)."""
        return self._load("base.types")

    @property
    def n_channels(self) -> int:
        """Numbers of a ray that are accumulated along it."""
        return int(self._variant("none").parts.head.n_channels)

    @property
    def n_tiles(self) -> int:
        """Flags that ``backward`` sets, one for some nodes."""
        return n_tiles(self.size[0] * self.size[1] * self.size[2])

    def forward(self, inputs: Inputs, out: Outputs) -> None:
        """Render rays.

        Args:
            inputs: What is rendered.
            out: Written.
        """
        assembly, workers, n = self._assembly, workers_of(self.device), inputs.origins.shape[0]
        variant = self._variant("none")
        workers.launch_owned(
            assembly.render_forward_kernel(variant),
            -(-n // variant.batch),
            n,
            self._scene(inputs, workers),
            self._rays(inputs),
            scratch_struct(variant, 0, workers, assembly),
            self._seen(out),
            rays=variant.batch,
        )

    def adjoint(self, n_rays: int) -> AdjointLaunch:
        """What ``backward`` launches; its workers' number is that of rows of weights' gradients.

        Args:
            n_rays: How many there are.
        """
        variant = self._variant(self.scaling)
        diagonal = float(np.linalg.norm(self.corners[1] - self.corners[0]))
        # Directions may be a little too short.
        most_steps = self.model.most_steps(self.steps, 1.01 * diagonal)
        kernel = self._assembly.render_backward_kernel(variant)
        return AdjointLaunch(kernel, variant, most_steps, n_rays, workers_of(self.device))

    def backward(
        self,
        launch: AdjointLaunch,
        inputs: Inputs,
        outputs: Outputs,
        output_gradients: tuple[wp.array, wp.array, wp.array],
        raw_gradient: wp.array,
        touched: wp.array,
        weights_gradient: wp.array,
    ) -> None:
        """Add the scaled gradients of raw values and weights; rays are rendered once more.

        Args:
            launch: From ``adjoint``.
            inputs: As ``forward`` had them.
            outputs: As ``forward`` wrote them.
            output_gradients: Gradients of rgb, of opacity and of depth.
            raw_gradient: [n_nodes] vectors, added to.
            touched: [n_tiles] uint8, set where something was added.
            weights_gradient: [n_workers, n_weights] added to; the gradient is their sum.
        """
        variant, workers = self._variant(self.scaling), launch.workers
        launch.run(
            inputs.origins.shape[0],
            gradient_struct(self.types, raw_gradient, touched, weights_gradient),
            self._scene(inputs, workers),
            self._rays(inputs),
            self._seen(outputs),
            *output_gradients,
            scratch_struct(variant, 0, workers, self._assembly),
        )

    @property
    def _load(self) -> Load:
        return loader(self.precision)

    @property
    def _assembly(self) -> ModuleType:
        return self._load("launch.assembly")

    def _variant(self, scaling: Scaling) -> Any:
        packed = self.precision == "float32" and not workers_of(self.device).device.is_cuda
        return variant_of(self.model, self.precision, "none", scaling, "none", packed)

    def _seen(self, outputs: Outputs) -> Any:
        rendered = self._assembly.render_outputs_type(self.n_channels)()
        for name, array in outputs._asdict().items():
            setattr(rendered, name, array)
        return rendered

    def _scene(self, inputs: Inputs, workers: Workers) -> Any:
        """What rays are marched through, as kernels take it."""
        types = self.types
        occupied = wp.zeros(1, dtype=wp.uint8, device=inputs.raw.device)
        return render_params_struct(
            self.model,
            self.precision,
            FieldStructs(
                box=box_struct(types, *self.corners, 0.0),
                free=free_struct(types, occupied, (1, 1, 1), 0.0),
                values=grid_struct(self._load("fields.dense"), inputs.raw, self.size, 0.0),
                density=density_struct(types, self.density_shift, 1.0),
                weights=inputs.weights,
            ),
            self.steps,
            workers,
        )

    def _rays(self, inputs: Inputs) -> Any:
        """The rays, as kernels take them: samples sit in the middles of steps."""
        return rays_struct(
            self._assembly,
            inputs.origins,
            inputs.directions,
            wp.full(1, 0.5, dtype=self.types.real, device=inputs.raw.device),
            inputs.background,
            inputs.content_distance,
        )


@cache
def workers_of(device: str) -> Workers:
    """All workers of a device; the same at each call."""
    return Workers(device)
