"""The proposal of a field that is resampled, as files hold it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.lattice import Lattice
from warpnerf.model.registry import to_json
from warpnerf.model.sampler_kinds import Resampled, SamplerKind
from warpnerf.model.storage_kinds import DENSE
from warpnerf.rendering.proposal import PARAMETER, Proposal
from warpnerf.runs.tensor_file import refuse
from warpnerf.runtime.parallel import Workers


class StoredProposal(msgspec.Struct, frozen=True):
    """What a header says of it; its values are the tensor ``PARAMETER``."""

    sampler: SamplerKind
    size: tuple[int, int, int]
    unit: float
    density_shift: float
    density_scale: float

    def read(
        self, lattice: Lattice, tensors: dict[str, np.ndarray], path: Path, workers: Workers
    ) -> Proposal:
        """The proposal, over the space of its field.

        Args:
            lattice: Of the field.
            tensors: Of the file.
            path: Of the file.
            workers: Where it shall live.

        Raises:
            InputError: Nothing can be drawn from it.
        """
        kind, values = self.sampler, {"values": tensors[PARAMETER]}
        numbers = (self.density_shift, self.density_scale, self.unit)
        says = "it holds a proposal that nothing can be drawn from"
        fits = min(self.size) >= 2 and np.isfinite(numbers).all() and self.unit >= 0.0
        if not (isinstance(kind, Resampled) and fits and np.isfinite(values["values"]).all()):
            refuse(path, says)
        assert isinstance(kind, Resampled)
        over = Lattice.over(lattice.space, self.size)
        try:
            grid = DenseGrid.from_tensors(DENSE, kind.stored, over, values, workers.device)
        except ValueError:
            refuse(path, says)
        grid = replace(grid, density_shift=self.density_shift, density_scale=self.density_scale)
        return Proposal(kind=kind, grid=grid, unit=self.unit)


def proposal_header(proposal: Proposal) -> dict[str, Any]:
    """What ``StoredProposal`` is read from."""
    return {
        "sampler": to_json(proposal.kind),
        "size": list(proposal.grid.lattice.size),
        "unit": proposal.unit,
        "density_shift": proposal.grid.density_shift,
        "density_scale": proposal.grid.density_scale,
    }
