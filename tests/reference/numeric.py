"""Measures that need no derivative: directional differences and the relative error."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def central_difference(
    f: Callable[[Tensor], Tensor], x: Tensor, direction: Tensor, h: float
) -> Tensor:
    """Derivative of f at x along direction: (f(x + h d) - f(x - h d)) / (2 h).

    Args:
        f: Maps a tensor shaped like x to any shape [...].
        x: Where to differentiate.
        direction: Of the shape of x; its length counts, so that this estimates <grad f, direction>.
        h: Step, in units of direction.

    Returns:
        Estimate [...], with an error of order h^2.
    """
    with torch.no_grad():
        return (f(x + h * direction) - f(x - h * direction)) / (2.0 * h)


def relative_error(a: Any, b: Any) -> float:
    """max |a - b| / max |b|, with b the reference; NaN wherever either holds a NaN.

    Args:
        a: Values under test, anything torch.as_tensor takes.
        b: Reference of the same shape.

    Returns:
        The relative error.

    Raises:
        ValueError: Shapes differ, or the reference is zero throughout and so can confirm nothing.
    """
    values = torch.as_tensor(a).detach().cpu().to(torch.float64)
    reference = torch.as_tensor(b).detach().cpu().to(torch.float64)
    if values.shape != reference.shape:
        raise ValueError(f"shapes differ: {tuple(values.shape)} and {tuple(reference.shape)}.")
    largest = float(reference.abs().max())
    if largest == 0.0:
        raise ValueError("the reference is zero everywhere; a comparison with it shows nothing.")
    return float((values - reference).abs().max()) / largest
