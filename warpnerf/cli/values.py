"""Words of the command line as values of a field's type, and how help writes such types."""

from __future__ import annotations

import re
from collections.abc import Sequence
from decimal import Decimal
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from warpnerf.checks import InputError, said

WANTED = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}
"""What a value has to be, in words."""

NONE = "none"
"""The word for None, and for a tuple of no numbers."""


def whole_number(text: str) -> int:
    """A whole number, which may have an exponent, as 1e6.

    Raises:
        ValueError: It is none.
    """
    if re.fullmatch(r"\d+(\.\d+)?e\d{1,2}", text.lower()):
        count = Decimal(text)
        if count == count.to_integral_value():
            return int(count)
    return int(text)


def truth(text: str) -> bool:
    """True or false.

    Raises:
        ValueError: It is neither.
    """
    if text.lower() not in ("true", "false"):
        raise ValueError(text)
    return text.lower() == "true"


READERS: dict[Any, Any] = {bool: truth, int: whole_number, float: float, str: str}
"""By type, what makes a value of one word."""


def read_value(what: str, kind: Any, words: Sequence[str]) -> Any:
    """The value that words stand for.

    Where a field wants one of several words and nothing else, any word is returned: the
    configuration looks at it.

    Args:
        what: The option, for the message.
        kind: The field's type: a word, number or bool, words to choose from, a tuple of numbers,
            or one of several of these, or None.
        words: As they were given.

    Returns:
        The value.

    Raises:
        InputError: They stand for none.
    """
    members = _members(kind)
    chosen = [word for member in members for word in _choices(member)]
    others = [m for m in members if not _choices(m)]
    if len(words) == 1 and (words[0] in chosen or not others):
        return words[0]
    if tuple(words) == (NONE,) and NoneType in others:
        return None
    for member in others:
        try:
            return _read(member, words)
        except ValueError:
            continue
    listed = " or ".join([*chosen, *(_wanted(member) for member in others)])
    raise InputError(f"{what} must be {listed}, not {said(' '.join(words))}.")


def _read(member: Any, words: Sequence[str]) -> Any:
    """A value of one type; ValueError where the words are none."""
    if get_origin(member) is tuple:
        numbers = () if tuple(words) == (NONE,) else tuple(map(float, words))
        if ... not in get_args(member) and len(numbers) != len(get_args(member)):
            raise ValueError(words)
        return numbers
    if len(words) != 1 or member not in READERS:
        raise ValueError(words)
    return READERS[member](words[0])


def takes_several(kind: Any) -> bool:
    """Whether a type's values may be several words."""
    return any(get_origin(member) is tuple for member in _members(kind))


def metavar_of(kind: Any) -> str:
    """How help writes what an option takes."""
    listed = []
    for member in _members(kind):
        if member is NoneType:
            listed.append(NONE)
        elif choices := _choices(member):
            listed.append("{" + ",".join(choices) + "}")
        elif get_origin(member) is tuple:
            numbers = get_args(member)
            listed.append("FLOAT ..." if ... in numbers else " ".join(["FLOAT"] * len(numbers)))
        else:
            listed.append("{true,false}" if member is bool else member.__name__.upper())
    return "|".join(listed)


def text_of(value: Any) -> str:
    """A value as the words that stand for it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return " ".join(f"{number:.4g}" for number in value) or NONE
    if isinstance(value, float):
        return f"{value:g}"
    return NONE if value is None else str(value)


def _members(kind: Any) -> tuple[Any, ...]:
    """The types of which a value may be."""
    if get_origin(kind) not in (Union, UnionType):
        return (kind,)
    return tuple(inner for member in get_args(kind) for inner in _members(member))


def _choices(member: Any) -> tuple[str, ...]:
    return get_args(member) if get_origin(member) is Literal else ()


def _wanted(member: Any) -> str:
    if member is NoneType:
        return NONE
    if get_origin(member) is tuple:
        numbers = get_args(member)
        return "numbers" if ... in numbers else f"{len(numbers)} numbers"
    return WANTED[member]
