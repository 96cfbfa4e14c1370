"""What tensors have to be, and the errors where they are not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from warpnerf.checks import InputError, said
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import require_layers, require_nodes

PRECISIONS = {torch.float32: "float32", torch.float64: "float64"}


def require_grid(raw: torch.Tensor, model: Model) -> None:
    """Raise InputError unless raw is a grid of the model's nodes."""
    require_tensor("raw", raw)
    if raw.dtype not in PRECISIONS:
        raise InputError(f"raw must be float32 or float64, not {raw.dtype}; call raw.float().")
    require_nodes(raw.shape, model)


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


def corner_of(field: str, value: Sequence[float] | torch.Tensor) -> np.ndarray:
    """A corner of the box, [3] float64."""
    require_dense(field, value)
    require_numbers(field, value)
    corner = np.asarray(
        value.detach().cpu() if isinstance(value, torch.Tensor) else value, dtype=np.float64
    )
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise InputError(f"{field} must be three finite numbers, not {value}.")
    return corner


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
