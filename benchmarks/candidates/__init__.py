"""Ways to do the work that throughput.py compares, one file each, behind one small interface.

The work: march the workload's rays, composite, squared error, adjoint, gradients scaled by
distance, scattered into the grid's gradient, and added to the network's where there is one. It is
over when each of these lies in one array and what it was made with is ready for the next step:
zeroed, if it has to be.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Protocol

import numpy as np
from workload import ModelName, Workload


class Candidate(Protocol):
    """A workload, loaded by one of them for a number of threads; compiled at the latest when
    step() has run twice."""

    def step(self) -> None:
        """Do the work once."""

    def gradient(self) -> np.ndarray:
        """What the last step left, [X, Y, Z, n_values]: of the mean over rays of the squared
        error. Models with a network have `network_gradient` too: [n_parameters]."""

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

MODULES_OF_OTHERS = {
    "warpnerf": "warpnerf_step",
    "torch": "torch_models",
    "torch.compile": "torch_models_compiled",
    "numba": "numba_models",
}
"""The same, of models besides rgb."""

MODULES_OF_DVGO = {"warpnerf": "warpnerf_step", "torch": "torch_models"}
"""The same, of `per_sample` with a network as wide as DVGO's."""

MODULES_OF_FIELDS = {"warpnerf": "warpnerf_step", "torch": "torch_fields"}
"""The same, of fields that are no dense grids; they have `gradients()`, of each array by its
name, in place of `gradient()`."""


def find(
    device: str, model: ModelName = "rgb", field: str = "dense"
) -> tuple[dict[str, Load], dict[str, str]]:
    """What can run a model with a field on a device, and why the others cannot."""
    found: dict[str, Load] = {}
    missing: dict[str, str] = {}
    modules = {"rgb": MODULES, "dvgo": MODULES_OF_DVGO}.get(model, MODULES_OF_OTHERS)
    if field != "dense":
        modules = MODULES_OF_FIELDS
    for name in MODULES:
        module = modules.get(name)
        if module is None:
            missing[name] = "is not written for it"
            continue
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
