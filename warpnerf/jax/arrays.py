"""What arrays have to be, and the errors where they are not."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from warpnerf.checks import InputError, said


def array_of(field: str, value: Any) -> jax.Array:
    """A JAX array of floating-point numbers.

    Raises:
        InputError: The value is no array, or holds other numbers.
    """
    if not isinstance(value, (jax.Array, np.ndarray)):
        raise InputError(f"{field} must be an array, not {said(value)}; call jax.numpy.asarray.")
    if not jnp.issubdtype(value.dtype, jnp.floating):
        raise InputError(
            f"{field} must be floating point, not {value.dtype}; call its astype(float)."
        )
    return jnp.asarray(value)


def known(field: str, value: Any, dtype: Any = None) -> np.ndarray | None:
    """The values of an array or of numbers; None while a function of them is traced, as under
    ``jax.jit``.

    Args:
        field: What they are.
        value: The array or numbers.
        dtype: Of the values, in which what is too large is infinite; None: as given.

    Raises:
        InputError: The value is neither.
    """
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # lists of different lengths
        array = np.array(None)
    if not jnp.issubdtype(array.dtype, jnp.floating) and array.dtype.kind not in "iu":
        raise InputError(f"{field} must be an array or numbers, not {said(value)}.")
    with np.errstate(over="ignore", under="ignore"):
        return array if dtype is None else array.astype(dtype)


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def constant(field: str, value: jax.Array) -> jax.Array:
    """An array that has no gradient.

    Raises:
        InputError: It is differentiated with respect to it.
    """
    return value


def _constant_forward(field: str, value: Any) -> tuple[jax.Array, None]:
    if value.perturbed:
        raise InputError(
            f"{field} is differentiated, but no gradient with respect to it is computed; call "
            "jax.lax.stop_gradient of it."
        )
    return value.value, None


def _constant_backward(field: str, kept: None, gradient: Any) -> tuple[None]:
    return (None,)


constant.defvjp(_constant_forward, _constant_backward, symbolic_zeros=True)
