"""Which model a command is about: --model and --model-options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from warpnerf.checks import InputError, require_one_of
from warpnerf.model.interface import Model
from warpnerf.model.models import MODELS, model_of


def chosen_model(begin: Model, name: str | None, options: Sequence[str]) -> Model:
    """The model that options ask for.

    Args:
        begin: The one where none is named: the preset's, or that of the run that goes on.
        name: What --model names. Another one than `begin` starts from its defaults.
        options: What --model-options lists, a field and its value each, such as "width=64".

    Returns:
        `begin` or the model of that name, with these values.

    Raises:
        InputError: There is no such model or field, a field is given twice, or a value does not
            fit.
    """
    if name is not None:
        require_one_of("--model", name, tuple(MODELS))
    model = begin if name in (None, begin.name) else model_of(str(name))
    known = {f.name: getattr(model, f.name) for f in fields(model)}  # type: ignore[arg-type]
    given: dict[str, Any] = {}
    for option in options:
        field, equals, text = option.partition("=")
        if not equals or field not in known:
            listed = ", ".join(f"{key}={value}" for key, value in known.items()) or "none"
            raise InputError(
                f"--model-options: {option!r} is no option of the model {model.name}; it has "
                f"{listed}."
            )
        if field in given:
            raise InputError(f"--model-options: {field} is given twice; keep one of them.")
        given[field] = _parsed(field, text, type(known[field]))
    return replace(model, **given)  # type: ignore[type-var]


def _parsed(field: str, text: str, kind: type) -> Any:
    words = {"true": True, "false": False}
    try:
        return words[text.lower()] if kind is bool else kind(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number"}[kind]
        raise InputError(f"--model-options: {field} must be {wanted}, not {text!r}.") from None
