"""Arguments of a rendering that belong together, and how they were given before."""

import functools
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, TypeVar

import torch

from warpnerf.model.interface import Model


class March(NamedTuple):
    """Ray marching with a constant step: samples at t = near + (k + 1/2) step for every k >= 0,
    below far."""

    step: float
    """Length of a step, scene units."""
    near: float = 0.0
    """Where the first step begins, scene units."""
    far: float | None = None
    """No sample at or beyond it, scene units; None: where the box ends."""


class Head(NamedTuple):
    """A colour head: how a node's numbers become RGB."""

    model: str | Model
    """rgb, sh, deferred, per_sample, or a model from ``warpnerf.model.models``."""
    layers: Iterable[torch.Tensor] = ()
    """The model's MLP, as torch.nn.Linear holds it: weight [outputs, inputs] and bias [outputs] of
    each layer, in turn; so ``network.parameters()``. Inputs are channels or features, then the
    encoded direction. Its gradient is scaled where it passes samples, so for per_sample."""


Function = TypeVar("Function", bound=Callable[..., Any])


def accept_old_spelling(render: Function) -> Function:
    """Take box_min and box_max, near and far, model and head apart as well, with a warning."""

    @functools.wraps(render)
    def accepting(*given: Any, **options: Any) -> Any:
        arguments, old = (
            list(given),
            options.keys() & {"box_min", "box_max", "near", "far", "model"},
        )
        if old & {"box_min", "box_max"} or (len(arguments) == 5 and "step" in options):
            old |= {"box_min", "box_max"}
            named = [options.pop(name) for name in ("box_min", "box_max") if name in options]
            options["box"] = (*arguments[3:], *named)
            del arguments[3:]
        if old & {"near", "far"}:
            if "step" not in options:
                raise TypeError(
                    "render_rays() takes near and far beside step= only; use March(step, near, far)"
                )
            options["step"] = March(
                options["step"], options.pop("near", 0.0), options.pop("far", None)
            )
        if "model" in old:
            options["head"] = Head(options.pop("model"), options.pop("head", ()))
        if old:
            warnings.warn(
                f"render_rays takes {', '.join(sorted(old))} in another form now, and as here only "
                "until warpnerf 0.2: box=(box_min, box_max), step=March(step, near, far), "
                "head=Head(model, layers).",
                DeprecationWarning,
                stacklevel=2,
            )
        return render(*arguments, **options)

    return accepting  # type: ignore[return-value]
