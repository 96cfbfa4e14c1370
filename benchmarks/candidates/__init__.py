"""Ways to do the work that throughput.py compares, one file each, behind one small interface.

The work: march the workload's rays, composite, squared error, adjoint, gradients scaled by
distance, scattered into the grid's gradient. It is over when that gradient lies in one array and
what it was made with is ready for the next step: zeroed, if it has to be.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Protocol

import numpy as np
from workload import Workload


class Candidate(Protocol):
    """A workload, loaded by one of them for a number of threads; compiled at the latest when
    step() has run twice."""

    def step(self) -> None:
        """Do the work once."""

    def gradient(self) -> np.ndarray:
        """What the last step left, [X, Y, Z, 4]: of the mean over rays of the squared error."""

    def rgb(self) -> np.ndarray:
        """The rays' colours, [n_rays, 3]."""


Load = Callable[[Workload, int, str], Candidate]
"""From a workload, a number of threads and a device."""

MODULES = {
    "warpnerf": "warpnerf_step",
    "torch": "torch_eager",
    "torch.compile": "torch_compiled",
    "numba": "numba_cpu",
    "taichi": "taichi_cpu",
    "drjit": "drjit_llvm",
}
"""Modules of this package. Each has `load`, and `obstacle(device)`: why it cannot run, or None."""


def find(device: str) -> tuple[dict[str, Load], dict[str, str]]:
    """What can run on a device, and why the others cannot."""
    found: dict[str, Load] = {}
    missing: dict[str, str] = {}
    for name, module in MODULES.items():
        try:
            candidate = importlib.import_module(f"{__name__}.{module}")
        except ModuleNotFoundError as error:
            missing[name] = f"{error.name} is not installed"
            continue
        obstacle = candidate.obstacle(device)
        if obstacle is None:
            found[name] = candidate.load
        else:
            missing[name] = obstacle
    return found, missing
