"""Values of wrong types and sizes: words of a command line, of JSON, and of Python."""

from __future__ import annotations

import copy
import datetime
import decimal
import fractions
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

WORDS = (
    *("", " ", "-1", "0", "-0", "1.5", "nan", "inf", "-inf", "1e400", "9" * 25, "9" * 500, "0x10"),
    *(
        "1_000",
        "None",
        "none",
        "auto",
        "true",
        "false",
        "yes",
        "x",
        "x" * 300,
        "x" * 70_000,
        "\u00bd",
    ),
    *("-", "--", "---", "-x", "--x", "=", "a=b", "a=", "=b", "[", "{}", "\\", "/", ".", "..", "~"),
    *(
        "/dev/null",
        "/nonexistent/x",
        "/proc/self/mem",
        "a/../../b",
        "\n",
        "a\nb",
        "\x1b[2J",
        "\u202e",
    ),
    *(
        "caf\u00e9",
        "\udcff",
        "1,2",
        "1;2",
        "$HOME",
        "`ls`",
        "%s",
        "builtin:",
        "builtin:x",
        "file:///",
    ),
    *("http://x/y", "2147483648", "9223372036854775808", "-9223372036854775809", "1e-400", "0.0"),
)
"""In place of a word. None of them begins a training that takes long."""

JSON: tuple[Any, ...] = (
    *(None, True, False, -1, 0, 1, 2**31, 2**63, 2**64, 10**30, 1.5, -1e308, 1e308, 1e-320),
    *("", "x", "nan", "x" * 5000, "../x", "/etc/passwd", "a\x00b", "\u202e", "\x1b[2J", "\ud83d"),
    *([], [[]], [None], [1, 2, 3], [[1, 2], [3]], {}, {"x": {}}, [[0] * 4] * 4, [[1e200] * 4] * 4),
    *(float("nan"), float("inf"), float("-inf"), [float("nan")] * 3),
)
"""In place of a value; those that JSON has no words for are written as Python writes them."""


class Odd:
    """An object that is described in lines."""

    def __repr__(self) -> str:
        return "first line\nsecond line"


def _numbers() -> Any:
    yield from range(3)


PYTHON: tuple[Callable[[], Any], ...] = (
    *(lambda: None, lambda: True, lambda: -1, lambda: 0, lambda: 2**31, lambda: 2**63),
    *(
        lambda: 10**400,
        lambda: -(10**5000),
        lambda: 1.5,
        lambda: float("nan"),
        lambda: float("inf"),
    ),
    *(lambda: -1e308, lambda: 1e-320, lambda: 1 + 2j, lambda: "", lambda: "x", lambda: "a\0b"),
    *(lambda: "x" * 5000, lambda: "\udcff", lambda: b"x", lambda: bytearray(3), lambda: [], list),
    *(lambda: [1], lambda: (1, 2, 3), lambda: [None] * 3, lambda: {}, lambda: {"a": 1}, set),
    *(lambda: frozenset([1]), lambda: object(), lambda: Odd(), lambda: int, lambda: len, _numbers),
    *(lambda: range(3), lambda: iter([]), lambda: Path("/nonexistent/x"), lambda: Path(), Path),
    *(lambda: np.zeros(3), lambda: np.zeros((0, 3)), lambda: np.full((3, 4), np.nan), lambda: ...),
    *(lambda: np.array(None), lambda: np.array("x"), lambda: np.zeros((3, 4), complex)),
    *(lambda: np.zeros((2, 3, 4, 5)), lambda: np.float32("nan"), lambda: np.int64(5)),
    *(lambda: np.datetime64("nat"), lambda: np.ma.masked, lambda: decimal.Decimal("NaN")),
    *(lambda: fractions.Fraction(1, 3), lambda: datetime.date(2000, 1, 1), lambda: ValueError("x")),
    *(lambda: NotImplemented, lambda: memoryview(b"abc"), lambda: slice(1), lambda: lambda: 1),
    *(lambda: [[1, 2], [3]], lambda: ["a", 1, None], lambda: (float("nan"),) * 3, lambda: [{}] * 2),
)
"""Makers of values, so that each case has its own."""


def mutated(rng: random.Random, content: Any) -> Any:
    """A JSON document with one to three of its values replaced, removed, repeated or renamed."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = _mutate(rng, content)
    return content


def _mutate(rng: random.Random, content: Any) -> Any:
    places: list[tuple[Any, Any]] = []
    open_ones = [content] if isinstance(content, dict | list) else []
    while open_ones:
        one = open_ones.pop()
        keys = list(one) if isinstance(one, dict) else list(range(len(one)))
        places += [(one, key) for key in keys]
        open_ones += [one[key] for key in keys if isinstance(one[key], dict | list)]
    if not places or rng.random() < 0.02:
        return copy.deepcopy(rng.choice(JSON))
    holder, key = rng.choice(places)
    change = rng.random()
    if change < 0.7:
        holder[key] = copy.deepcopy(rng.choice(JSON))
    elif change < 0.8:
        del holder[key]
    elif change < 0.87 and isinstance(holder[key], int | float):
        holder[key] *= rng.choice((-1, 1e-6, 1e3, 1e6, 1e30, 1e300))
    elif change < 0.93 and isinstance(holder, list):
        holder.insert(rng.randrange(len(holder) + 1), copy.deepcopy(holder[key]))
    elif isinstance(holder, dict):
        holder[rng.choice((str(key) + "x", "", "\0", "x" * 2000))] = holder.pop(key)
    else:
        holder[key] = [holder[key]] * rng.choice((0, 2, 5))
    return content
