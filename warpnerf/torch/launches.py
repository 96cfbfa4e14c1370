"""A rendering and its adjoint as launches, on the memory of torch tensors."""

from __future__ import annotations

from functools import cache
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from warpnerf.config import Scaling
from warpnerf.model.grid import box_struct, density_struct, free_struct, grid_struct
from warpnerf.model.interface import Load, Model, loader
from warpnerf.rendering.adjoint import AdjointLaunch, gradient_struct, n_tiles
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.render import Steps, scene_struct, scratch_struct, variant_of
from warpnerf.runtime.parallel import Workers
from warpnerf.torch.tensors import PRECISIONS


class Call(NamedTuple):
    """What a rendering depends on besides tensors with gradients and rays."""

    corners: tuple[np.ndarray, np.ndarray]
    steps: Steps
    density_shift: float
    background: torch.Tensor
    scaling: Scaling
    content_distance: torch.Tensor
    model: Model


class Render(torch.autograd.Function):
    """render_rays, forward and backward, each one launch."""

    @staticmethod
    def forward(
        ctx: Any,
        raw: torch.Tensor,
        weights: torch.Tensor,
        origins: torch.Tensor,
        directions: torch.Tensor,
        call: Call,
    ) -> tuple[torch.Tensor, ...]:
        """Rgb, opacity and depth of the rays."""
        load = device_code(raw)
        assembly, types = load("launch.assembly"), load("base.types")
        n = len(origins)
        workers = _workers(str(raw.device))
        variant = _variant(raw, call, "none")
        seen = assembly.seen_type(variant.parts.head.n_channels)()
        channels = raw.new_empty(n, variant.parts.head.n_channels)
        rgb, transmittance, depth = raw.new_empty(n, 3), raw.new_empty(n), raw.new_empty(n)
        n_samples = torch.empty(n, dtype=torch.int32, device=raw.device)
        _fill(seen, types, rgb, transmittance, depth, n_samples, channels)
        with _stream(raw):
            workers.launch_owned(
                assembly.render_forward_kernel(variant),
                -(-n // variant.batch),
                n,
                _scene(raw, weights, call, workers),
                _ray_arrays(raw, origins, directions, call),
                scratch_struct(variant, 0, workers, assembly),
                seen,
                rays=variant.batch,
            )
        ctx.call = call
        ctx.save_for_backward(
            raw, weights, origins, directions, rgb, transmittance, depth, n_samples, channels
        )
        return rgb, 1.0 - transmittance, depth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients of raw and weights; rays are rendered once more."""
        raw, weights, origins, directions, *outputs = ctx.saved_tensors
        call: Call = ctx.call
        load = device_code(raw)
        assembly, types = load("launch.assembly"), load("base.types")
        adj_rgb, adj_opacity, adj_depth = (grad.contiguous() for grad in grads)
        variant = _variant(raw, call, call.scaling)
        diagonal = float(np.linalg.norm(call.corners[1] - call.corners[0]))
        launch = AdjointLaunch(
            assembly.render_backward_kernel(variant),
            variant,
            call.model.most_steps(
                call.steps, 1.01 * diagonal
            ),  # directions may be a little too short
            len(origins),
            _workers(str(raw.device)),
        )
        workers = launch.workers
        n_floats, n_nodes = raw.shape[3], raw.shape[:3].numel()
        adj_raw = raw.new_zeros(raw.shape)
        adj_weights = raw.new_zeros(workers.count, len(weights))
        touched = torch.zeros(n_tiles(n_nodes), dtype=torch.uint8, device=raw.device)
        gradient = gradient_struct(
            types,
            _array(adj_raw.reshape(-1, n_floats), types.vector(n_floats)),
            _array(touched),
            _array(adj_weights),
        )
        seen = assembly.seen_type(variant.parts.head.n_channels)()
        _fill(seen, types, *outputs)
        with _stream(raw):
            launch.run(
                len(origins),
                gradient,
                _scene(raw, weights, call, workers),
                _ray_arrays(raw, origins, directions, call),
                seen,
                _array(adj_rgb, types.vec3),
                _array(adj_opacity),
                _array(adj_depth),
                scratch_struct(variant, 0, workers, assembly),
            )
        return adj_raw, adj_weights.sum(dim=0), None, None, None


@cache
def _workers(device: str) -> Workers:
    return Workers(device)


def device_code(raw: torch.Tensor) -> Load:
    """Kernels in raw's precision."""
    return loader(PRECISIONS[raw.dtype])


def _variant(raw: torch.Tensor, call: Call, scaling: Scaling) -> Any:
    name, packed = PRECISIONS[raw.dtype], raw.dtype == torch.float32 and not raw.is_cuda
    return variant_of(call.model, name, "none", scaling, "none", packed)


def _fill(
    seen: Any,
    types: ModuleType,
    rgb: torch.Tensor,
    transmittance: torch.Tensor,
    depth: torch.Tensor,
    n_samples: torch.Tensor,
    channels: torch.Tensor,
) -> None:
    seen.rgb, seen.transmittance = _array(rgb, types.vec3), _array(transmittance)
    seen.depth, seen.n_samples = _array(depth), _array(n_samples)
    seen.channels = _array(channels, types.vector(channels.shape[1]))


def _stream(raw: torch.Tensor) -> Any:
    """Work in torch's own order on CUDA; nothing to do on the CPU."""
    if raw.is_cuda:
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(raw.device)))
    import contextlib

    return contextlib.nullcontext()


def _array(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """The tensor's memory as a Warp array; contiguous tensors only."""
    if tensor.numel() == 0:
        tensor = tensor.new_empty(tensor.shape)  # an empty view may have any strides
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


def _scene(raw: torch.Tensor, weights: torch.Tensor, call: Call, workers: Workers) -> Any:
    """What rays are marched through, as kernels take it."""
    load = device_code(raw)
    types = load("base.types")
    n_floats, size = raw.shape[3], (raw.shape[0], raw.shape[1], raw.shape[2])
    values = _array(raw.detach().contiguous().reshape(-1, n_floats), types.vector(n_floats))
    occupied = wp.zeros(1, dtype=wp.uint8, device=values.device)
    return scene_struct(
        call.model,
        PRECISIONS[raw.dtype],
        box=box_struct(types, *call.corners, 0.0),
        free=free_struct(types, occupied, (1, 1, 1), 0.0),
        steps=call.steps,
        grid=grid_struct(load("fields.dense"), values, size, 0.0),
        density=density_struct(types, call.density_shift, 1.0),
        weights=_array(weights),
        workers=workers,
    )


def _ray_arrays(
    raw: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor, call: Call
) -> Any:
    """The rays, as kernels take them."""
    load = device_code(raw)
    types = load("base.types")
    return rays_struct(
        load("launch.assembly"),
        _array(origins, types.vec3),
        _array(directions, types.vec3),
        _array(raw.new_full((1,), 0.5)),
        _array(call.background, types.vec3),
        _array(call.content_distance),
    )
