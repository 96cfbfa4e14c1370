"""How well a field explains each of the photographs that it is trained on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

LATE = 2.0 / 3.0
"""Share of the training from which on errors count: what has a place in the field has it by then.
A photograph whose pose is wrong is still 5 to 10 dB below the others at the end."""
FEWEST_RAYS = 200
"""Of a photograph, that tell how well it is explained."""


class PhotographErrors:
    """Squared errors of rays that were drawn late in a training, by photograph."""

    def __init__(self, n_views: int) -> None:
        """None yet.

        Args:
            n_views: Training views.
        """
        self._sums = np.zeros(n_views)
        self._counts = np.zeros(n_views, np.int64)

    def add(self, views: np.ndarray, errors: np.ndarray, fraction: float) -> None:
        """Take the rays of a batch in, if they come late enough.

        Args:
            views: [n_rays] whose pixel each is; -1: it is not opaque, and does not count.
            errors: [n_rays] squared, summed over the channels.
            fraction: Of the training, that is done.
        """
        if fraction < LATE:
            return
        counts = views >= 0
        views, n_views = views[counts], len(self._sums)
        self._sums += np.bincount(views, weights=errors[counts], minlength=n_views)
        self._counts += np.bincount(views, minlength=n_views)

    def psnr(self, names: Sequence[str]) -> dict[str, float]:
        """PSNR of each photograph of which enough rays were taken in, dB.

        Args:
            names: Of the training views.
        """
        found = zip(names, self._sums, self._counts, strict=True)
        return {
            name: -10.0 * math.log10(max(total / (3.0 * count), 1e-12))
            for name, total, count in found
            if count >= FEWEST_RAYS
        }
