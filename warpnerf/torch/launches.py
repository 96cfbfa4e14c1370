"""Differentiable rendering as an autograd function of torch."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import warp as wp

from warpnerf.rendering.operation import Inputs, Operation, Outputs


class Constants(NamedTuple):
    """Tensors without gradient that a rendering depends on; see ``Inputs``."""

    origins: torch.Tensor
    directions: torch.Tensor
    background: torch.Tensor
    content_distance: torch.Tensor
    edges: torch.Tensor


N_CONSTANTS, N_OUTPUTS = len(Constants._fields), len(Outputs._fields)


class Render(torch.autograd.Function):
    """Rendering of rays, forward and backward, each one launch."""

    @staticmethod
    def forward(ctx: Any, operation: Operation, *given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Rgb, opacity and depth of the rays, and what samples in intervals weigh.

        Args:
            ctx: Of torch.
            operation: What is no tensor.
            given: The constants, weights of the head, and what is stored, in the layout's order.
        """
        n, like = len(given[0]), given[N_CONSTANTS]
        channels = like.new_empty(n, operation.n_channels)
        rgb, transmittance, depth = (like.new_empty(n, *of) for of in ((3,), (), ()))
        n_samples = torch.empty(n, dtype=torch.int32, device=like.device)
        interval_weights = like.new_zeros(n, operation.n_intervals)
        outputs = rgb, transmittance, depth, n_samples, channels
        with _stream(like):
            operation.forward(
                _inputs(operation, given), _outputs(operation, *outputs), _array(interval_weights)
            )
        ctx.operation = operation
        ctx.save_for_backward(*outputs, *given)
        ctx.mark_non_differentiable(interval_weights)
        return rgb, 1.0 - transmittance, depth, interval_weights

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Gradients of weights and of what is stored; rays are rendered once more."""
        operation, saved = ctx.operation, ctx.saved_tensors
        outputs, given = saved[:N_OUTPUTS], saved[N_OUTPUTS:]
        adj_rgb, adj_opacity, adj_depth = (grad.contiguous() for grad in grads[:3])
        learned = given[N_CONSTANTS:]
        of_weights, *of_stored = (x.new_zeros(x.shape) for x in learned)
        with _stream(of_weights):
            operation.backward(
                _inputs(operation, given),
                _outputs(operation, *outputs),
                (_array(adj_rgb, operation.types.vec3), _array(adj_opacity), _array(adj_depth)),
                _stored(operation, of_stored),
                _array(of_weights),
            )
        found = (None,) * N_CONSTANTS + (of_weights, *of_stored)
        wanted = zip(found, ctx.needs_input_grad[1:], strict=True)
        return None, *(gradient if needed else None for gradient, needed in wanted)


def _inputs(operation: Operation, given: tuple[torch.Tensor, ...]) -> Inputs:
    vec3 = operation.types.vec3
    constants, (weights, *stored) = Constants(*given[:N_CONSTANTS]), given[N_CONSTANTS:]
    return Inputs(
        stored=_stored(operation, [tensor.contiguous() for tensor in stored]),
        weights=_array(weights),
        origins=_array(constants.origins, vec3),
        directions=_array(constants.directions, vec3),
        background=_array(constants.background, vec3),
        content_distance=_array(constants.content_distance),
        edges=_array(constants.edges),
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


def _stored(operation: Operation, tensors: Sequence[torch.Tensor]) -> dict[str, wp.array]:
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
