"""How arguments of a rendering that belong together were given before."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, TypeVar

from warpnerf.rendering.arguments import Head, March

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
