"""What the parser says of words that it cannot read, as one sentence like all other refusals."""

from __future__ import annotations

import io
import os
import re
from collections.abc import Callable
from contextlib import redirect_stderr
from typing import TypeVar

from warpnerf.checks import LONGEST, InputError
from warpnerf.scenes.files import printable

Result = TypeVar("Result")

RULE = re.compile(r"^\s*[-\u2500]{8,}\s*$", re.MULTILINE)
"""Between the title of a message, its text, and where help is."""

CHOICE = re.compile(r"invalid choice (.+) for argument '(\S+?)'. Expected one of \((.*)\)\.?")
VALUE = re.compile(r"Missing value for argument '(\S+?)'. Expected (\S+) values?")
SEVERAL = re.compile(r"Could not parse arguments \[(.*)\] into")
PARSED = re.compile(r"Error parsing (\S+?)(?: \(.*?\))?: (.*)")


WIDE = 10_000
"""Columns in which the parser breaks no line of a message."""


def read_words(read: Callable[[], Result], name: str | None, shows_help: bool) -> Result:
    """Read the words of a command line.

    Args:
        read: Reads them by tyro, which prints what is wrong in a box and exits.
        name: Of the subcommand; None: there is none.
        shows_help: Whether help is requested, which is laid out for the terminal.

    Returns:
        What ``read`` returns.

    Raises:
        InputError: Words cannot be read.
    """
    told, columns = io.StringIO(), os.environ.get("COLUMNS")
    if not shows_help:
        os.environ["COLUMNS"] = str(WIDE)
    try:
        with redirect_stderr(told):
            return read()
    except SystemExit as stop:
        if not stop.code or not told.getvalue().strip():
            raise
        raise InputError(sentence(told.getvalue(), name)) from None
    finally:
        if columns is not None:
            os.environ["COLUMNS"] = columns
        else:
            os.environ.pop("COLUMNS", None)


def sentence(box: str, name: str | None) -> str:
    """One sentence for a box of the parser's.

    Args:
        box: Title, rule, text, rule, and where help is.
        name: Of the subcommand; None: there is none.
    """
    parts = RULE.split(re.sub(r"[\u2502\u256d\u256e\u2570\u256f]", " ", box))
    title, body = parts[0].strip(), parts[1] if len(parts) > 1 else ""
    text = " ".join(body.split())
    help_of = f"warpnerf {name} --help" if name else "warpnerf --help"
    if choice := CHOICE.search(text):
        given, flag, choices = choice[1], choice[2], choice[3].replace("'", "").rstrip(", ")
        return f"{flag} must be one of {choices}, not {_short(given)}."
    if value := VALUE.search(text):
        many = "a value" if value[2] in ("1", "one") else f"{value[2]} values"
        return f"{value[1]} needs {many}; {help_of} says which."
    if parsed := PARSED.search(text):
        flag, why = parsed[1], parsed[2].rstrip(".")
        if several := SEVERAL.search(why):
            return f"{flag} must be numbers, not {_short(several[1])}."
        return f"{flag} {_short(why, 300)}." if why.startswith("must ") else f"{flag}: {why}."
    if title.startswith("Missing subcommand"):
        return "no command is given; warpnerf --help lists all."
    if title.startswith("Unrecognized"):
        words = _short(text.partition(": ")[2])
        if name is None:
            return f"the first word must be a command, not {words}; warpnerf --help lists all."
        return f"{name} does not take the word {words}; {help_of} lists what it takes."
    if title.startswith("Required"):
        wanted = re.findall(r"^ {6}(\S.*?)\s*$", body, re.MULTILINE)
        return f"{name} needs {' and '.join(wanted) or 'more words'}; {help_of} says what that is."
    return f"{_short(text.rstrip('.'), 300)}; {help_of} lists all options."


def _short(text: str, most: int = LONGEST) -> str:
    text = printable(text)
    return text if len(text) <= most else f"{text[: most - 4]}...{text[-1]}"
