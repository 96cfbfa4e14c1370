"""Arguments that the operations of several frameworks share, and their checks."""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from warpnerf.checked import fits
from warpnerf.checks import (
    MAX_COORDINATE,
    InputError,
    is_finite,
    require_at_least,
    require_length,
    require_positive,
    said,
)
from warpnerf.model.interface import Model, loader
from warpnerf.model.models import model_of
from warpnerf.model.sampler_kinds import MOST
from warpnerf.model.storage_kinds import StorageKind
from warpnerf.rendering.steps import MOST_LINEAR, Steps

MAX_STEPS = {"float32": MOST_LINEAR, "float64": 10**9}
"""Steps that a ray can count, from its origin on: those whose distances are told apart."""


class March(NamedTuple):
    """Ray marching with a constant step: samples at t = near + (k + 1/2) step for every k >= 0,
    below far."""

    step: float
    """Length of a step, scene units."""
    near: float = 0.0
    """Where the first step begins, scene units."""
    far: float | None = None
    """No sample at or beyond it, scene units; None: where the box ends."""


class StoredField(NamedTuple):
    """A field that is no dense grid: what it stores, and how; ``first_tensors`` begins one."""

    kind: str | StorageKind
    """vm, hash, or a configured one: ``warpnerf.Vm``, ``warpnerf.Hash``. What these say of a
    training, as learning rates, does nothing here."""
    tensors: Mapping[str, Any]
    """By name, in the shapes that ``first_tensors`` gives, and of one floating-point type: a
    dictionary, or ``torch.nn.ParameterDict``."""
    size: Sequence[int] | None = None
    """[3] nodes along each axis, over which a vm has planes and lines; a hash has levels of its
    own, and takes none."""


class Head(NamedTuple):
    """A colour head: how a node's numbers become RGB."""

    model: str | Model
    """rgb, sh, deferred, per_sample, or a model from ``warpnerf.model.models``."""
    layers: Iterable[Any] = ()
    """The model's MLP, as torch.nn.Linear holds it: weight [outputs, inputs] and bias [outputs] of
    each layer, in turn; so ``list(network.parameters())``. Inputs are channels or features, then
    the encoded direction. Its gradient is scaled where it passes samples, so for per_sample."""


def require_samples(colors: Sequence[int], sigmas: Sequence[int], distances: Sequence[int]) -> None:
    """Raise InputError unless the shapes of samples' arrays fit: one distance for all channels of a
    colour."""
    if tuple(sigmas) != tuple(distances):
        raise InputError(
            f"sigmas and distances must have one shape, not {list(sigmas)} and {list(distances)}."
        )
    flat = len(colors) != len(distances)
    of_color = (*distances, 1) if flat else tuple(distances)
    if of_color[:-1] != tuple(colors[:-1]) or of_color[-1:] != (1,):
        raise InputError(
            f"colors must be [..., C] over sigmas [...] or [..., 1], not {list(colors)} over "
            f"{list(sigmas)}."
        )


def require_broadcasts(content_distance: Sequence[int], distances: Sequence[int]) -> None:
    """Raise InputError unless an array of content distances of some shape broadcasts over
    distances."""
    try:
        fits = np.broadcast_shapes(tuple(content_distance), tuple(distances)) == tuple(distances)
    except ValueError:
        fits = False
    if not fits:
        raise InputError(
            f"content_distance must broadcast over distances {list(distances)}, not be "
            f"{list(content_distance)}."
        )


def steps_of(step: float | March) -> Steps:
    """What render_rays takes as its step.

    Raises:
        InputError: Lengths are not finite, or do not follow each other.
    """
    length, near, far = step if isinstance(step, March) else March(step)
    require_positive("step", length)
    require_at_least("near", near, 0.0)
    end = 1e30 if far is None or (fits(far, float) and far == math.inf) else far
    if not (is_finite(end) and end > near):
        raise InputError(f"far must lie beyond near, not at {said(far)}.")
    return Steps(near=float(near), far=min(1e30, float(end)), step=float(length))


def head_of(head: str | Model | Head) -> tuple[Model, list[Any]]:
    """The model and its layers, which render_rays takes as its head.

    Raises:
        InputError: It is neither a model nor the name of one, or layers are no list.
    """
    model, layers = model_in(head), head.layers if isinstance(head, Head) else ()
    try:
        return model, list(layers)
    except TypeError as error:
        raise InputError(f"head.layers must be a list of arrays, not {said(layers)}.") from error


def model_in(head: str | Model | Head) -> Model:
    """The model of what render_rays takes as its head, of which nothing else is looked at.

    Raises:
        InputError: It is neither a model nor the name of one.
    """
    model = head.model if isinstance(head, Head) else head
    if isinstance(model, str):
        model = model_of(model)
    if not isinstance(model, Model):
        raise InputError(f"model must be a name or a model, not {said(model)}.")
    return model


def require_box(box: Any) -> None:
    """Raise InputError unless a box is two things."""
    if not isinstance(box, Sequence) or len(box) != 2:
        raise InputError(f"box must be its lower and its upper corner, not {said(box)}.")


def corners_of(box: Any) -> tuple[np.ndarray, np.ndarray]:
    """The lower and the upper corner of a box, [3] float64 each.

    Args:
        box: Two of three numbers each, or arrays, on any device, of any framework.

    Raises:
        InputError: It is none, or has no volume, or is as large as no scene is.
    """
    require_box(box)
    lower, upper = (_corner(field, x) for field, x in zip(("box_min", "box_max"), box, strict=True))
    if not (lower < upper).all():
        raise InputError(f"box_max must lie above box_min on every axis, not {upper} over {lower}.")
    for axis, length in zip("xyz", upper - lower, strict=True):
        require_length(f"the box's edge along {axis}", float(length))
    return lower, upper


def _corner(field: str, value: Any) -> np.ndarray:
    try:
        array = np.asarray(value.detach().cpu() if hasattr(value, "detach") else value)
    except (TypeError, ValueError):  # lists of different lengths
        array = np.array(None)
    good = array.dtype.kind in "fiu" and array.shape == (3,) and np.isfinite(array).all()
    if not good or np.abs(array).max() > MAX_COORDINATE:
        raise InputError(
            f"{field} must be three finite numbers within {MAX_COORDINATE:g} scene units of 0, not "
            f"{said(array.tolist() if array.dtype.kind in 'fiu' else value)}."
        )
    return array.astype(np.float64)


def require_intervals(shape: Sequence[int], n_rays: int) -> None:
    """Raise InputError unless an array of that shape has the edges of intervals of rays."""
    if len(shape) != 2 or shape[0] != n_rays or not 2 <= shape[1] - 1 <= MOST:
        raise InputError(
            f"edges must be [n_rays, n + 1] of n intervals each, from 2 to {MOST}, of {n_rays} "
            f"rays, not {list(shape)}."
        )


def require_rising(are_rising: bool) -> None:
    """Raise InputError unless the edges of intervals are finite, 0 or above, and in rising order.

    Args:
        are_rising: Whether they are, as the framework found that holds them.
    """
    if not are_rising:
        raise InputError("edges must be finite distances of 0 or above, in rising order.")


def steps_of_intervals() -> Steps:
    """How intervals are walked through: all of them, in steps of their own."""
    return Steps(near=0.0, far=1e30, step=1.0)


def require_reach(reach: float, step: float, precision: str) -> None:
    """Raise InputError if steps are too many to be counted.

    Args:
        reach: Distance from rays' origins to the far end of the box, scene units.
        step: Length of a step, scene units.
        precision: float32 or float64.
    """
    if reach / step > (most := MAX_STEPS[precision]):
        raise InputError(
            f"step {step:g} is too short for rays that reach {reach:g} scene units: more than "
            f"{most} steps; use a longer step, or an origin nearer to the box."
        )


def require_layers(found: list[tuple[int, ...]], model: Model, precision: str) -> None:
    """Raise InputError unless arrays of these shapes are the layers of a model's MLP."""
    layout = model.layout(loader(precision))
    if layout is None:
        if found:
            raise InputError(f"head must be empty: the model {model.name} has no MLP.")
        return
    sizes = [layout.n_inputs, *[layout.width] * layout.n_hidden, 3]
    shapes = [
        shape for n_in, n_out in itertools.pairwise(sizes) for shape in ((n_out, n_in), (n_out,))
    ]
    if found != shapes:
        used_up = "" if found else "; what iterates once, as parameters() does, belongs in a list"
        raise InputError(
            f"head of the model {model.name} must be tensors of shapes {shapes}, weight and bias "
            f"of each layer in turn, not {found}{used_up}."
        )
