"""Deprecation: names of the version before, which work for one version more, and warn."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

FORMER_NAMES = {"Features": "PerSample", "Sight": "Visibility", "look": "visibility"}
"""Of the package ``warpnerf``, and what they are called now."""

Taken = ParamSpec("Taken")
Made = TypeVar("Made")


def warn_renamed(old: str, new: str) -> None:
    """Say that a name has become another one, by a DeprecationWarning.

    It is about the line outside of the package that has used it: else nobody would be shown it.

    Args:
        old: The former name.
        new: The one to use.
    """
    level, frame = 1, sys._getframe()
    while (caller := frame.f_back) and frame.f_globals["__name__"].partition(".")[0] == "warpnerf":
        level, frame = level + 1, caller
    warnings.warn(
        f"{old} is called {new} now; the former name will be removed in the next version.",
        DeprecationWarning,
        stacklevel=level,
    )


def renamed_argument(
    old: str, new: str
) -> Callable[[Callable[Taken, Made]], Callable[Taken, Made]]:
    """Let a function take an argument by its former name, too; a decorator.

    Args:
        old: The former name.
        new: The one that the function has for it.
    """

    def decorated(function: Callable[Taken, Made]) -> Callable[Taken, Made]:
        @functools.wraps(function)
        def taking_both(*arguments: Any, **named: Any) -> Made:
            if old in named:
                if new in named:
                    raise TypeError(
                        f"{function.__name__}() got {new!r} and its former name {old!r}"
                    )
                warn_renamed(f"{function.__name__}(..., {old}=)", f"{new}=")
                named[new] = named.pop(old)
            return function(*arguments, **named)

        return cast("Callable[Taken, Made]", taking_both)

    return decorated
