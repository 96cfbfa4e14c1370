"""Errors for bad input, and the checks that raise them where data enters."""

from __future__ import annotations

import errno
import importlib.util
import math
import operator
from collections.abc import Iterable

import numpy as np


class InputError(ValueError):
    """Bad input from outside: a sentence naming the file or field, what is wrong, and the way out.

    The command prints the sentence and exits with 2; Python users can catch it as a ValueError.
    """


def cannot_write(what: str, error: OSError) -> InputError:
    """The error of a file or folder that cannot be written: why, and the way out.

    Args:
        what: The option and the path, as the user gave them.
        error: The system's.
    """
    return InputError(f"{what} cannot be written: {error.strerror or error}; {way_out(error)}.")


def way_out(error: OSError) -> str:
    """What helps against an error of the system, half a sentence."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return "make room there, or name another place"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return "give access to it, or name another place"
    if error.errno in (errno.EEXIST, errno.ELOOP):  # where a folder is to be made
        return "remove the file or the link of that name, or name another place"
    return "check that it exists and may be used"


MAX_COORDINATE = 1e12
"""Scene units; larger numbers are mistakes, and their squares would overflow."""

LONGEST = 60
"""Characters of a value that a sentence quotes."""


def said(value: object) -> str:
    """A value as sentences quote it: its beginning and its last character where it is long, its
    type where it is described in lines, by an address, or not at all."""
    try:
        text = repr(value.item() if isinstance(value, np.generic) else value)
    except Exception:  # a whole number of more digits than Python writes; an object of its own mind
        text = "\n"
    if "\n" in text or " at 0x" in text:
        return f"a value of type {type(value).__name__}"
    if len(text) > LONGEST and text.lstrip("-").isdigit():
        return f"a number of {len(text.lstrip('-'))} digits"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]}...{text[-1]}"


def is_finite(value: object) -> bool:
    """Whether a value is a finite number, or an array of one."""
    try:
        return math.isfinite(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError, RuntimeError):  # no number, or too large a one
        return False


def require_finite(field: str, value: float) -> None:
    """Raise InputError unless value is a finite number."""
    if not is_finite(value):
        raise InputError(f"{field} must be a finite number, not {said(value)}.")


def require_positive(field: str, value: float) -> None:
    """Raise InputError unless value is a finite number above zero; NaN is refused as well."""
    if not (is_finite(value) and value > 0):
        raise InputError(f"{field} must be a finite number above 0, not {said(value)}.")


def require_length(field: str, value: float) -> None:
    """Raise InputError unless value is a length above zero that single precision can square."""
    require_positive(field, value)
    if not 1.0 / MAX_COORDINATE <= value <= MAX_COORDINATE:
        raise InputError(
            f"{field} must lie between {1.0 / MAX_COORDINATE:g} and {MAX_COORDINATE:g} scene "
            f"units, not at {said(value)}."
        )


def require_at_least(field: str, value: float, least: float) -> None:
    """Raise InputError unless value is a finite number of at least `least`."""
    if not (is_finite(value) and value >= least):
        raise InputError(
            f"{field} must be a finite number of at least {least:g}, not {said(value)}."
        )


def require_whole(field: str, value: int, least: int) -> None:
    """Raise InputError unless value is a whole number of at least `least`, below 2^63."""
    try:
        whole = not isinstance(value, bool) and operator.index(value) >= least
    except TypeError:  # no whole number, or an array of another kind or of several
        whole = False
    if not whole:
        raise InputError(f"{field} must be a whole number of at least {least}, not {said(value)}.")
    if value >= 2**63:
        raise InputError(f"{field} must be below 2^63, which is more than any machine counts to.")


def require_one_of(field: str, value: str, choices: Iterable[str]) -> None:
    """Raise InputError unless value is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"{field} must be one of {', '.join(choices)}, not {said(value)}.")


def require_kind(value: object, kind: type, what: str, way_out: str) -> None:
    """Raise InputError unless a value is of a class, such as where the name of a file is given.

    Args:
        value: What was given.
        kind: The class.
        what: The first words of the sentence, such as "train wants a scene".
        way_out: The last ones.
    """
    if not isinstance(value, kind):
        raise InputError(f"{what}, not {said(value)}; {way_out}.")


def require_shares(field: str, shares: tuple[float, ...]) -> None:
    """Raise InputError unless these are shares of the training, one after another."""
    if list(shares) != sorted(shares) or not all(0 < share < 1 for share in shares):
        raise InputError(f"{field} must be shares between 0 and 1 in rising order, not {shares}.")


def require_extra(package: str, extra: str, what: str) -> None:
    """Raise InputError unless an optional package is installed.

    Args:
        package: The name that it is imported by.
        extra: Of warpnerf, that brings it.
        what: Is impossible without it.
    """
    if importlib.util.find_spec(package) is None:
        raise InputError(f'{what} needs {package}: pip install "warpnerf[{extra}]".')


def require_rays(origins: np.ndarray, directions: np.ndarray) -> None:
    """Raise InputError unless both are [n_rays, 3], of finite real numbers, and directions of unit
    length."""
    for name, array in (("origins", origins), ("directions", directions)):
        if array.dtype.kind not in "fiu":
            raise InputError(f"{name} must be real numbers, not {array.dtype}.")
        if array.ndim != 2 or array.shape[1] != 3:
            raise InputError(f"{name} must have shape [n_rays, 3], not {list(array.shape)}.")
        if not np.isfinite(array).all():
            raise InputError(f"{name} must be finite, but hold NaN or infinity.")
    if len(origins) != len(directions):
        raise InputError(
            f"origins and directions must be equally many, not {len(origins)} and "
            f"{len(directions)}."
        )
    length = np.linalg.norm(directions, axis=1)
    bad = np.flatnonzero(np.abs(length - 1.0) > 1e-3)
    if bad.size:
        raise InputError(
            f"directions must be unit vectors, so that t is a distance: {bad.size} of "
            f"{length.size} are not (first: ray {bad[0]}, length {length[bad[0]]:.3g}). "
            "Divide them by their length."
        )
