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
from warpnerf.jax.launches import render, require_edges, require_visible
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import (
    Head,
    March,
    StoredField,
    corners_of,
    head_of,
    require_box,
    require_intervals,
    require_layers,
    steps_of,
    steps_of_intervals,
)
from warpnerf.rendering.operation import Operation
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.stored import (
    Layout,
    dense_layout,
    layout_of,
    named_tensors,
    require_stored,
)


class RenderedRays(NamedTuple):
    """Rendered rays: colour, opacity and depth."""

    rgb: jax.Array
    """[n_rays, 3], with background."""
    opacity: jax.Array
    """[n_rays] in [0, 1]."""
    depth: jax.Array
    """[n_rays] sum of weight times t, scene units."""


class RenderedIntervals(NamedTuple):
    """Rendered rays, and the weights of their samples."""

    rgb: jax.Array
    """[n_rays, 3], with background."""
    opacity: jax.Array
    """[n_rays] in [0, 1]."""
    depth: jax.Array
    """[n_rays] sum of weight times t, scene units."""
    weights: jax.Array
    """[n_rays, n] of samples, which add up to opacity; their gradient is zero."""


def render_rays(
    raw: jax.Array | StoredField,
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
    """Render rays through a field, differentiable with respect to what it stores and the head.

    The same launches as those of ``warpnerf.torch.render_rays``, which says what is computed, and
    on the CPU the same bits. ``jax.jit``, ``jax.grad`` and ``jax.vmap`` apply to it; vmap renders
    one element after another, so that all rays of a field belong in one call. The gradient is
    warpnerf's hand-written adjoint, with each sample's share multiplied by its distance scaling.
    Only what is stored and the head's layers have gradients, in reverse mode, once: to
    differentiate with respect to rays, background or content distance is refused.

    Args:
        raw: [X, Y, Z, 1 + n_features] raw density and raw features, of rgb raw r, g, b, at nodes
            box[0] + index (box[1] - box[0]) / (size - 1); float32, or float64 where JAX has it
            (``jax_enable_x64``), on the CPU or a CUDA device. Or a StoredField: planes and lines
            (vm), or a hash.
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
            later: rays and edges on the CPU, in an error of JAX; background and content distance
            not at all.
    """
    steps = steps_of(step)
    options = Options(density_shift, background, scaling, content_distance, head)
    return RenderedRays(*_rendered(raw, origins, directions, box, options, steps=steps)[:3])


def render_intervals(
    raw: jax.Array | StoredField,
    origins: jax.Array,
    directions: jax.Array,
    box: tuple[Sequence[float], Sequence[float]],
    edges: jax.Array,
    *,
    density_shift: float = 0.0,
    background: Sequence[float] | jax.Array = (1.0, 1.0, 1.0),
    scaling: Scaling = "none",
    content_distance: float | jax.Array = 1.0,
    head: str | Model | Head = "rgb",
) -> RenderedIntervals:
    """Render rays with a sample in the middle of each of their intervals, as importance sampling by
    a proposal network draws them.

    The same launches as those of ``warpnerf.torch.render_intervals``, which says what is computed,
    and on the CPU the same bits.

    Args:
        raw: See ``render_rays``; so are arguments that are not named here.
        origins: [n_rays, 3] scene units.
        directions: [n_rays, 3] of unit length.
        box: Its lower and its upper corner, [3] each, scene units.
        edges: [n_rays, n + 1] where intervals of each ray begin and end, 0 or above, in rising
            order, scene units; 2 to 1024 intervals. To differentiate with respect to them is
            refused.
        density_shift: Added to raw densities before their activation.
        background: [3] or [n_rays, 3], rgb.
        scaling: none, quadratic or clamped.
        content_distance: Where gradients reach full strength, scene units; a number or [n_rays].
        head: The name of a model without an MLP, the model itself, or a Head.

    Returns:
        rgb [n_rays, 3], opacity [n_rays], depth [n_rays] and weights [n_rays, n], of raw's type.

    Raises:
        InputError: As ``render_rays``.
    """
    options = Options(density_shift, background, scaling, content_distance, head)
    return RenderedIntervals(*_rendered(raw, origins, directions, box, options, edges=edges))


class Options(NamedTuple):
    """What both ways to render take by name."""

    density_shift: float
    background: Sequence[float] | jax.Array
    scaling: Scaling
    content_distance: float | jax.Array
    head: str | Model | Head


def _rendered(
    raw: jax.Array | StoredField,
    origins: jax.Array,
    directions: jax.Array,
    box: tuple[Sequence[float], Sequence[float]],
    options: Options,
    steps: Steps | None = None,
    edges: jax.Array | None = None,
) -> tuple[jax.Array, ...]:
    """Rgb, opacity, depth and weights of rays, that are marched, or have edges."""
    require_one_of("scaling", options.scaling, get_args(Scaling))
    require_finite("density_shift", options.density_shift)
    model, layers = head_of(options.head)
    corners = _corners(box)
    layout, stored = _stored_by(raw, model, corners)
    dtype = stored[0].dtype
    weights = _flat_head(layers, model, dtype)
    rays = _rays("origins", origins, dtype), _rays("directions", directions, dtype)
    n = len(rays[0])
    if n != len(rays[1]):
        raise InputError(
            f"origins and directions must be equally many, not {n} and {len(rays[1])}."
        )
    intervals = jnp.zeros((n, 0), dtype) if steps is not None else _edges(edges, n, dtype)
    operation = Operation(
        layout=layout,
        precision=str(dtype),
        steps=steps or steps_of_intervals(),
        n_intervals=max(0, intervals.shape[1] - 1),
        density_shift=float(options.density_shift),
        scaling=options.scaling,
    )
    begins, towards = known("origins", origins, dtype), known("directions", directions, dtype)
    if begins is not None and towards is not None:
        require_visible(operation, begins, towards)
    return render(operation, *stored, weights, *rays, *_constants(options, n, dtype), intervals)


def _stored_by(
    raw: jax.Array | StoredField, model: Model, corners: tuple[np.ndarray, np.ndarray]
) -> tuple[Layout, list[jax.Array]]:
    """How a field is stored, and its arrays in the order of its layout, flat and with padding."""
    if not isinstance(raw, StoredField):
        grid = _precise("raw", raw)
        layout = dense_layout(grid.shape, model, corners)
        padding = model.n_floats - grid.shape[3]
        arrays = [jnp.pad(grid, ((0, 0),) * 3 + ((0, padding),)) if padding else grid]
    else:
        layout = layout_of(raw, model, corners)
        arrays = []
        named = named_tensors(raw)
        for name, expected in layout.arrays.items():
            field = f"tensors[{name!r}]"
            array = _precise(field, named[name])
            require_stored(name, array.shape, expected)
            if array.dtype != (first := [*arrays, array][0].dtype):
                raise InputError(f"{field} must be {first}, as others, not {array.dtype}.")
            arrays.append(array)
    shapes = layout.arrays.values()
    return layout, [
        array.reshape(-1) if shape.width is None else array.reshape(-1, shape.width)
        for shape, array in zip(shapes, arrays, strict=True)
    ]


def _precise(field: str, value: Any) -> jax.Array:
    """An array in a precision that kernels work in."""
    array = array_of(field, value)
    if str(array.dtype) not in ("float32", "float64"):
        raise InputError(
            f"{field} must be float32 or float64, not {array.dtype}; call its "
            "astype(jax.numpy.float32)."
        )
    return array


def _edges(edges: Any, n_rays: int, dtype: Any) -> jax.Array:
    """Of intervals, [n_rays, n + 1], as kernels take them."""
    array = array_of("edges", edges)
    require_intervals(array.shape, n_rays)
    values = known("edges", edges, dtype)
    if values is not None:
        require_edges(values)
    return constant("edges", array.astype(dtype))


def _constants(options: Options, n_rays: int, dtype: Any) -> tuple[jax.Array, jax.Array]:
    """Background, [n_rays or 1, 3], and content distances, [n_rays or 1], as kernels take them."""
    background, content_distance = options.background, options.content_distance
    seen, far = (
        known(field, value, dtype)
        for field, value in (("background", background), ("content_distance", content_distance))
    )
    shape = np.shape(background)
    if shape not in ((3,), (n_rays, 3)) or (seen is not None and not np.isfinite(seen).all()):
        raise InputError(f"background must be finite rgb, [3] or [n_rays, 3], not {list(shape)}.")
    behind = constant("background", jnp.asarray(background, dtype))
    content = constant("content_distance", jnp.asarray(content_distance, dtype))
    if content.shape not in ((), (1,), (n_rays,)) or (far is not None and not (far > 0).all()):
        raise InputError(
            "content_distance must be above 0: a number or [n_rays], "
            f"not {list(content.shape) if far is None or far.ndim else far.item()}."
        )
    return behind.reshape(-1, 3), content.reshape(-1)


def _corners(box: Any) -> tuple[np.ndarray, np.ndarray]:
    """Of a box, [3] each, float64."""
    require_box(box)
    for field, value in zip(("box_min", "box_max"), box, strict=True):
        if isinstance(value, jax.core.Tracer):
            raise InputError(
                f"{field} is traced, but a box is compiled in; give its numbers, or name the "
                "argument in static_argnames of jax.jit."
            )
    return corners_of(box)


def _rays(field: str, value: Any, dtype: Any) -> jax.Array:
    """Origins or directions, [n_rays, 3], as kernels take them."""
    rays = array_of(field, value)
    if rays.ndim != 2 or rays.shape[1] != 3:
        raise InputError(f"{field} must be [n_rays, 3], not {list(rays.shape)}.")
    return constant(field, rays.astype(dtype))


def _flat_head(layers: list[Any], model: Model, dtype: Any) -> jax.Array:
    """The layers in one array, as kernels take them; see ``warpnerf_kernels.networks.mlp``."""
    arrays = [array_of(f"head[{number}]", layer) for number, layer in enumerate(layers)]
    require_layers([array.shape for array in arrays], model, str(dtype))
    if not arrays:
        return jnp.zeros(0, dtype)
    pieces = [array.astype(dtype).T for array in arrays]
    pieces[-2] = jnp.pad(pieces[-2], ((0, 0), (0, 1)))
    pieces[-1] = jnp.pad(pieces[-1], (0, 1))
    return jnp.concatenate([piece.reshape(-1) for piece in pieces])
