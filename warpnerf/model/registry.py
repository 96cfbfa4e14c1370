"""Kinds that have a name, in files and in the command: models, and what fields are stored in.

A kind is a frozen dataclass whose fields are numbers with defaults. A table of kinds by name is
what others add theirs to.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from typing import Any, TypeVar

from warpnerf.checked import fits, in_words
from warpnerf.checks import InputError, require_finite, said

Kind = TypeVar("Kind", bound=type[Any])


def add(table: dict[str, Any], name: str, kind: Kind, what: str) -> Kind:
    """Make a kind known by a name.

    Args:
        table: Kinds by name.
        name: Of the kind.
        kind: The class.
        what: It is, in words.

    Raises:
        ValueError: Another one has that name.
    """
    if table.setdefault(name, kind) is not kind:
        raise ValueError(f"{name!r} is the name of another {what}")
    return kind


def find(table: dict[str, Any], name: str, what: str) -> Any:
    """The kind of a name.

    Args:
        table: Kinds by name.
        name: Of the kind.
        what: It is, in words.

    Raises:
        ValueError: There is none.
    """
    if name not in table:
        raise ValueError(f"{name!r} is no {what} of {', '.join(table)}; register it")
    return table[name]


def keep_plain(value: Any, what: str) -> None:
    """Make each field of a frozen dataclass a plain int, float or bool, as its default is.

    So what files hold of it is read back as the same. For ``__post_init__``.

    Args:
        value: An instance.
        what: It is, in configurations.

    Raises:
        InputError: A field is given something of another type than its default is, or a float that
            is neither that nor finite.
    """
    for f in fields(value):
        given, kind = getattr(value, f.name), type(f.default)
        if kind in (bool, int, float) and not fits(given, kind):
            raise InputError(f"{what}.{f.name} must be {in_words(kind)}, not {said(given)}.")
        if kind is float and given != f.default:
            require_finite(f"{what}.{f.name}", given)
        if kind in (bool, int, float):
            object.__setattr__(value, f.name, kind(given))


def to_json(value: Any) -> dict[str, Any]:
    """Name and configuration."""
    return {"name": value.name, **asdict(value)}


def from_json(table: dict[str, Any], tree: Any, what: str, before: dict[str, Any]) -> Any:
    """What ``to_json`` wrote.

    Args:
        table: Kinds by name.
        tree: From a file.
        what: It is, in words.
        before: By name, what was the default where a file does not tell.

    Raises:
        ValueError: It is none that this version knows.
    """
    if not isinstance(tree, dict) or tree.get("name") not in table:
        raise ValueError(f"{tree!r} is no {what} of {', '.join(table)}")
    kind = table[tree["name"]]
    given = before.get(kind.name, {}) | tree
    del given["name"]
    types = {f.name: type(f.default) for f in fields(kind)}
    for name, value in given.items():
        if type(value) is int and types.get(name) is float:
            given[name] = float(value)
        elif name not in types or type(value) is not types[name]:
            raise ValueError(f"{name!r} of the {what} {kind.name} cannot be {value!r}")
    return kind(**given)
