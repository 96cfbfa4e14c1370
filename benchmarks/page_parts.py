"""Records as write_docs.py reads them, and paragraphs and tables of the page that it writes."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from measuring import Interval

WIDTH = 130  # of lines of text, in characters

PLACES = {
    "scan": "the room seen outward",
    "room-scan": "the room seen outward",
    "room-inward": "the room seen inward",
    "room-mixed": "the room seen both ways",
}
"""Captures that scripts write, by their names in records."""


class Records:
    """The records of a folder, read when they are requested."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __getitem__(self, name: str) -> Any:
        """What NAME_cpu.json holds."""
        return json.loads((self._folder / f"{name}_cpu.json").read_text())

    def source(self, name: str, today: str = "") -> str:
        """Command, link, machine and day of a record; `today` says what the command now needs."""
        machine = self[name]["machine"]
        command = re.sub(r" --(output|picture) \S+", "", machine["command"])
        cpu = machine["cpu"].replace("(R)", "").removesuffix(" Processor")
        link = f"[record](../benchmarks/results/{name}_cpu.json)"
        return f"`{command}`{today} ({link}, {cpu}, {machine['date'][:10]})"


def text(words: str, *sources: str) -> str:
    """A paragraph, in lines of one width, and below it where its figures come from."""
    words = " ".join(words.split())
    lines = textwrap.wrap(words, WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join([*lines, *(f"{source}." for source in sources)])


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table in Markdown."""
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def below(*parts: str) -> str:
    """Paragraphs and tables, one below the other."""
    return "\n\n".join(parts)


def place(scene: str) -> str:
    """A scene as the page calls it: without the size that the name of its folder ends in."""
    name = re.sub(r"(_q|_llff|_colmap|_?\d+)$", "", scene)
    return PLACES.get(name, f"`{name}`")


def middle(interval: Interval, digits: int) -> str:
    """The median."""
    return f"{interval['median']:.{digits}f}"


def medians(intervals: Sequence[Interval]) -> str:
    """The least and the greatest median."""
    values = [interval["median"] for interval in intervals]
    return f"{min(values):.2f} to {max(values):.2f}"


def seeds(values: Sequence[float], digits: int) -> str:
    """Mean over seeds, and half of their range."""
    return f"{np.mean(values):.{digits}f} ± {np.ptp(values) / 2:.{digits}f}"


def of(rows: Iterable[dict[str, Any]], **fields: Any) -> list[dict[str, Any]]:
    """The rows whose fields are these."""
    return [row for row in rows if all(row.get(key) == value for key, value in fields.items())]


def values(rows: Iterable[dict[str, Any]], name: str) -> list[Any]:
    """What a field is in rows, each value once, in their order."""
    return list(dict.fromkeys(row[name] for row in rows))
