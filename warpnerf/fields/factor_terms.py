"""What regularises factors: total variation of planes, and sparsity of what density is made of."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp
from warpnerf_kernels.base import tiles
from warpnerf_kernels.base.types import vec3, vector
from warpnerf_kernels.optim import factor_terms

from warpnerf.fields.gradients import Gradients
from warpnerf.fields.total_variation import thread_spans
from warpnerf.runtime.parallel import NODES, Workers


@dataclass(frozen=True, kw_only=True, eq=False)
class FactorTerms:
    """Adds the gradient of both, at the entries that have one already.

    A pair of a plane's entries stands for as many pairs of a dense grid's nodes as its line has
    nodes. So many times does its variation count, and else as a dense grid's.
    """

    planes: wp.array
    """[n_entries] vectors."""
    lines: wp.array
    """[n_lines * width]"""
    size: tuple[int, int, int]
    """X, Y, Z of the lattice."""
    variation: np.ndarray
    """[width] weights of total variation."""
    n_sparse: int
    """The first numbers of an entry, which are to be sparse."""
    sparsity: float
    """Weight of the sum of their mean magnitudes on each plane and each line."""
    n_asked: int
    """Nodes of the lattice that the weights are meant for: the final one, or about so."""
    every: int
    """How many updates this one gradient stands for: it is added to the first of so many."""
    until: float
    """Share of the training from which it is added no more."""
    workers: Workers
    """Where to work."""

    def __call__(self, gradients: Gradients, update: int, fraction: float, n_steps: int) -> None:
        """Add it, where it is due; see ``storage.Regulariser``."""
        if update % self.every != 0 or fraction >= self.until:
            return
        x, y, z = self.size
        width = len(self.variation)
        face = (self.n_asked / math.prod(self.size)) ** (2.0 / 3.0)
        factor = self.every * math.sqrt(n_steps)
        sparse = np.zeros(width)
        sparse[: self.n_sparse] = factor * self.sparsity / self.n_sparse
        Entry = vector(width)
        self.workers.launch(
            factor_terms.plane_terms_kernel(width),
            *thread_spans(self.planes, self.workers),
            self.planes,
            wp.vec3i(x, y, z),
            Entry(*(factor * face * self.variation)),
            vec3(z, y, x),
            Entry(*sparse),
            vec3(1.0 / (x * y), 1.0 / (x * z), 1.0 / (y * z)),
            gradients.entries("planes", "touched"),
            at_once=NODES // tiles.NODES_PER_THREAD,
            cache=gradients.launches,
        )
        if self.sparsity > 0.0:
            begin = 0
            for n in (z, y, x):
                part = slice(begin * width, (begin + n) * width)
                begin += n
                self.workers.launch(
                    factor_terms.line_terms,
                    n * width,
                    self.lines[part],
                    *(width, self.n_sparse, float(sparse[0]) / n),
                    gradients.arrays["lines"][:, part],
                )
