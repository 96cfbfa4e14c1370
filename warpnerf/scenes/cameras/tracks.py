"""Points of structure from motion, and which photograph shows which: their tracks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """Points that were matched in photographs."""

    positions: np.ndarray
    """[n, 3] float64, scene units."""
    shown: Mapping[str, np.ndarray]
    """Indices of the points that a photograph shows, by the name of its view."""

    def of(self, name: str) -> np.ndarray:
        """Indices of the points that a view's photograph shows, [k]; one may be matched twice."""
        return self.shown.get(name, np.empty(0, np.int64))

    def counts(self, names: Iterable[str]) -> np.ndarray:
        """How many of some views' photographs show each point, [n] int."""
        counts = np.zeros(len(self.positions), int)
        for name in names:
            counts[self.of(name)] += 1  # once, however often it is matched
        return counts

    def moved(self, by: np.ndarray) -> Tracks:
        """The same points, moved by [3] scene units."""
        return replace(self, positions=self.positions + by)
