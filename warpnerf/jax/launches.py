"""Differentiable rendering as calls of XLA to Warp, forward and backward, each one launch."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
import warp as wp

from warpnerf.checks import require_rays
from warpnerf.config import Scaling
from warpnerf.model.interface import Model
from warpnerf.rendering.arguments import require_reach
from warpnerf.rendering.operation import Inputs, Operation, Outputs
from warpnerf.rendering.steps import Steps


class Call(NamedTuple):
    """What a rendering depends on besides arrays; known while functions are traced."""

    corners: tuple[tuple[float, ...], tuple[float, ...]]
    steps: Steps
    density_shift: float
    scaling: Scaling
    model: Model
    precision: str
    size: tuple[int, int, int]

    def operation(self, device: str) -> Operation:
        """The launches on a device."""
        lower, upper = (np.array(corner, np.float64) for corner in self.corners)
        return Operation(
            model=self.model,
            precision=self.precision,
            device=device,
            size=self.size,
            corners=(lower, upper),
            steps=self.steps,
            density_shift=self.density_shift,
            scaling=self.scaling,
        )


def require_visible(call: Call, origins: np.ndarray, directions: np.ndarray) -> None:
    """Raise InputError unless rays are of finite numbers, of unit length, and near enough."""
    require_rays(origins, directions)
    lower, upper = (np.array(corner) for corner in call.corners)
    distances = np.linalg.norm(origins - (lower + upper) / 2, axis=1)
    reach = distances.max(initial=0.0) + np.linalg.norm(upper - lower)
    require_reach(float(reach), call.steps.step, call.precision)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def render(call: Call, *arrays: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Rgb, opacity and depth of the rays; gradients are those of raw and weights.

    Args:
        call: What is no array.
        arrays: As the fields of ``Inputs``: raw [X, Y, Z, n_floats], weights [n_weights], origins
            and directions [n_rays, 3], background [n_rays or 1, 3], content distances
            [n_rays or 1], in the call's precision.
    """
    return _seen(_forward(call, arrays))


def _render_forward(call: Call, *arrays: jax.Array) -> tuple[Any, Any]:
    outputs = _forward(call, arrays)
    return _seen(outputs), (arrays, outputs)


def _render_backward(call: Call, kept: Any, gradients: Any) -> tuple[Any, ...]:
    arrays, outputs = kept
    shapes = {"raw_gradient": arrays[0].shape[:3], "weights_gradient": arrays[1].shape}
    of_raw, of_weights = _calls(call)[1](*arrays, *outputs, *gradients, output_dims=shapes)
    return of_raw, of_weights, None, None, None, None


render.defvjp(_render_forward, _render_backward)


def _forward(call: Call, arrays: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
    return tuple(_calls(call)[0](*arrays, output_dims=(arrays[2].shape[0],)))


def _seen(outputs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array, jax.Array]:
    rgb, transmittance, depth, *_ = outputs
    return rgb, 1.0 - transmittance, depth


@cache
def _calls(call: Call) -> tuple[Any, Any]:
    """Both passes of a rendering, as Warp registers them with XLA."""
    operation = call.operation("cpu")
    types = operation.types
    node, channels = types.vector(call.model.n_floats), types.vector(operation.n_channels)
    of_inputs = {
        "raw": wp.array3d(dtype=node),
        "weights": wp.array(dtype=types.real),
        "origins": wp.array(dtype=types.vec3),
        "directions": wp.array(dtype=types.vec3),
        "background": wp.array(dtype=types.vec3),
        "content_distance": wp.array(dtype=types.real),
    }
    of_outputs = {
        "rgb": wp.array(dtype=types.vec3),
        "transmittance": wp.array(dtype=types.real),
        "depth": wp.array(dtype=types.real),
        "n_samples": wp.array(dtype=wp.int32),
        "channels": wp.array(dtype=channels),
    }
    of_gradients = {
        "rgb_gradient": of_outputs["rgb"],
        "opacity_gradient": of_outputs["transmittance"],
        "depth_gradient": of_outputs["depth"],
        "raw_gradient": of_inputs["raw"],
        "weights_gradient": of_inputs["weights"],
    }
    n_in, n_out = len(of_inputs), len(of_outputs)

    def forward(*given: wp.array) -> None:
        inputs = _inputs(call, given[:n_in])
        _operation(call, given[0]).forward(inputs, Outputs(*given[n_in:]))

    def backward(*given: wp.array) -> None:
        inputs, outputs = _inputs(call, given[:n_in]), Outputs(*given[n_in : n_in + n_out])
        *gradients, of_raw, of_weights = given[n_in + n_out :]
        operation = _operation(call, of_raw)
        launch = operation.adjoint(inputs.origins.shape[0])
        rows = launch.workers.count, of_weights.shape[0]
        of_workers = wp.zeros(rows, dtype=types.real, device=of_raw.device)
        touched = wp.zeros(operation.n_tiles, dtype=wp.uint8, device=of_raw.device)
        of_raw.zero_()
        nodes = of_raw.flatten()
        operation.backward(launch, inputs, outputs, tuple(gradients), nodes, touched, of_workers)
        if launch.workers.count == 1:
            wp.copy(of_weights, of_workers.flatten())
        else:  # on the CPU
            of_workers.numpy().sum(axis=0, out=of_weights.numpy())

    return (
        _registered(forward, of_inputs | of_outputs, n_out),
        _registered(backward, of_inputs | of_outputs | of_gradients, 2),
    )


def _operation(call: Call, raw: wp.array) -> Operation:
    return call.operation(str(raw.device))


def _inputs(call: Call, given: tuple[wp.array, ...]) -> Inputs:
    """Arrays as kernels take them; on the CPU, rays are looked at, whose values JAX did not know
    when a function was traced."""
    inputs = Inputs(given[0].flatten(), *given[1:])
    if not inputs.raw.device.is_cuda:
        require_visible(call, inputs.origins.numpy(), inputs.directions.numpy())
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
