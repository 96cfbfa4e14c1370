"""Which model a command is about: --model and --model-options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

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
    what = f"no option of the model {model.name}; it has"
    return replace(model, **values_of("--model-options", what, model, options))  # type: ignore[type-var]


def values_of(flag: str, otherwise: str, begin: Any, options: Sequence[str]) -> dict[str, Any]:
    """Fields of a configuration and the values that options give them.

    Args:
        flag: What lists the options.
        otherwise: What an option is that names no field, and the words before those there are.
        begin: The configuration, a dataclass of numbers, words and bools.
        options: A field and its value each, such as "width=64".

    Returns:
        By field.

    Raises:
        InputError: There is no such field, it is given twice, or a value does not fit.
    """
    known = {f.name: getattr(begin, f.name) for f in fields(begin)}
    kinds = get_type_hints(type(begin))
    given: dict[str, Any] = {}
    for option in options:
        field, equals, text = option.partition("=")
        if not equals and field not in known:
            raise InputError(
                f"{flag}: {option!r} is no NAME=VALUE; {flag} takes all words up to the next "
                "option, so what does not belong to it goes before it."
            )
        if not equals or field not in known:
            listed = ", ".join(f"{key}={value}" for key, value in known.items()) or "none"
            raise InputError(f"{flag}: {option!r} is {otherwise} {listed}.")
        if field in given:
            raise InputError(f"{flag}: {field} is given twice; keep one of them.")
        given[field] = _parsed(flag, field, text, kinds[field])
    return given


def _parsed(flag: str, field: str, text: str, kind: Any) -> Any:
    """A value of a type or of one of several; the configuration looks at words."""
    parts = get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,)
    words = [word for part in parts if get_origin(part) is Literal for word in get_args(part)]
    numbers = [p for p in parts if get_origin(p) is not Literal and p is not NoneType]
    if text in words or not numbers:
        return text
    (number,) = numbers
    truth = {"true": True, "false": False}
    try:
        return truth[text.lower()] if number is bool else number(text)
    except (ValueError, KeyError):
        wanted = {bool: "true or false", int: "a whole number", float: "a number"}[number]
        listed = " or ".join([*words, wanted])
        raise InputError(f"{flag}: {field} must be {listed}, not {text!r}.") from None
