"""The kernels, driven through rendering problems."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray
from warpnerf_kernels.base import precision, tiles

from tests.support.problems import Float64, Problem
from warpnerf.fields.gradients import gradient_struct
from warpnerf.fields.lattice import box_struct, frustum_struct, grid_struct
from warpnerf.fields.occupancy import free_struct
from warpnerf.fields.storage import density_struct
from warpnerf.rendering.adjoint import AdjointLaunch
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.structs import (
    FieldStructs,
    render_outputs_struct,
    render_params_struct,
    scratch_struct,
    train_outputs,
    variant_of,
)
from warpnerf.runtime.parallel import Workers


@dataclass(frozen=True, kw_only=True)
class Rendered:
    """What rays see, in numpy."""

    rgb: Float64  # [n_rays, 3]
    opacity: Float64  # [n_rays]
    depth: Float64  # [n_rays]
    n_samples: NDArray[np.int32]  # [n_rays]


class Kernels:
    """The rendering kernels in one precision, on one device."""

    def __init__(self, name: str, device: str, threads: int = 1, packed: bool = False) -> None:
        self.workers = Workers(device, threads)
        self.device = self.workers.device
        # One thread, for plain kernels that add.
        self.alone = self.workers if self.device.is_cuda else Workers(device, 1)
        self.packed = packed
        self.precision = name
        self.assembly = precision.load(name, "launch.assembly")
        self.types = precision.load(name, "base.types")
        self.dtype = np.float64 if name == "float64" else np.float32

    def module(self, name: str) -> Any:
        """Another module of the kernels in this precision."""
        return precision.load(self.precision, name)

    def array(self, values: Any, dtype: Any = None) -> wp.array:
        """[...] numbers, or [..., n] of a vector type, on the device."""
        dtype = dtype or self.types.real
        return wp.array(np.ascontiguousarray(values, self.dtype), dtype=dtype, device=self.device)

    def zeros(self, n: int | tuple[int, ...], dtype: Any = None) -> wp.array:
        return wp.zeros(n, dtype=dtype or self.types.real, device=self.device)

    def grid(self, p: Problem) -> Any:
        """The problem's grid as kernels take it."""
        n_floats = p.raw.shape[3]
        values = self.array(p.raw.reshape(-1, n_floats), self.types.vector(n_floats))
        size = (p.raw.shape[0], p.raw.shape[1], p.raw.shape[2])
        return grid_struct(self.module("fields.dense"), values, size, p.border)

    def box(self, p: Problem) -> Any:
        """Its box likewise."""
        box = box_struct(self.types, p.box_min, p.box_max, p.border)
        if p.frustum is not None:
            box.frustum = frustum_struct(self.types, p.frustum, p.steps.near, p.steps.far)
        return box

    def density(self, p: Problem) -> Any:
        """And what its densities mean."""
        return density_struct(self.types, p.density_shift, p.density_scale)

    def march(self, p: Problem) -> Any:
        """And how it is marched."""
        return p.steps.struct(self.module("sampling.steps"))

    def scene(self, p: Problem, workers: Workers | None = None) -> Any:
        """The parameters of a rendering launch: the scene that rays are marched through."""
        distance = wp.array(p.free.ravel(), dtype=wp.uint8, device=self.device)
        size = (p.free.shape[0], p.free.shape[1], p.free.shape[2])
        return render_params_struct(
            p.model,
            self.precision,
            FieldStructs(
                box=self.box(p),
                free=free_struct(self.types, distance, size, p.border),
                values=self.grid(p),
                density=self.density(p),
                weights=self.array(p.weights),
            ),
            p.steps,
            workers or self.workers,
            objective=p.objective,
        )

    def rays(self, p: Problem) -> Any:
        """The rays."""
        vec3 = self.types.vec3
        return rays_struct(
            self.assembly,
            self.array(p.origins, vec3),
            self.array(p.directions, vec3),
            self.array(p.offsets),
            self.array(p.background, vec3),
            self.array(p.content_distance),
        )

    def variant(self, p: Problem, scaling: str = "none", jacobian: str = "none") -> Any:
        return variant_of(
            p.model,
            self.precision,
            p.contraction,
            scaling,
            jacobian,
            self.packed,
            p.objective.config,
        )

    def scratch(self, variant: Any, capacity: int, workers: Workers | None = None) -> Any:
        """Room to keep so many packs of each worker."""
        return scratch_struct(variant, capacity, workers or self.workers, self.assembly)

    def seen(self, p: Problem) -> Any:
        """What the forward launch writes."""
        variant = self.variant(p)
        seen = render_outputs_struct(variant, p.n_rays, self.workers, self.assembly)
        self.workers.launch_owned(
            self.assembly.render_forward_kernel(variant),
            -(-p.n_rays // variant.batch),
            p.n_rays,
            self.scene(p),
            self.rays(p),
            self.scratch(variant, 0),
            seen,
        )
        return seen

    def forward(self, p: Problem) -> Rendered:
        """Render."""
        seen = self.seen(p)
        return Rendered(
            rgb=seen.rgb.numpy(),
            opacity=1.0 - seen.transmittance.numpy(),
            depth=seen.depth.numpy(),
            n_samples=seen.n_samples.numpy(),
        )

    def backward(self, p: Problem, scaling: str = "none", jacobian: str = "none") -> Float64:
        """The gradient [X, Y, Z, n_floats] of the outputs' product with the problem's adjoints."""
        gradient = self.no_gradient(p)
        self.add_backward(p, gradient, scaling, jacobian)
        return found_gradient(gradient).reshape(p.raw.shape)

    def both_backward(
        self, p: Problem, scaling: str = "none", jacobian: str = "none"
    ) -> tuple[Float64, Float64]:
        """That, and the gradient of the weights."""
        gradient = self.no_gradient(p)
        self.add_backward(p, gradient, scaling, jacobian)
        weights = gradient.weights.numpy().sum(axis=0)
        return found_gradient(gradient).reshape(p.raw.shape), weights

    def add_backward(
        self, p: Problem, gradient: Any, scaling: str = "none", jacobian: str = "none"
    ) -> None:
        """Add that to a kernel's Gradient."""
        variant = self.variant(p, scaling, jacobian)
        launch = self.adjoint(p, self.assembly.render_backward_kernel(variant), variant)
        launch.run(
            p.n_rays,
            gradient,
            self.scene(p, launch.workers),
            self.rays(p),
            self.seen(p),
            self.array(p.adj_rgb, self.types.vec3),
            self.array(p.adj_opacity),
            self.array(p.adj_depth),
            self.scratch(variant, 0, launch.workers),
        )

    def adjoint(self, p: Problem, kernel: wp.Kernel, variant: Any) -> AdjointLaunch:
        """How to launch a kernel that ends in a gradient."""
        length = float(np.linalg.norm(p.box_max - p.box_min))
        most = p.model.most_steps(p.steps, math.inf if p.contraction != "none" else length)
        return AdjointLaunch(kernel, variant, most, p.n_rays, self.workers)

    def no_gradient(self, p: Problem) -> Any:
        """A kernel's Gradient for a problem, zero."""
        n_nodes, n_floats = math.prod(p.raw.shape[:3]), p.raw.shape[3]
        return self.gradient(n_nodes, n_floats, n_weights=len(p.weights))

    def gradient(self, n_nodes: int, n_floats: int, *, n_weights: int = 0, flag: int = 0) -> Any:
        """A kernel's Gradient, zero, all tiles flagged alike."""
        touched = wp.full(-(-n_nodes // tiles.TILE), flag, dtype=wp.uint8, device=self.device)
        return gradient_struct(
            self.types,
            self.zeros(n_nodes, self.types.vector(n_floats)),
            touched,
            self.zeros((self.workers.count, n_weights)),
        )

    def train(
        self, p: Problem, scaling: str = "none", jacobian: str = "none", capacity: int = 64
    ) -> tuple[Float64, Float64]:
        """Losses of rays [n_rays], and the gradient [X, Y, Z, n_floats] of their mean."""
        return self.both_train(p, scaling, jacobian, capacity)[:2]

    def both_train(
        self, p: Problem, scaling: str = "none", jacobian: str = "none", capacity: int = 64
    ) -> tuple[Float64, Float64, Float64]:
        """That, and the gradient of the weights."""
        outputs = train_outputs(p.n_rays, self.precision, self.workers)
        gradient = self.no_gradient(p)
        variant = self.variant(p, scaling, jacobian)
        launch = self.adjoint(p, self.assembly.render_train_kernel(variant), variant)
        launch.run(
            p.n_rays,
            gradient,
            self.scene(p, launch.workers),
            self.rays(p),
            self.array(p.target, self.types.vec3),
            1.0 / p.n_rays,
            self.scratch(variant, capacity, launch.workers),
            outputs,
        )
        found = found_gradient(gradient).reshape(p.raw.shape)
        return outputs.loss.numpy(), found, gradient.weights.numpy().sum(axis=0)


def found_gradient(gradient: Any) -> Float64:
    """What a kernel has added [n_nodes, n_floats]; every tile that holds some must be flagged."""
    values = gradient.values.numpy()
    flags = np.pad(gradient.touched.numpy(), (0, 1))
    tile = np.flatnonzero(values.any(axis=1)) // tiles.TILE
    assert (flags[tile] | flags[tile - 1]).all()
    return np.asarray(values)
