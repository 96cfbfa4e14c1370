"""Drop-in torch operations: the paper's gradient scaling, and rendering through our own adjoint."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from functools import cache
from types import ModuleType
from typing import Any, NamedTuple, get_args

import numpy as np
import torch
import warp as wp

from warpnerf.checks import InputError, require_at_least, require_one_of, require_positive
from warpnerf.config import MAX_VOXELS, Scaling
from warpnerf.model.grid import box_struct, density_struct, free_struct, grid_struct
from warpnerf.model.interface import Load, Model, loader
from warpnerf.model.models import model_of
from warpnerf.rendering.adjoint import AdjointLaunch, gradient_struct, n_tiles
from warpnerf.rendering.rays import rays_struct
from warpnerf.rendering.render import Steps, scene_struct, scratch_struct, variant_of
from warpnerf.runtime.parallel import Workers

MAX_STEPS = 1e9
"""Steps that a ray can count, from its origin on."""

_PRECISIONS = {torch.float32: "float32", torch.float64: "float64"}


def scale_gradient(
    colors: torch.Tensor,
    sigmas: torch.Tensor,
    distances: torch.Tensor,
    content_distance: float | torch.Tensor = 1.0,
    scaling: Scaling = "clamped",
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Scale the gradients of samples by their distance; call it just before integrating them.

    Identity forward. Backward, with s = 1 (none), (t / D)^2 (quadratic) or min(1, (t / D)^2)
    (clamped): dL/dcolor <- s dL/dcolor, dL/dsigma <- s dL/dsigma.
    Source: Philip & Deschaintre 2023, "Floaters No More", eq. 7.

    Args:
        colors: [..., C] of samples, any floating type.
        sigmas: [...] or [..., 1] densities of the same samples.
        distances: t, of the shape of sigmas, scene units from the camera centre.
        content_distance: D, scene units; a number, or a tensor that broadcasts over distances.
        scaling: none, quadratic or clamped.

    Returns:
        colors, sigmas and distances, unchanged. No gradient flows to distances.

    Raises:
        InputError: Tensors are not dense floating point on one device, shapes do not fit, or
            content_distance is not above zero.
    """
    require_one_of("scaling", scaling, get_args(Scaling))
    for field, value in (("colors", colors), ("sigmas", sigmas), ("distances", distances)):
        _require_tensor(field, value, colors)
    if sigmas.shape != distances.shape:
        raise InputError(
            f"sigmas and distances must have one shape, not {list(sigmas.shape)} and "
            f"{list(distances.shape)}."
        )
    # One distance for all channels of a color.
    per_color = distances if colors.dim() == distances.dim() else distances.unsqueeze(-1)
    if per_color.shape[:-1] != colors.shape[:-1] or per_color.shape[-1] != 1:
        raise InputError(
            f"colors must be [..., C] over sigmas [...] or [..., 1], not {list(colors.shape)} over "
            f"{list(sigmas.shape)}."
        )
    if isinstance(content_distance, torch.Tensor):
        _require_dense("content_distance", content_distance)
        content_distance = content_distance.to(distances.device)
        if not _broadcasts_over(content_distance, distances):
            raise InputError(
                f"content_distance must broadcast over distances {list(distances.shape)}, not be "
                f"{list(content_distance.shape)}."
            )
        if not bool((content_distance > 0).all()):
            raise InputError("content_distance must be above 0 everywhere.")
    else:
        require_positive("content_distance", content_distance)
    if scaling == "none":
        return colors, sigmas, distances.detach()
    ratio = distances.detach() / content_distance
    scale = ratio * ratio
    if scaling == "clamped":
        scale = scale.clamp(max=1.0)
    of_color = scale if colors.dim() == distances.dim() else scale.unsqueeze(-1)
    return (
        _Scaled.apply(colors, of_color),
        _Scaled.apply(sigmas, scale),
        distances.detach(),
    )


class _Scaled(torch.autograd.Function):
    """x, whose gradient is multiplied by scale."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, scale: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(scale)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        (scale,) = ctx.saved_tensors
        return grad * scale.to(grad.dtype), None


class RenderedRays(NamedTuple):
    """What rays see."""

    rgb: torch.Tensor
    """[n_rays, 3], with background."""
    opacity: torch.Tensor
    """[n_rays] in [0, 1]."""
    depth: torch.Tensor
    """[n_rays] sum of weight times t, scene units."""


def render_rays(
    raw: torch.Tensor,
    origins: torch.Tensor,
    directions: torch.Tensor,
    box_min: Sequence[float] | torch.Tensor,
    box_max: Sequence[float] | torch.Tensor,
    *,
    step: float,
    near: float = 0.0,
    far: float | None = None,
    density_shift: float = 0.0,
    background: Sequence[float] | torch.Tensor = (1.0, 1.0, 1.0),
    scaling: Scaling = "none",
    content_distance: float | torch.Tensor = 1.0,
    model: str | Model = "rgb",
    head: Iterable[torch.Tensor] = (),
) -> RenderedRays:
    """Render rays through a grid of raw values, differentiable with respect to these and the head.

    Samples sit at t = near + (k + 1/2) step for every k >= 0 whose point lies in the box and whose
    t is below far; sigma = softplus(raw density + density_shift), and c as the model says, for rgb
    sigmoid(raw rgb);

        rgb = sum_k T_k alpha_k c_k + T_end background,  alpha_k = 1 - exp(-sigma_k step)

    The gradient is warpnerf's hand-written adjoint (kernels/README.md), in which each sample's
    share is multiplied by its distance scaling. It is then the gradient of no loss: see the paper.

    Args:
        raw: [X, Y, Z, 1 + n_features] raw density and raw features, of rgb raw r, g, b, at nodes
            box_min + index (box_max - box_min) / (size - 1); float32 or float64, CPU or CUDA.
        origins: [n_rays, 3] scene units, on the same device.
        directions: [n_rays, 3] of unit length.
        box_min: [3] lower corner, scene units.
        box_max: [3] upper corner.
        step: Length of a step, scene units.
        near: Where the first step begins, scene units.
        far: No sample at or beyond it, scene units; None: where the box ends.
        density_shift: Added to raw densities before their activation.
        background: [3] or [n_rays, 3], rgb.
        scaling: none, quadratic or clamped.
        content_distance: Where gradients reach full strength, scene units; a number or [n_rays].
        model: rgb, sh, deferred, features, or a model from ``warpnerf.model.models``.
        head: The model's MLP, as torch.nn.Linear holds it: weight [outputs, inputs] and bias
            [outputs] of each layer, in turn. Inputs are channels or features, then the encoded
            direction. Its gradient is scaled where it passes samples, so for features.

    Returns:
        rgb [n_rays, 3], opacity [n_rays] and depth [n_rays], of raw's type and device.

    Raises:
        InputError: A shape, type, device or number does not fit.
    """
    require_one_of("scaling", scaling, get_args(Scaling))
    require_positive("step", step)
    require_at_least("near", near, 0.0)
    if far is not None and not far > near:
        raise InputError(f"far must lie beyond near, not at {far}.")
    if not math.isfinite(density_shift):
        raise InputError(f"density_shift must be finite, not {density_shift}.")
    if isinstance(model, str):
        model = model_of(model)
    if not isinstance(model, Model):
        raise InputError(f"model must be a name or a model, not {model!r}.")
    _require_grid(raw, model)
    weights = _flat_head(list(head), model, raw)
    if raw.shape[3] < model.n_floats:
        raw = torch.nn.functional.pad(raw, (0, model.n_floats - raw.shape[3]))
    corners = _corner("box_min", box_min), _corner("box_max", box_max)
    if not (corners[0] < corners[1]).all():
        raise InputError(
            f"box_max must lie above box_min on every axis, not {corners[1]} over {corners[0]}."
        )
    rays = _rays("origins", origins, raw), _rays("directions", directions, raw)
    if len(rays[0]) != len(rays[1]):
        raise InputError(
            f"origins and directions must be equally many, not {len(rays[0])} and {len(rays[1])}."
        )
    length = rays[1].norm(dim=1)
    if len(length) and not bool(((length - 1.0).abs() < 1e-3).all()):
        raise InputError(
            "directions must be unit vectors, so that t is a distance; divide them by their length."
        )
    reach = (
        float((rays[0] - rays[0].new_tensor((corners[0] + corners[1]) / 2)).norm(dim=1).max())
        if len(rays[0])
        else 0.0
    )
    reach += float(np.linalg.norm(corners[1] - corners[0]))
    if reach / step > MAX_STEPS:
        raise InputError(
            f"step {step:g} is too short for rays that reach {reach:g} scene units: more than "
            f"{MAX_STEPS:g} steps; use a longer step, or scale the scene."
        )
    for field, value in (("background", background), ("content_distance", content_distance)):
        _require_dense(field, value)
    behind = torch.as_tensor(background, dtype=raw.dtype, device=raw.device).detach()
    if behind.shape not in ((3,), (len(rays[0]), 3)) or not bool(behind.isfinite().all()):
        raise InputError(
            f"background must be finite rgb, [3] or [n_rays, 3], not {list(behind.shape)}."
        )
    content = torch.as_tensor(content_distance, dtype=raw.dtype, device=raw.device).detach()
    if content.shape not in ((), (1,), (len(rays[0]),)) or not bool((content > 0).all()):
        raise InputError(
            "content_distance must be above 0: a number or [n_rays], "
            f"not {content.tolist() if content.dim() == 0 else list(content.shape)}."
        )
    steps = Steps(near=near, far=min(1e30, math.inf if far is None else far), step=step)
    call = _Call(
        corners=corners,
        steps=steps,
        density_shift=density_shift,
        background=behind.reshape(-1, 3).contiguous(),
        scaling=scaling,
        content_distance=content.reshape(-1).contiguous(),
        model=model,
    )
    return RenderedRays(*_Render.apply(raw, weights, *rays, call))


class _Call(NamedTuple):
    """What a rendering depends on besides tensors with gradients and rays."""

    corners: tuple[np.ndarray, np.ndarray]
    steps: Steps
    density_shift: float
    background: torch.Tensor
    scaling: Scaling
    content_distance: torch.Tensor
    model: Model


class _Render(torch.autograd.Function):
    """render_rays, forward and backward, each one launch."""

    @staticmethod
    def forward(
        ctx: Any,
        raw: torch.Tensor,
        weights: torch.Tensor,
        origins: torch.Tensor,
        directions: torch.Tensor,
        call: _Call,
    ) -> tuple[torch.Tensor, ...]:
        load = _device_code(raw)
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
        raw, weights, origins, directions, *outputs = ctx.saved_tensors
        call: _Call = ctx.call
        load = _device_code(raw)
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


def _device_code(raw: torch.Tensor) -> Load:
    """Kernels in raw's precision."""
    return loader(_PRECISIONS[raw.dtype])


def _variant(raw: torch.Tensor, call: _Call, scaling: Scaling) -> Any:
    name, packed = _PRECISIONS[raw.dtype], raw.dtype == torch.float32 and not raw.is_cuda
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


def _scene(raw: torch.Tensor, weights: torch.Tensor, call: _Call, workers: Workers) -> Any:
    """What rays are marched through, as kernels take it."""
    load = _device_code(raw)
    types = load("base.types")
    n_floats, size = raw.shape[3], (raw.shape[0], raw.shape[1], raw.shape[2])
    values = _array(raw.detach().contiguous().reshape(-1, n_floats), types.vector(n_floats))
    occupied = wp.zeros(1, dtype=wp.uint8, device=values.device)
    return scene_struct(
        call.model,
        _PRECISIONS[raw.dtype],
        box=box_struct(types, *call.corners, 0.0),
        free=free_struct(types, occupied, (1, 1, 1), 0.0),
        steps=call.steps,
        grid=grid_struct(load("fields.dense"), values, size, 0.0),
        density=density_struct(types, call.density_shift, 1.0),
        weights=_array(weights),
        workers=workers,
    )


def _ray_arrays(
    raw: torch.Tensor, origins: torch.Tensor, directions: torch.Tensor, call: _Call
) -> Any:
    """The rays, as kernels take them."""
    load = _device_code(raw)
    types = load("base.types")
    return rays_struct(
        load("launch.assembly"),
        _array(origins, types.vec3),
        _array(directions, types.vec3),
        _array(raw.new_full((1,), 0.5)),
        _array(call.background, types.vec3),
        _array(call.content_distance),
    )


def _flat_head(head: Sequence[torch.Tensor], model: Model, raw: torch.Tensor) -> torch.Tensor:
    """The layers in one tensor, as kernels take them; see ``warpnerf_kernels.heads.mlp``."""
    layout = model.layout(_device_code(raw))
    if layout is None:
        if len(head):
            raise InputError(f"head must be empty: the model {model.name} has no MLP.")
        return raw.new_zeros(0)
    sizes = [layout.n_inputs, *[layout.width] * layout.n_hidden, 3]
    shapes = [
        shape for n_in, n_out in itertools.pairwise(sizes) for shape in ((n_out, n_in), (n_out,))
    ]
    for number, tensor in enumerate(head):
        _require_tensor(f"head[{number}]", tensor, raw)
    found = [tuple(tensor.shape) for tensor in head]
    if found != shapes:
        raise InputError(
            f"head of the model {model.name} must be tensors of shapes {shapes}, weight and bias "
            f"of each layer in turn, not {found}."
        )
    pieces = [
        tensor.to(raw.dtype).t() if tensor.dim() == 2 else tensor.to(raw.dtype) for tensor in head
    ]
    pieces[-2:] = [torch.nn.functional.pad(piece, (0, 1)) for piece in pieces[-2:]]
    return torch.cat([piece.reshape(-1) for piece in pieces])


def _require_grid(raw: torch.Tensor, model: Model) -> None:
    _require_tensor("raw", raw)
    if raw.dtype not in _PRECISIONS:
        raise InputError(f"raw must be float32 or float64, not {raw.dtype}; call raw.float().")
    numbers = 1 + model.n_features
    if raw.dim() != 4 or raw.shape[3] != numbers or min(raw.shape[:3]) < 2:
        raise InputError(
            f"raw must be [X, Y, Z, {numbers}] with at least two nodes along each axis, "
            f"not {list(raw.shape)}."
        )
    if raw.shape[:3].numel() >= MAX_VOXELS:
        raise InputError(
            f"raw must have fewer than {MAX_VOXELS} nodes, not {raw.shape[:3].numel()}."
        )


def _require_tensor(field: str, value: Any, like: torch.Tensor | None = None) -> None:
    """Raise InputError unless value is a dense floating-point tensor, on the device of ``like``."""
    if not isinstance(value, torch.Tensor):
        raise InputError(
            f"{field} must be a torch tensor, not {type(value).__name__}; call torch.as_tensor."
        )
    _require_dense(field, value)
    if not value.dtype.is_floating_point:
        raise InputError(f"{field} must be floating point, not {value.dtype}; call its float.")
    if like is not None and value.device != like.device:
        raise InputError(
            f"{field} must be on {like.device} as the others are, not on {value.device}; call its "
            f"to({str(like.device)!r})."
        )


def _require_dense(field: str, value: Any) -> None:
    """Raise InputError for a tensor that is sparse, or holds no values; numbers pass."""
    if not isinstance(value, torch.Tensor):
        return
    if value.layout != torch.strided:
        raise InputError(f"{field} must be a dense tensor, not {value.layout}; call its to_dense.")
    if value.device.type not in ("cpu", "cuda"):
        raise InputError(f"{field} must be on the CPU or on CUDA, not on {value.device}.")


def _broadcasts_over(value: torch.Tensor, other: torch.Tensor) -> bool:
    try:
        return torch.broadcast_shapes(value.shape, other.shape) == other.shape
    except RuntimeError:
        return False


def _corner(field: str, value: Sequence[float] | torch.Tensor) -> np.ndarray:
    _require_dense(field, value)
    corner = np.asarray(
        value.detach().cpu() if isinstance(value, torch.Tensor) else value, dtype=np.float64
    )
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise InputError(f"{field} must be three finite numbers, not {value}.")
    return corner


def _rays(field: str, value: torch.Tensor, raw: torch.Tensor) -> torch.Tensor:
    _require_tensor(field, value, raw)
    if value.dim() != 2 or value.shape[1] != 3:
        raise InputError(f"{field} must be [n_rays, 3], not {list(value.shape)}.")
    if not bool(value.isfinite().all()):
        raise InputError(f"{field} must be finite, but hold NaN or infinity.")
    return value.detach().to(raw.dtype).contiguous()
