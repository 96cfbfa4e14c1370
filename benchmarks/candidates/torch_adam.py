"""Adam in eager torch that leaves entries alone whose gradient is exactly zero, as DVGO's does.

Two ways, decided by timing: all entries, and what has no gradient put back; or those rows of which
any entry has one, or that are named, gathered and put back. The former wins where most nodes are
touched.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

Way = Literal["all", "rows"]

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-8


@dataclass(eq=False)
class Moments:
    """Of a table of parameters."""

    values: torch.Tensor
    """[n, k], updated."""
    gradient: torch.Tensor
    """[n, k]"""
    mean: torch.Tensor
    square: torch.Tensor


class MaskedAdam:
    """The optimiser of some tables."""

    def __init__(self, tables: list[tuple[torch.Tensor, torch.Tensor]], rate: float) -> None:
        """Values and gradients of each, and how far an update moves an entry."""
        self._tables = [Moments(v, g, torch.zeros_like(v), torch.zeros_like(v)) for v, g in tables]
        self._rate = rate
        self._update = 0
        self.way: Way = "all"

    @torch.no_grad()
    def step(self, rows: torch.Tensor | None = None) -> None:
        """Update all tables from their gradients.

        Args:
            rows: [n] that may have a gradient; None: found by looking.
        """
        self._update += 1
        rate = self._rate * math.sqrt(1.0 - BETA2**self._update) / (1.0 - BETA1**self._update)
        for table in self._tables:
            if self.way == "all":
                self._all(table, rate)
            else:
                at = table.gradient.any(dim=1).nonzero()[:, 0] if rows is None else rows
                self._rows(table, at, rate)

    def _all(self, table: Moments, rate: float) -> None:
        none = table.gradient == 0.0
        kept = 1.0 - none.float()
        table.mean.addcmul_(kept, table.gradient - table.mean, value=1.0 - BETA1)
        difference = table.gradient.square().sub_(table.square)
        table.square.addcmul_(kept, difference, value=1.0 - BETA2)
        step = table.square.sqrt().add_(EPSILON)
        torch.div(table.mean, step, out=step)
        table.values.addcmul_(kept, step, value=-rate)

    def _rows(self, table: Moments, at: torch.Tensor, rate: float) -> None:
        part = Moments(
            *(
                array.index_select(0, at)
                for array in (table.values, table.gradient, table.mean, table.square)
            )
        )
        self._all(part, rate)
        table.values.index_copy_(0, at, part.values)
        table.mean.index_copy_(0, at, part.mean)
        table.square.index_copy_(0, at, part.square)
