"""Dataclasses that refuse values of other types than their fields have, in one sentence."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import fields
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from warpnerf.checks import InputError, said

Checked = TypeVar("Checked", bound=type[Any])


def checked(part: str) -> Callable[[Checked], Checked]:
    """Check the types of fields, after what ``__post_init__`` refuses by itself; before, numbers of
    NumPy become Python's, as files hold them.

    A decorator above ``dataclass``, for classes with a ``__post_init__``.

    Args:
        part: What fields are named by in sentences, such as grid for grid.voxels; empty: nothing.
    """

    def decorate(kind: Checked) -> Checked:
        refuse = kind.__post_init__

        @wraps(refuse)
        def __post_init__(self: Any) -> None:
            for field in fields(self):
                object.__setattr__(self, field.name, _plain(getattr(self, field.name)))
            try:
                refuse(self)
            except InputError:
                raise
            except (TypeError, AttributeError, ArithmeticError, ValueError) as error:
                _require_types(part, self, kind)
                what = part or kind.__name__
                raise InputError(f"{what} cannot have these values: {error}.") from error
            _require_types(part, self, kind)

        kind.__post_init__ = __post_init__
        return kind

    return decorate


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    if type(value) is tuple and any(isinstance(one, np.generic) for one in value):
        return tuple(map(_plain, value))
    return value


def _require_types(part: str, value: Any, kind: type[Any]) -> None:
    """Raise InputError at the first field whose value is not of its type."""
    hints = _hints(kind)  # type: ignore[arg-type]
    for field in fields(value):
        given = getattr(value, field.name)
        if field.name in hints and not fits(given, hints[field.name]):
            name = f"{part}.{field.name}" if part else field.name
            raise InputError(f"{name} must be {in_words(hints[field.name])}, not {said(given)}.")


@cache
def _hints(kind: type[Any]) -> dict[str, Any]:
    """Types of fields; none where a name in them is not known at run time."""
    try:
        return get_type_hints(kind)
    except NameError:
        return {}


def fits(value: object, hint: Any) -> bool:
    """Whether a value is of a type as annotations have it; what is not understood fits."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return any(fits(value, one) for one in inner)
    if origin is Literal:
        return any(value is one or (type(value) is type(one) and value == one) for one in inner)
    if origin is tuple:
        if not isinstance(value, tuple | list):
            return False
        if inner[1:] == (...,):
            return all(fits(one, inner[0]) for one in value)
        return len(value) == len(inner) and all(map(fits, value, inner))
    if hint in (int, float):
        number = Integral if hint is int else Real
        return isinstance(value, number) and not isinstance(value, bool | np.bool_)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    if hint is Path:
        return isinstance(value, str | os.PathLike)
    return isinstance(value, hint) if isinstance(hint, type) else True


def in_words(hint: Any) -> str:
    """A type as sentences name it."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return " or ".join(in_words(one) for one in inner)
    if origin is Literal:
        return " or ".join(map(str, inner))
    if origin is tuple:
        count = "" if inner[1:] == (...,) else f"{len(inner)} "
        return f"a list of {count}values, each {in_words(inner[0])}"
    words = {int: "a whole number (int)", float: "a number", bool: "True or False", str: "text"}
    words |= {NoneType: "None", Path: "a path", np.ndarray: "an array"}
    return words.get(hint, f"a {getattr(hint, '__name__', hint)}")
