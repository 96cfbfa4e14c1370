"""Differentiable rendering as calls of XLA to Warp, forward and backward, each one launch."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import jax
import numpy as np
import warp as wp

from warpnerf.checks import require_rays
from warpnerf.rendering.arguments import require_reach, require_rising
from warpnerf.rendering.operation import Inputs, Operation, Outputs


def require_visible(operation: Operation, origins: np.ndarray, directions: np.ndarray) -> None:
    """Raise InputError unless rays are of finite numbers, of unit length, and near enough."""
    require_rays(origins, directions)
    if operation.n_intervals:
        return
    lattice = operation.layout.lattice
    distances = np.linalg.norm(origins - (lattice.box_min + lattice.box_max) / 2, axis=1)
    reach = float(distances.max(initial=0.0)) + lattice.diagonal
    require_reach(reach, operation.steps.step, operation.precision)


def require_edges(edges: np.ndarray) -> None:
    """Raise InputError unless edges of intervals are distances in rising order."""
    rising = (edges[:, 1:] >= edges[:, :-1]).all() and (edges[:, 0] >= 0.0).all()
    require_rising(bool(np.isfinite(edges).all() and rising))


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def render(operation: Operation, *arrays: jax.Array) -> tuple[jax.Array, ...]:
    """Rgb, opacity and depth of the rays, and what samples in intervals weigh; gradients are those
    of what is stored and of weights.

    Args:
        operation: What is no array.
        arrays: What is stored, in the order of the layout, flat: [n, width] or [n]. Then as the
            other fields of ``Inputs``: weights [n_weights], origins and directions [n_rays, 3],
            background [n_rays or 1, 3], content distances [n_rays or 1] and edges
            [n_rays, n_intervals + 1], in the operation's precision.
    """
    return _seen(_forward(operation, arrays))


def _render_forward(operation: Operation, *arrays: jax.Array) -> tuple[Any, Any]:
    outputs = _forward(operation, arrays)
    return _seen(outputs), (arrays, outputs[:-1])


def _render_backward(operation: Operation, kept: Any, gradients: Any) -> tuple[Any, ...]:
    arrays, outputs = kept
    n_learned = len(operation.layout.arrays) + 1
    names = [f"gradient_{n}" for n in range(n_learned)]
    dims = {name: array.shape[:1] for name, array in zip(names, arrays, strict=False)}
    found = _calls(operation)[1](*arrays, *outputs, *gradients[:3], output_dims=dims)
    return *found, *[None] * (len(arrays) - n_learned)


render.defvjp(_render_forward, _render_backward)


def _forward(operation: Operation, arrays: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    n = arrays[-1].shape[0]
    dims: dict[str, tuple[int, ...]] = dict.fromkeys(Outputs._fields, (n,))
    dims["interval_weights"] = n, operation.n_intervals
    return tuple(_calls(operation)[0](*arrays, output_dims=dims))


def _seen(outputs: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    rgb, transmittance, depth, *_, interval_weights = outputs
    return rgb, 1.0 - transmittance, depth, interval_weights


@cache
def _calls(operation: Operation) -> tuple[Any, Any]:
    """Both passes of a rendering, as Warp registers them with XLA."""
    types, arrays = operation.types, operation.layout.arrays
    number, vec3 = wp.array(dtype=types.real), wp.array(dtype=types.vec3)
    of_stored = {
        f"stored_{name}": number
        if array.width is None
        else wp.array(dtype=types.vector(array.width))
        for name, array in arrays.items()
    }
    of_inputs = of_stored | {
        "weights": number,
        "origins": vec3,
        "directions": vec3,
        "background": vec3,
        "content_distance": number,
        "edges": wp.array2d(dtype=types.real),
    }
    of_outputs = {
        "rgb": vec3,
        "transmittance": number,
        "depth": number,
        "n_samples": wp.array(dtype=wp.int32),
        "channels": wp.array(dtype=types.vector(operation.n_channels)),
    }
    of_pulled = {"pulled_rgb": vec3, "pulled_opacity": number, "pulled_depth": number}
    of_gradients = {f"gradient_{n}": kind for n, kind in enumerate((*of_stored.values(), number))}
    n_in, n_out = len(of_inputs), len(of_outputs)

    def forward(*given: wp.array) -> None:
        *seen, interval_weights = given[n_in:]
        interval_weights.zero_()
        operation.forward(_inputs(operation, given[:n_in]), Outputs(*seen), interval_weights)

    def backward(*given: wp.array) -> None:
        inputs, outputs = _inputs(operation, given[:n_in]), Outputs(*given[n_in : n_in + n_out])
        rgb, opacity, depth, *stored, weights = given[n_in + n_out :]
        for gradient in stored:
            gradient.zero_()
        named = dict(zip(arrays, stored, strict=True))
        operation.backward(inputs, outputs, (rgb, opacity, depth), named, weights)

    of_interval_weights = {"interval_weights": wp.array2d(dtype=types.real)}
    return (
        _registered(forward, of_inputs | of_outputs | of_interval_weights, n_out + 1),
        _registered(backward, of_inputs | of_outputs | of_pulled | of_gradients, len(of_gradients)),
    )


def _inputs(operation: Operation, given: tuple[wp.array, ...]) -> Inputs:
    """Arrays as kernels take them; on the CPU, rays are looked at, whose values JAX did not know
    when a function was traced."""
    names = operation.layout.arrays
    inputs = Inputs(dict(zip(names, given, strict=False)), *given[len(names) :])
    if not inputs.origins.device.is_cuda:
        require_visible(operation, inputs.origins.numpy(), inputs.directions.numpy())
        if operation.n_intervals:
            require_edges(inputs.edges.numpy())
    return inputs


def _registered(function: Callable[..., None], arrays: dict[str, Any], n_outputs: int) -> Any:
    """A function of arrays that JAX may call, of which the last ones are written.

    A function that is vmapped is called for one element after another.
    """
    ordered = inspect.Parameter.POSITIONAL_OR_KEYWORD
    function.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(name, ordered, annotation=kind) for name, kind in arrays.items()]
    )
    function.__annotations__ = arrays
    return wp.jax_callable(
        function,
        num_outputs=n_outputs,
        graph_mode=wp.JaxCallableGraphMode.NONE,
        vmap_method="sequential",
    )
