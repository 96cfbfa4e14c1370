"""What a training minimises: --loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from warpnerf.cli.given import values_of
from warpnerf.config import LossConfig


def chosen_losses(begin: LossConfig, options: Sequence[str]) -> LossConfig:
    """The losses that options request.

    Args:
        begin: Those of the preset, or of the run that is resumed.
        options: What --loss lists, a field and its value each, such as "distortion=0.03".

    Returns:
        `begin` with these values.

    Raises:
        InputError: There is no such field, it is given twice, or a value does not fit.
    """
    return replace(begin, **loss_values(begin, options))


def loss_values(begin: LossConfig, options: Sequence[str]) -> dict[str, Any]:
    """The values themselves, by field; see ``chosen_losses``."""
    return values_of("--loss", "no option of the loss; it has", begin, options)
