"""Differentiable rendering as an autograd function of torch."""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import numpy as np
import torch
import warp as wp

from warpnerf.config import Scaling
from warpnerf.model.interface import Model
from warpnerf.rendering.operation import Inputs, Operation, Outputs
from warpnerf.rendering.steps import Steps
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
        n, operation = len(origins), _operation(raw, call)
        channels = raw.new_empty(n, operation.n_channels)
        rgb, transmittance, depth = raw.new_empty(n, 3), raw.new_empty(n), raw.new_empty(n)
        n_samples = torch.empty(n, dtype=torch.int32, device=raw.device)
        outputs = rgb, transmittance, depth, n_samples, channels
        with _stream(raw):
            operation.forward(
                _inputs(operation, raw, weights, origins, directions, call),
                _outputs(operation, *outputs),
            )
        ctx.call = call
        ctx.save_for_backward(raw, weights, origins, directions, *outputs)
        return rgb, 1.0 - transmittance, depth

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients of raw and weights; rays are rendered once more."""
        raw, weights, origins, directions, *outputs = ctx.saved_tensors
        operation = _operation(raw, ctx.call)
        launch = operation.adjoint(len(origins))
        adj_rgb, adj_opacity, adj_depth = (grad.contiguous() for grad in grads)
        adj_raw = raw.new_zeros(raw.shape)
        adj_weights = raw.new_zeros(launch.workers.count, len(weights))
        touched = torch.zeros(operation.n_tiles, dtype=torch.uint8, device=raw.device)
        with _stream(raw):
            operation.backward(
                launch,
                _inputs(operation, raw, weights, origins, directions, ctx.call),
                _outputs(operation, *outputs),
                (_array(adj_rgb, operation.types.vec3), _array(adj_opacity), _array(adj_depth)),
                _nodes(operation, adj_raw),
                _array(touched),
                _array(adj_weights),
            )
        return adj_raw, adj_weights.sum(dim=0), None, None, None


def _operation(raw: torch.Tensor, call: Call) -> Operation:
    return Operation(
        model=call.model,
        precision=PRECISIONS[raw.dtype],
        device=str(raw.device),
        size=(raw.shape[0], raw.shape[1], raw.shape[2]),
        corners=call.corners,
        steps=call.steps,
        density_shift=call.density_shift,
        scaling=call.scaling,
    )


def _inputs(
    operation: Operation,
    raw: torch.Tensor,
    weights: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    call: Call,
) -> Inputs:
    vec3 = operation.types.vec3
    return Inputs(
        raw=_nodes(operation, raw.detach().contiguous()),
        weights=_array(weights),
        origins=_array(origins, vec3),
        directions=_array(directions, vec3),
        background=_array(call.background, vec3),
        content_distance=_array(call.content_distance),
    )


def _outputs(
    operation: Operation,
    rgb: torch.Tensor,
    transmittance: torch.Tensor,
    depth: torch.Tensor,
    n_samples: torch.Tensor,
    channels: torch.Tensor,
) -> Outputs:
    types = operation.types
    return Outputs(
        rgb=_array(rgb, types.vec3),
        transmittance=_array(transmittance),
        depth=_array(depth),
        n_samples=_array(n_samples),
        channels=_array(channels, types.vector(channels.shape[1])),
    )


def _nodes(operation: Operation, raw: torch.Tensor) -> wp.array:
    """[X, Y, Z, n_floats] as vectors of nodes."""
    n_floats = raw.shape[3]
    return _array(raw.reshape(-1, n_floats), operation.types.vector(n_floats))


def _stream(raw: torch.Tensor) -> Any:
    """Work in torch's own order on CUDA; nothing to do on the CPU."""
    if raw.is_cuda:
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(raw.device)))
    return contextlib.nullcontext()


def _array(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """The tensor's memory as a Warp array; contiguous tensors only."""
    if tensor.numel() == 0:
        tensor = tensor.new_empty(tensor.shape)  # an empty view may have any strides
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
