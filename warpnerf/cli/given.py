"""Options that were given, before they are values: by dotted name, or as NAME=VALUE."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any, get_type_hints

from warpnerf.checks import InputError, said
from warpnerf.cli.values import read_value, text_of

Given = Mapping[str, tuple[str, ...]]
"""Fields of a configuration that options were given for, by dotted name, and their words."""

NOTHING: Given = MappingProxyType({})
"""No options."""

SHORT = {
    "grid.voxels": "--voxels",
    "grid.border": "--border",
    "grid.contraction": "--contraction",
    "march.near": "--near",
}
"""By dotted name, the shorter one that an option has besides."""


def flag_of(path: str) -> str:
    """The shortest option for a field of a configuration, by its dotted name."""
    return SHORT.get(path, "--" + path.replace("_", "-"))


def values_of(flag: str, otherwise: str, begin: Any, options: Sequence[str]) -> dict[str, Any]:
    """Fields of a configuration and the values that NAME=VALUE gives them.

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
                f"{flag}: {said(option)} is no NAME=VALUE; {flag} takes all words up to the next "
                "option, so what does not belong to it goes before it."
            )
        if not equals or field not in known:
            raise InputError(f"{flag}: {said(option)} is {otherwise} {_listed(known)}.")
        if field in given:
            raise InputError(f"{flag}: {field} is given twice; keep one of them.")
        given[field] = read_value(f"{flag}: {field}", kinds[field], (text,))
    return given


def with_dotted(
    values: dict[str, Any], part: str, otherwise: str, begin: Any, given: Given
) -> dict[str, Any]:
    """Values of a part of a configuration, and those that options with dotted names give it.

    Args:
        values: By field, from NAME=VALUE.
        part: The part's name, such as model.
        otherwise: As for ``values_of``.
        begin: The part, a dataclass.
        given: Words by dotted name; those of other parts are left alone.

    Returns:
        By field.

    Raises:
        InputError: There is no such field, it is given twice, or its words do not fit.
    """
    known = {f.name: getattr(begin, f.name) for f in fields(begin)}
    kinds = get_type_hints(type(begin))
    both = dict(values)
    for path, words in given.items():
        of_part, dot, field = path.rpartition(".")
        if not dot or of_part != part:
            continue
        if field not in known:
            raise InputError(f"{flag_of(path)} is {otherwise} {_listed(known)}.")
        if field in values:
            raise InputError(f"{part}.{field} is given twice; keep one of them.")
        both[field] = read_value(flag_of(path), kinds[field], words)
    return both


def near_to(name: str, known: Iterable[str]) -> str:
    """Which name may have been meant: half a sentence, or nothing where none is like it."""
    names = list(known)
    last = name.lstrip("-").rpartition(".")[2]
    found = [other for other in names if other.lstrip("-").rpartition(".")[2] == last]
    found = found or get_close_matches(name, names, n=1)
    return f", the nearest is {found[0]}" if found else ""


def _listed(known: Mapping[str, Any]) -> str:
    return ", ".join(f"{key}={text_of(value)}" for key, value in known.items()) or "none"
