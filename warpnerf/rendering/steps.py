"""Ray marching: where along rays samples may sit; needs no Warp before it is passed to kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

MOST_LINEAR = 2**24
"""Equal steps of a ray: float32 counts no more of them one by one."""


@dataclass(frozen=True, kw_only=True)
class Steps:
    """Where along a ray samples may sit: n_linear equal steps from near on, then growing ones."""

    near: float
    """Where the first step begins, scene units."""
    far: float
    """No sample at or beyond it, scene units."""
    step: float
    """Length of the equal steps, scene units."""
    n_linear: int = 0
    """How many there are; with growth only."""
    growth: float = 0.0
    """Each later step is (1 + growth) times the one before; 0: all are equal."""
    transmittance_min: float = 0.0
    """A ray ends where less light than this would pass."""
    in_ndc: bool = False
    """Whether steps are lengths in the coordinates of a grid's frustum, and begin where a ray
    enters it. Near and far are in scene units all the same; the grid's box minds them."""

    def reaching(self, distance: float) -> Steps:
        """With equal steps for a distance at least, scene units, before steps grow.

        So that a camera farther away than those of the training sees the inside of the box in steps
        as short as theirs.
        """
        if self.growth == 0.0:
            return self
        n_linear = min(math.ceil((distance - self.near) / self.step), MOST_LINEAR)
        return replace(self, n_linear=max(self.n_linear, n_linear))

    def most(self, length: float) -> int:
        """How many steps a ray can take, at most.

        Args:
            length: Of its way through the box, in its coordinates; infinite in contracted space.
        """
        if self.in_ndc:
            return int(min(length / self.step, 1e9)) + 4
        linear = self.near + self.n_linear * self.step  # where growing steps begin
        if self.growth == 0.0 or self.far <= linear:
            shortest, in_all = self.step, (self.far - self.near) / self.step
        else:
            shortest = min(self.step, self.growth * linear)
            ratio = float(np.float32(1.0 + self.growth))  # as kernels have it
            in_all = self.n_linear + math.log(self.far / linear) / math.log(ratio)
        # prepare_ray rounds outwards, and adds a step at each end.
        return int(min(in_all, length / shortest, 1e9)) + 4

    def struct(self, sampling: ModuleType | None = None) -> Any:
        """The steps as kernels take them.

        Args:
            sampling: ``warpnerf_kernels.sampling.steps`` in the precision that is wanted; None:
                float32.
        """
        if sampling is None:  # loaded here, as plans know steps without Warp
            sampling = import_module("warpnerf_kernels.sampling.steps")
        march = sampling.March()
        march.near = 0.0 if self.in_ndc else self.near
        march.far = 1e30 if self.in_ndc else self.far
        march.step = self.step
        march.growth = self.growth
        march.n_linear = self.n_linear
        march.transmittance_min = self.transmittance_min
        return march


@dataclass(frozen=True, kw_only=True, eq=False)
class ClippedSteps:
    """The same steps, of which only those between two distances of each ray are sampled."""

    steps: Steps
    """Of whole rays."""
    ends: Any
    """[n_rays] ``warp.vec2f`` array, the two distances, scene units; a step that reaches over one
    is shortened."""

    @property
    def near(self) -> float:
        """Nothing is sampled nearer, scene units."""
        return self.steps.near

    @property
    def far(self) -> float:
        """Nothing is sampled at or beyond it, scene units."""
        return self.steps.far
