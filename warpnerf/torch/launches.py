"""Differentiable rendering as an autograd function of torch."""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import torch
import warp as wp

from warpnerf.rendering.operation import Inputs, Operation, Outputs


class Call(NamedTuple):
    """What a rendering depends on besides tensors with gradients."""

    operation: Operation
    origins: torch.Tensor
    directions: torch.Tensor
    background: torch.Tensor
    content_distance: torch.Tensor
    edges: torch.Tensor


class Render(torch.autograd.Function):
    """Rendering of rays, forward and backward, each one launch."""

    @staticmethod
    def forward(
        ctx: Any, call: Call, weights: torch.Tensor, *stored: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Rgb, opacity and depth of the rays, and what samples in intervals weigh."""
        n, operation = len(call.origins), call.operation
        channels = weights.new_empty(n, operation.n_channels)
        rgb, transmittance, depth = (weights.new_empty(n, *of) for of in ((3,), (), ()))
        n_samples = torch.empty(n, dtype=torch.int32, device=weights.device)
        interval_weights = weights.new_zeros(n, operation.n_intervals)
        outputs = rgb, transmittance, depth, n_samples, channels
        with _stream(weights):
            operation.forward(
                _inputs(call, weights, stored),
                _outputs(operation, *outputs),
                _array(interval_weights),
            )
        ctx.call = call
        ctx.save_for_backward(weights, *outputs, *stored)
        ctx.mark_non_differentiable(interval_weights)
        return rgb, 1.0 - transmittance, depth, interval_weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients of weights and of what is stored; rays are rendered once more."""
        call, operation = ctx.call, ctx.call.operation
        (weights, *rest), n_outputs = ctx.saved_tensors, len(Outputs._fields)
        outputs, stored = rest[:n_outputs], tuple(rest[n_outputs:])
        adj_rgb, adj_opacity, adj_depth = (grad.contiguous() for grad in grads[:3])
        of_weights = torch.zeros_like(weights)
        of_stored = tuple(tensor.new_zeros(tensor.shape) for tensor in stored)
        with _stream(weights):
            operation.backward(
                _inputs(call, weights, stored),
                _outputs(operation, *outputs),
                (_array(adj_rgb, operation.types.vec3), _array(adj_opacity), _array(adj_depth)),
                _stored(operation, of_stored),
                _array(of_weights),
            )
        return None, of_weights, *of_stored


def _inputs(call: Call, weights: torch.Tensor, stored: tuple[torch.Tensor, ...]) -> Inputs:
    vec3 = call.operation.types.vec3
    return Inputs(
        stored=_stored(call.operation, tuple(tensor.contiguous() for tensor in stored)),
        weights=_array(weights),
        origins=_array(call.origins, vec3),
        directions=_array(call.directions, vec3),
        background=_array(call.background, vec3),
        content_distance=_array(call.content_distance),
        edges=_array(call.edges),
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


def _stored(operation: Operation, tensors: tuple[torch.Tensor, ...]) -> dict[str, wp.array]:
    """Contiguous tensors in the order of the layout, as launches take them."""
    arrays, vector = operation.layout.arrays, operation.types.vector
    return {
        name: _array(tensor.reshape(-1))
        if array.width is None
        else _array(tensor.reshape(-1, array.width), vector(array.width))
        for (name, array), tensor in zip(arrays.items(), tensors, strict=True)
    }


def _stream(like: torch.Tensor) -> Any:
    """Work in torch's own order on CUDA; nothing to do on the CPU."""
    if like.is_cuda:
        return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))
    return contextlib.nullcontext()


def _array(tensor: torch.Tensor, dtype: Any = None) -> wp.array:
    """The tensor's memory as a Warp array; contiguous tensors only."""
    if tensor.numel() == 0:
        tensor = tensor.new_empty(tensor.shape)  # an empty view may have any strides
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)
