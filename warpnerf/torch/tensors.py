"""What tensors have to be, and the errors where they are not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from warpnerf.checks import InputError, said
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import StoredField, corners_of, require_box, require_layers
from warpnerf.rendering.stored import (
    Layout,
    dense_layout,
    layout_of,
    named_tensors,
    require_stored,
)

PRECISIONS = {torch.float32: "float32", torch.float64: "float64"}


def stored_by(
    raw: torch.Tensor | StoredField, model: Model, corners: tuple[np.ndarray, np.ndarray]
) -> tuple[Layout, list[torch.Tensor]]:
    """How a field is stored, and its tensors in the order of its layout, with padding.

    Args:
        raw: A dense grid, or what is stored otherwise.
        model: What it holds.
        corners: [3] each of its box, scene units.

    Raises:
        InputError: A shape, type or device does not fit.
    """
    if not isinstance(raw, StoredField):
        require_precision("raw", raw)
        layout = dense_layout(raw.shape, model, corners)
        padding = model.n_floats - raw.shape[3]
        return layout, [torch.nn.functional.pad(raw, (0, padding)) if padding else raw]
    layout = layout_of(raw, model, corners)
    arrays, named = layout.arrays, named_tensors(raw)
    tensors = [named[name] for name in arrays]
    for (name, expected), tensor in zip(arrays.items(), tensors, strict=True):
        field = f"tensors[{name!r}]"
        require_precision(field, tensor)
        require_tensor(field, tensor, tensors[0])
        require_stored(name, tensor.shape, expected)
        if tensor.dtype != tensors[0].dtype:
            raise InputError(f"{field} must be {tensors[0].dtype}, as others, not {tensor.dtype}.")
    return layout, tensors


def require_precision(field: str, value: torch.Tensor) -> None:
    """Raise InputError unless a value is a tensor that kernels can work on."""
    require_tensor(field, value)
    if value.dtype not in PRECISIONS:
        raise InputError(
            f"{field} must be float32 or float64, not {value.dtype}; call its float()."
        )


def require_tensor(field: str, value: Any, like: torch.Tensor | None = None) -> None:
    """Raise InputError unless value is a dense floating-point tensor, on the device of ``like``."""
    if not isinstance(value, torch.Tensor):
        raise InputError(
            f"{field} must be a torch tensor, not {type(value).__name__}; call torch.as_tensor."
        )
    require_dense(field, value)
    if not value.dtype.is_floating_point:
        raise InputError(f"{field} must be floating point, not {value.dtype}; call its float.")
    if like is not None and value.device != like.device:
        raise InputError(
            f"{field} must be on {like.device} as the others are, not on {value.device}; call its "
            f"to({str(like.device)!r})."
        )


def require_dense(field: str, value: Any) -> None:
    """Raise InputError for a tensor that is sparse, or holds no values; numbers pass."""
    if not isinstance(value, torch.Tensor):
        return
    if value.layout != torch.strided:
        raise InputError(f"{field} must be a dense tensor, not {value.layout}; call its to_dense.")
    if value.device.type not in ("cpu", "cuda"):
        raise InputError(f"{field} must be on the CPU or on CUDA, not on {value.device}.")


def require_constant(field: str, value: Any) -> None:
    """Raise InputError for a tensor whose gradient is requested, where there is none."""
    if isinstance(value, torch.Tensor) and value.requires_grad and torch.is_grad_enabled():
        raise InputError(
            f"{field} requires grad, but no gradient with respect to it is computed; call its "
            "detach."
        )


def require_numbers(field: str, value: Any) -> None:
    """Raise InputError unless a value is a tensor, a number, or an array of numbers."""
    if isinstance(value, torch.Tensor):
        return
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        array = np.array(None)
    if array.dtype.kind not in "fiu":
        raise InputError(f"{field} must be a tensor or numbers, not {said(value)}.")


def corners_in(box: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of a box, [3] each, float64.

    Raises:
        InputError: It is none, or its gradient is requested.
    """
    require_box(box)
    for field, value in zip(("box_min", "box_max"), box, strict=True):
        require_constant(field, value)
        require_dense(field, value)
    return corners_of(box)


def rays_of(field: str, value: torch.Tensor, raw: torch.Tensor) -> torch.Tensor:
    """Origins or directions, [n_rays, 3], as kernels take them."""
    require_tensor(field, value, raw)
    if value.dim() != 2 or value.shape[1] != 3:
        raise InputError(f"{field} must be [n_rays, 3], not {list(value.shape)}.")
    if not bool(value.isfinite().all()):
        raise InputError(f"{field} must be finite, but hold NaN or infinity.")
    return value.detach().to(raw.dtype).contiguous()


def flat_head(head: Sequence[torch.Tensor], model: Model, raw: torch.Tensor) -> torch.Tensor:
    """The layers in one tensor, as kernels take them; see ``warpnerf_kernels.networks.mlp``."""
    for number, tensor in enumerate(head):
        require_tensor(f"head[{number}]", tensor, raw)
    require_layers([tuple(tensor.shape) for tensor in head], model, PRECISIONS[raw.dtype])
    if not len(head):
        return raw.new_zeros(0)
    pieces = [
        tensor.to(raw.dtype).t() if tensor.dim() == 2 else tensor.to(raw.dtype) for tensor in head
    ]
    pieces[-2:] = [torch.nn.functional.pad(piece, (0, 1)) for piece in pieces[-2:]]
    return torch.cat([piece.reshape(-1) for piece in pieces])
