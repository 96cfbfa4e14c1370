"""Dataclasses and functions that refuse values of other types than their fields and arguments have,
in one sentence."""

from __future__ import annotations

import importlib
import inspect
import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from warpnerf.checks import InputError, said

Checked = TypeVar("Checked", bound=type[Any])
Function = TypeVar("Function", bound=Callable[..., Any])

MANY = 10_000
"""Elements of a sequence whose types are looked at."""


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


def checked_arguments(function: Function) -> Function:
    """Check the types of a function's arguments, as its annotations have them, when it is called.

    What annotations name need not be known where the function is: public names of the package are
    looked up. Arguments whose annotations are not understood are not checked. Arrays that stand for
    a list or a number become that.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def called(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind(*args, **kwargs)
        except TypeError:
            return function(*args, **kwargs)  # which says what is missing, and of what
        hints = _argument_hints(function)
        for name, value in given.arguments.items():
            if name not in hints:
                continue
            what, hint = f"{function.__name__}: {name}", hints[name]
            if signature.parameters[name].kind is inspect.Parameter.VAR_POSITIONAL:
                value = tuple(_argument(what, one, hint) for one in value)
            else:
                value = _argument(what, value, hint)
            given.arguments[name] = value
        return function(*given.args, **given.kwargs)

    return called  # type: ignore[return-value]


WAYS = {
    "a Scene": "load_scene gives that of a folder",
    "a Field": "load_field reads that of a run",
    "a TrainConfig": 'those of names are in PRESETS, as in train(scene, PRESETS["fast"])',
    "a TrainingState": "load_checkpoint reads one",
    "an Inspection": "inspect makes one",
}
"""How to come by what is wanted."""


def _argument(what: str, value: Any, hint: Any) -> Any:
    """An argument as its function takes it."""
    listed = value.tolist() if isinstance(value, np.ndarray) else value
    if fits(listed, hint) and not fits(value, hint):
        value = listed
    elif not fits(value, hint):
        way_out = next((f"; {WAYS[name]}" for name in WAYS if name in in_words(hint)), "")
        raise InputError(f"{what} must be {in_words(hint)}, not {said(value)}{way_out}.")
    if isinstance(value, str | os.PathLike) and "\0" in os.fsdecode(value):
        raise InputError(f"{what} has a character of code 0, which no name has; leave it out.")
    return value


@cache
def _argument_hints(function: Callable[..., Any]) -> dict[str, Any]:
    """Types of arguments, without those that cannot be known."""
    package = importlib.import_module(function.__module__.partition(".")[0])
    names = _Names(vars(sys.modules[function.__module__]), package)
    hints = {}
    for name, parameter in inspect.signature(function).parameters.items():
        try:
            if isinstance(parameter.annotation, str):
                hints[name] = eval(parameter.annotation, {}, names)
        except (NameError, AttributeError, TypeError):
            continue
    return hints


class _Names(dict[str, Any]):
    """What a module knows, and the public names of its package."""

    def __init__(self, known: Mapping[str, Any], package: Any) -> None:
        super().__init__(known)
        self._package = package

    def __missing__(self, name: str) -> Any:
        if name not in getattr(self._package, "__all__", ()):
            raise KeyError(name)
        return getattr(self._package, name)


def _plain(value: Any) -> Any:
    if value is np.ma.masked:
        return math.nan
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
    if origin in (list, Sequence):
        whole = Sequence if origin is Sequence else list
        if isinstance(value, str | bytes) or not isinstance(value, whole | np.ndarray):
            return False
        if isinstance(value, np.ndarray) and not value.ndim:
            return False
        return len(value) > MANY or all(fits(one, inner[0]) for one in value)
    if origin in (dict, Mapping):
        return isinstance(value, Mapping) and all(
            fits(key, inner[0]) and fits(one, inner[1]) for key, one in value.items()
        )
    if origin is Callable or hint is Callable:
        return callable(value)
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
        return " or ".join(dict.fromkeys(in_words(one) for one in inner))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}" if len(inner) > 1 else str(inner[0])
    if origin is tuple:
        if inner[1:] == (...,):
            return f"a list, each {in_words(inner[0])}"
        return f"a list of {len(inner)} values, each {in_words(inner[0])}"
    if origin in (list, Sequence):
        return f"a list, each {in_words(inner[0])}"
    if origin in (dict, Mapping):
        return f"a dictionary, each value {in_words(inner[1])}"
    if origin is Callable or hint is Callable:
        return "a function"
    words = {int: "a whole number (int)", float: "a number", bool: "True or False", str: "text"}
    words |= {NoneType: "None", Path: "a path", np.ndarray: "an array"}
    name = str(getattr(hint, "__name__", hint))
    return words.get(hint, f"{'an' if name[0] in 'AEIO' else 'a'} {name}")
