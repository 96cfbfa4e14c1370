"""Differentiable volume rendering of rays as a JAX operation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np

from warpnerf.checks import InputError, require_finite, require_one_of
from warpnerf.config import Scaling
from warpnerf.jax.arrays import array_of, constant, known
from warpnerf.jax.launches import Call, render, require_visible
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import (
    Head,
    March,
    head_of,
    require_ascending,
    require_box,
    require_layers,
    require_nodes,
    steps_of,
)


class RenderedRays(NamedTuple):
    """Rendered rays: colour, opacity and depth."""

    rgb: jax.Array
    """[n_rays, 3], with background."""
    opacity: jax.Array
    """[n_rays] in [0, 1]."""
    depth: jax.Array
    """[n_rays] sum of weight times t, scene units."""


def render_rays(
    raw: jax.Array,
    origins: jax.Array,
    directions: jax.Array,
    box: tuple[Sequence[float], Sequence[float]],
    step: float | March,
    *,
    density_shift: float = 0.0,
    background: Sequence[float] | jax.Array = (1.0, 1.0, 1.0),
    scaling: Scaling = "none",
    content_distance: float | jax.Array = 1.0,
    head: str | Model | Head = "rgb",
) -> RenderedRays:
    """Render rays through a grid of raw values, differentiable with respect to these and the head.

    The same launches as those of ``warpnerf.torch.render_rays``, which says what is computed, and
    on the CPU the same bits. ``jax.jit``, ``jax.grad`` and ``jax.vmap`` apply to it; vmap renders
    one element after another, so that all rays of a grid belong in one call. The gradient is
    warpnerf's hand-written adjoint, with each sample's share multiplied by its distance scaling.
    Only raw and the head's layers have gradients, in reverse mode, once: to differentiate with
    respect to rays, background or content distance is refused.

    Args:
        raw: [X, Y, Z, 1 + n_features] raw density and raw features, of rgb raw r, g, b, at nodes
            box[0] + index (box[1] - box[0]) / (size - 1); float32, or float64 where JAX has it
            (``jax_enable_x64``), on the CPU or a CUDA device.
        origins: [n_rays, 3] scene units.
        directions: [n_rays, 3] of unit length.
        box: Its lower and its upper corner, [3] each, scene units; numbers, which are compiled in.
        step: Length of a step, scene units; or a March, where rays do not begin at their origins.
            Compiled in, as are density_shift and scaling.
        density_shift: Added to raw densities before their activation.
        background: [3] or [n_rays, 3], rgb.
        scaling: none, quadratic or clamped.
        content_distance: Where gradients reach full strength, scene units; a number or [n_rays].
        head: The name of a model without an MLP, the model itself, or a Head, whose layers are
            [outputs, inputs]: of flax, ``kernel.T`` and ``bias``.

    Returns:
        rgb [n_rays, 3], opacity [n_rays] and depth [n_rays], of raw's type.

    Raises:
        InputError: A shape, type or number does not fit, or what is differentiated has no gradient.
            Values that are not known while a function is traced, as under ``jax.jit``, are checked
            later: rays on the CPU, in an error of JAX; background and content distance not at all.
    """
    require_box(box)
    require_one_of("scaling", scaling, get_args(Scaling))
    steps = steps_of(step)
    require_finite("density_shift", density_shift)
    model, layers = head_of(head)
    raw = array_of("raw", raw)
    if str(raw.dtype) not in ("float32", "float64"):
        raise InputError(
            f"raw must be float32 or float64, not {raw.dtype}; call its astype(jax.numpy.float32)."
        )
    require_nodes(raw.shape, model)
    weights = _flat_head(layers, model, raw)
    corners = _corner("box_min", box[0]), _corner("box_max", box[1])
    require_ascending(corners)
    rays = _rays("origins", origins, raw), _rays("directions", directions, raw)
    n = len(rays[0])
    if n != len(rays[1]):
        raise InputError(
            f"origins and directions must be equally many, not {n} and {len(rays[1])}."
        )
    call = Call(
        corners=(tuple(corners[0].tolist()), tuple(corners[1].tolist())),
        steps=steps,
        density_shift=float(density_shift),
        scaling=scaling,
        model=model,
        precision=str(raw.dtype),
        size=(raw.shape[0], raw.shape[1], raw.shape[2]),
    )
    begins, towards = known("origins", origins), known("directions", directions)
    if begins is not None and towards is not None:
        require_visible(call, begins, towards)
    seen, far = (
        known(field, value, raw.dtype)
        for field, value in (("background", background), ("content_distance", content_distance))
    )
    shape = np.shape(background)
    if shape not in ((3,), (n, 3)) or (seen is not None and not np.isfinite(seen).all()):
        raise InputError(f"background must be finite rgb, [3] or [n_rays, 3], not {list(shape)}.")
    behind = constant("background", jnp.asarray(background, raw.dtype))
    content = constant("content_distance", jnp.asarray(content_distance, raw.dtype))
    if content.shape not in ((), (1,), (n,)) or (far is not None and not (far > 0).all()):
        raise InputError(
            "content_distance must be above 0: a number or [n_rays], "
            f"not {list(content.shape) if far is None or far.ndim else far.item()}."
        )
    padding = model.n_floats - raw.shape[3]
    raw = jnp.pad(raw, ((0, 0), (0, 0), (0, 0), (0, padding))) if padding else raw
    return RenderedRays(
        *render(call, raw, weights, *rays, behind.reshape(-1, 3), content.reshape(-1))
    )


def _corner(field: str, value: Any) -> np.ndarray:
    """A corner of the box, [3] float64."""
    corner = known(field, value)
    if corner is None:
        raise InputError(
            f"{field} is traced, but a box is compiled in; give its numbers, or name the argument "
            "in static_argnames of jax.jit."
        )
    if corner.shape != (3,) or not np.isfinite(corner).all():
        raise InputError(f"{field} must be three finite numbers, not {value}.")
    return corner.astype(np.float64)


def _rays(field: str, value: Any, raw: jax.Array) -> jax.Array:
    """Origins or directions, [n_rays, 3], of raw's type."""
    rays = array_of(field, value)
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise InputError(f"{field} must be [n_rays, 3], not {list(rays.shape)}.")
    return constant(field, rays.astype(raw.dtype))


def _flat_head(layers: list[Any], model: Model, raw: jax.Array) -> jax.Array:
    """The layers in one array, as kernels take them; see ``warpnerf_kernels.networks.mlp``."""
    arrays = [array_of(f"head[{number}]", layer) for number, layer in enumerate(layers)]
    require_layers([array.shape for array in arrays], model, str(raw.dtype))
    if not arrays:
        return jnp.zeros(0, raw.dtype)
    pieces = [array.astype(raw.dtype).T for array in arrays]
    pieces[-2] = jnp.pad(pieces[-2], ((0, 0), (0, 1)))
    pieces[-1] = jnp.pad(pieces[-1], (0, 1))
    return jnp.concatenate([piece.reshape(-1) for piece in pieces])
