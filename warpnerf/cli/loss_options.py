"""What a training minimises: --loss."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from warpnerf.cli.model_options import values_of
from warpnerf.config import LossConfig


def chosen_losses(begin: LossConfig, options: Sequence[str]) -> LossConfig:
    """The losses that options ask for.

    Args:
        begin: Those of the preset, or of the run that goes on.
        options: What --loss lists, a field and its value each, such as "distortion=0.01".

    Returns:
        `begin` with these values.

    Raises:
        InputError: There is no such field, it is given twice, or a value does not fit.
    """
    return replace(begin, **values_of("--loss", "no option of the loss; it has", begin, options))
