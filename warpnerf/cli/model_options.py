"""Which model a command is about: --model, its options by dotted names, and --model-options."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

from warpnerf.checks import require_one_of
from warpnerf.cli.given import NOTHING, Given, values_of, with_dotted
from warpnerf.model.interface import Model
from warpnerf.model.models import MODELS, current_name, model_of


def chosen_model(
    begin: Model, name: str | None, options: Sequence[str], given: Given = NOTHING
) -> Model:
    """The model that options request.

    Args:
        begin: The one where none is named: the preset's, or that of the run that is resumed.
        name: What --model names. Another one than `begin` starts from its defaults.
        options: What --model-options lists, a field and its value each, such as "width=64".
        given: The words of options with dotted names, such as "model.width"; others than the
            model's are left alone.

    Returns:
        `begin` or the model of that name, with these values.

    Raises:
        InputError: There is no such model or field, a field is given twice, or a value does not
            fit.
    """
    if name is not None:
        former, name = name, current_name(name)
        if name != former:
            print(f"note: the model {former} is called {name} now", file=sys.stderr)
        require_one_of("--model", name, tuple(MODELS))
    model = begin if name in (None, begin.name) else model_of(str(name))
    what = f"no option of the model {model.name}; it has"
    values = values_of("--model-options", what, model, options)
    values = with_dotted(values, "model", what, model, given)
    return replace(model, **values)  # type: ignore[type-var]
