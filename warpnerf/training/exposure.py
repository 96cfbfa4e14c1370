"""Exposures of photographs: what each does to the field's colours, fitted while that learns them.

Photographs of one scene differ in exposure and white balance where a camera chooses both for each.
A field that all of them train then has to be all of these at once: it makes up for them with fog
near the cameras, which each camera sees alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vec3
from warpnerf_kernels.optim import exposure as kernels

from warpnerf.checks import InputError
from warpnerf.fields.gradients import Gradients
from warpnerf.fields.parameters import Parameter
from warpnerf.rendering.rays import RayBatch
from warpnerf.runtime.parallel import RAYS, LaunchCache, Workers

BEGIN = 0.05
"""Share of the training before the first fit: a field that shows nothing yet has the mean colour of
each photograph explained by its exposure."""
JUDGED = 0.08
"""Share of the training after which auto judges whether photographs differ."""
DIFFERENT = 0.03
"""Deviation of the logarithm of their brightness from which they do."""
WINDOW = 4000.0
"""Rays of a photograph, after which the weight of those before has fallen to 1/e."""
PRIOR = 50.0
"""Rays, of colours that are uniform and the same in photograph and field, which each photograph has
besides its own."""
NUMBERS = 3 * kernels.MOMENTS
"""Sums of a photograph."""
STATE = "exposures"
"""The name of what checkpoints keep."""


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """What a photograph does to the field's colours: pixel = gain colour + offset."""

    gain: tuple[float, float, float]
    """Of red, green and blue, above 0; the geometric mean over photographs is 1."""
    offset: tuple[float, float, float]
    """Of the same, of colours in [0, 1]; the mean over photographs is 0."""


class Exposures:
    """Exposures of the photographs of a training, and the sums that they are fitted to."""

    def __init__(
        self,
        n_views: int,
        workers: Workers,
        applied: bool = True,
        state: dict[str, wp.array] | None = None,
    ) -> None:
        """Those that change nothing, or those of a training to be resumed.

        Args:
            n_views: Photographs.
            workers: Where to work.
            applied: Whether they are used from the first fit on; else ``settled`` judges it.
            state: Of that training.

        Raises:
            InputError: It is not of so many photographs.
        """
        device = workers.device
        self._workers = workers
        self._in_turn = workers if device.is_cuda else Workers("cpu", 1)
        self._launches = LaunchCache()
        self.gains = wp.ones(n_views, dtype=vec3, device=device)
        """[n_views] vec3, by which photographs are drawn."""
        self.offsets = wp.zeros(n_views, dtype=vec3, device=device)
        """[n_views] vec3, likewise."""
        self._on_trial = wp.clone(self.gains), wp.clone(self.offsets)
        self._moments = wp.zeros((1, n_views * NUMBERS), device=device)
        self.applied = applied
        """Whether photographs are drawn by what was fitted."""
        self.sums = wp.zeros(n_views * NUMBERS, device=device)
        """[n_views * 3 * 5], see ``warpnerf_kernels.optim.exposure``."""
        if state is not None:
            self.sums, self.applied = state["sums"], bool(state["applied"].numpy()[0])
            if self.sums.size != n_views * NUMBERS:
                raise InputError(
                    f"the training to be resumed has exposures of {self.sums.size // NUMBERS} "
                    f"photographs, but the scene has {n_views}; bring its photographs back, or "
                    "start a new training."
                )
            self.fit(0)

    def add(self, batch: RayBatch, rgb: wp.array, fraction: float) -> None:
        """Take rays of a batch in, those of opaque pixels that are neither black nor white.

        Args:
            batch: As it was drawn.
            rgb: [n_rays] vec3, what was rendered.
            fraction: Of the training, that is done; before BEGIN nothing is taken in.
        """
        if fraction < BEGIN:
            return
        self._in_turn.launch(
            kernels.add_moments,
            batch.count,
            *(batch.views, rgb, batch.target_rgb, self.gains, self.offsets, self._moments),
            at_once=RAYS,
            cache=self._launches,
        )

    def settled(self, fraction: float) -> Exposures | None:
        """From JUDGED on, those that differ so much that they are used, or None.

        Args:
            fraction: Of the training, that is done.
        """
        if self.applied or fraction < JUDGED:
            return self
        gains, offsets = (array.numpy() for array in self._on_trial)
        if float(np.log(brightness(gains, offsets)).std()) < DIFFERENT:
            return None
        self.applied = True
        return self

    @cached_property
    def accumulated(self) -> tuple[Gradients, Parameter]:
        """What was taken in since the last fit, as several processes add it up."""
        gradients = Gradients(arrays={"weights": self._moments}, struct=None)
        parameter = Parameter(
            name=STATE,
            values=self.sums,
            rule="weights",
            learning_rates=np.zeros(1),
            gradient=("weights",),
        )
        return gradients, parameter

    def fit(self, n_rays: int) -> None:
        """Fit the exposures to what was taken in.

        Args:
            n_rays: Drawn since the last time, of all photographs.
        """
        found = (self.gains, self.offsets) if self.applied else self._on_trial
        n_views = len(self.gains)
        kept = math.exp(-n_rays / (n_views * WINDOW))
        given = kept, PRIOR, self._moments, self.sums
        self._workers.launch(kernels.fit_exposures, n_views, *given, *found)
        self._workers.launch(kernels.centre_exposures, 3, *found)

    @property
    def state(self) -> dict[str, dict[str, wp.array]]:
        """What a checkpoint keeps: live arrays."""
        applied = wp.array([float(self.applied)], dtype=wp.float32, device=self.sums.device)
        return {STATE: {"sums": self.sums, "applied": applied}}

    def in_words(self, names: Sequence[str]) -> str:
        """How far they differ.

        Args:
            names: Of the photographs.
        """
        grey = brightness(self.gains.numpy(), self.offsets.numpy())
        low, high = int(grey.argmin()), int(grey.argmax())
        return (
            f"exposures of photographs differ: where the scene is grey, {names[low]} is "
            f"{grey[low]:.2f} times as bright, {names[high]} {grey[high]:.2f} times"
        )

    def by_name(self, names: Sequence[str]) -> dict[str, Exposure]:
        """The exposures as they stand.

        Args:
            names: Of the photographs.
        """
        pairs = zip(self.gains.numpy().tolist(), self.offsets.numpy().tolist(), strict=True)
        found = (Exposure(gain=tuple(gain), offset=tuple(offset)) for gain, offset in pairs)
        return dict(zip(names, found, strict=True))


def brightness(gains: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """How much brighter each photograph is where the field is half grey, [n_views].

    Args:
        gains: [n_views, 3].
        offsets: [n_views, 3].
    """
    return np.maximum((gains + 2.0 * offsets).mean(axis=1), 1e-3)
