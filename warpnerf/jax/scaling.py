"""The paper's gradient scaling as a JAX operation."""

from __future__ import annotations

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np

from warpnerf.checks import InputError, require_one_of, require_positive
from warpnerf.config import Scaling
from warpnerf.jax.arrays import array_of, constant, known
from warpnerf.rendering.arguments import require_broadcasts, require_samples


def scale_gradient(
    colors: jax.Array,
    sigmas: jax.Array,
    distances: jax.Array,
    content_distance: float | jax.Array = 1.0,
    scaling: Scaling = "clamped",
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Scale the gradients of samples by their distance; call it just before integrating them.

    Identity forward. Backward, with s = 1 (none), (t / D)^2 (quadratic) or min(1, (t / D)^2)
    (clamped): dL/dcolor <- s dL/dcolor, dL/dsigma <- s dL/dsigma. What reaches t passes as it is,
    and s itself is a constant. It is made of ``jax.numpy``, so that every transformation of JAX
    but forward mode applies to it.
    Source: Philip & Deschaintre 2023, "Floaters No More", eq. 7.

    Args:
        colors: [..., C] of samples, any floating type.
        sigmas: [...] or [..., 1] densities of the same samples.
        distances: t, of the shape of sigmas, scene units from the camera centre.
        content_distance: D, scene units; a number, or an array that broadcasts over distances.
        scaling: none, quadratic or clamped.

    Returns:
        colors, sigmas and distances, unchanged.

    Raises:
        InputError: Arrays are not floating point, shapes do not fit, or content_distance is
            differentiated, or not above zero, where its values are known: under ``jax.jit`` they
            are not.
    """
    require_one_of("scaling", scaling, get_args(Scaling))
    colors, sigmas, distances = (
        array_of(field, value)
        for field, value in (("colors", colors), ("sigmas", sigmas), ("distances", distances))
    )
    require_samples(colors.shape, sigmas.shape, distances.shape)
    if isinstance(content_distance, (jax.Array, np.ndarray)):
        require_broadcasts(content_distance.shape, distances.shape)
        values = known("content_distance", content_distance)
        if values is not None and not (values > 0).all():
            raise InputError("content_distance must be above 0 everywhere.")
        content_distance = constant("content_distance", content_distance)
    else:
        require_positive("content_distance", content_distance)
        content_distance = float(content_distance)
    if scaling == "none":
        return colors, sigmas, distances
    ratio = jax.lax.stop_gradient(distances / content_distance)
    scale = ratio * ratio
    if scaling == "clamped":
        scale = jnp.minimum(scale, 1.0)
    of_color = scale if colors.ndim == distances.ndim else scale[..., None]
    return _scaled(colors, of_color), _scaled(sigmas, scale), distances


@jax.custom_vjp
def _scaled(x: jax.Array, scale: jax.Array) -> jax.Array:
    """x, whose gradient is multiplied by scale."""
    return x


def _forward(x: jax.Array, scale: jax.Array) -> tuple[jax.Array, jax.Array]:
    return x, scale


def _backward(scale: jax.Array, gradient: jax.Array) -> tuple[jax.Array, None]:
    return gradient * scale.astype(gradient.dtype), None


_scaled.defvjp(_forward, _backward)
