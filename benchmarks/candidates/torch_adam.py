"""Adam in eager torch that leaves entries alone whose gradient is exactly zero, as DVGO's does.

Two ways, decided by timing: all rows; or those that may have a gradient, gathered and put back. The
former wins where most nodes are touched. Either goes piece by piece, so that what is in between
stays in the caches: all at once takes twice as long.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch

from candidates.torch_nodes import Table

Way = Literal["all", "rows"]

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-8
PIECE = 1 << 16
"""Numbers that are updated at a time."""


@dataclass(eq=False)
class Moments:
    """Of a table."""

    mean: torch.Tensor
    """[n_nodes, n_values]"""
    square: torch.Tensor


class MaskedAdam:
    """The optimiser of some tables."""

    def __init__(self, tables: list[Table], rate: float) -> None:
        """Of these, with how far an update moves an entry."""
        self._tables = [
            (table, Moments(torch.zeros_like(table.values), torch.zeros_like(table.values)))
            for table in tables
        ]
        self._rate = rate
        self._update = 0
        self.way: Way = "all"

    @torch.no_grad()
    def step(self) -> None:
        """Update all tables from their gradients."""
        self._update += 1
        rate = self._rate * math.sqrt(1.0 - BETA2**self._update) / (1.0 - BETA1**self._update)
        for table, moments in self._tables:
            arrays = (table.values, table.gradient, moments.mean, moments.square)
            n_rows = max(1, PIECE // table.values.shape[1])
            if self.way == "all":
                for piece in zip(*(array.split(n_rows) for array in arrays), strict=True):
                    update(*piece, rate)
                continue
            rows = table.touched
            if rows is None:
                rows = table.gradient.any(dim=1).nonzero()[:, 0]
            for at in rows.split(n_rows):
                piece = [array.index_select(0, at) for array in arrays]
                update(*piece, rate)
                for array, part in zip(arrays, piece, strict=True):
                    if array is not table.gradient:
                        array.index_copy_(0, at, part)


def update(
    values: torch.Tensor,  # [n, k] of each array; updated
    gradient: torch.Tensor,
    mean: torch.Tensor,  # updated
    square: torch.Tensor,  # updated
    rate: float,
) -> None:
    """One of some rows."""
    kept = (gradient != 0.0).to(values.dtype)
    mean.addcmul_(kept, gradient - mean, value=1.0 - BETA1)
    square.addcmul_(kept, gradient.square().sub_(square), value=1.0 - BETA2)
    step = square.sqrt().add_(EPSILON)
    values.addcmul_(kept, torch.div(mean, step, out=step), value=-rate)
