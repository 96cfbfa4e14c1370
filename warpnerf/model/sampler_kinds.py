"""Where samples of rays lie: kinds with a name, and what of them is known without a device.

A kind is a frozen value, as a model is. ``warpnerf.rendering.proposal`` has proposals as they are
on a device.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from warpnerf.checked import checked
from warpnerf.checks import InputError, require_one_of, require_positive, require_whole, said
from warpnerf.model import registry
from warpnerf.model.interface import Load, Model, Rates
from warpnerf.model.storage_kinds import NUMBER_BYTES

PACK = 16
"""Bins come in whole packs."""

MOST = 1024
"""Samples, or bins, of a ray."""


class SamplerKind(ABC):
    """How samples are placed along rays, as it is configured."""

    name: ClassVar[str]
    """What files call it."""
    past: ClassVar[str]
    """What it does to rays, for people: they are ..."""

    @abstractmethod
    def part(self, load: Load, own: Any) -> Any:
        """The part that places them.

        Args:
            load: The kernels' modules, in the precision that is wanted.
            own: The model's sampler.

        Returns:
            ``warpnerf_kernels.base.parts.Sampler``.
        """

    def samples_of(self, marched: float) -> float:
        """What a ray costs in training, in samples, about.

        Args:
            marched: Samples of a ray that is marched.
        """
        return marched

    def training_bytes(self, n_rays: int) -> int:
        """Memory that it takes in training, besides what every march does.

        Args:
            n_rays: Of an update.
        """
        return 0


@dataclass(frozen=True, kw_only=True)
class Marched(SamplerKind):
    """Steps that are the same for all rays: the model's sampler, by ``MarchConfig``."""

    name: ClassVar[str] = "march"
    past: ClassVar[str] = "marched"

    def part(self, load: Load, own: Any) -> Any:
        """The model's own."""
        return own


@dataclass(frozen=True, kw_only=True)
class Clipped(SamplerKind):
    """The model's sampler between two distances of each ray: how parts of rays are rendered."""

    name: ClassVar[str] = "clipped"
    past: ClassVar[str] = "marched in part"

    def part(self, load: Load, own: Any) -> Any:
        """The model's own, cut."""
        return load("sampling.clipped").clipped(own)


@dataclass(frozen=True, kw_only=True)
class AutoSampler(SamplerKind):
    """Proposal sampling or ray marching, as suits the scene: ``TrainConfig.sampler_in``."""

    name: ClassVar[str] = "auto"
    past: ClassVar[str] = "marched or resampled"

    def part(self, load: Load, own: Any) -> Any:
        """None: it has to be decided first."""
        raise TypeError("a sampler that is auto has no kernels; see TrainConfig.sampler_in")


@checked("sampler")
@dataclass(frozen=True, kw_only=True)
class Resampled(SamplerKind):
    """Proposal sampling, as in Mip-NeRF 360: intervals drawn for each ray from the histogram of a
    small density grid."""

    name: ClassVar[str] = "resampled"
    past: ClassVar[str] = "resampled"
    samples: int = 32
    """Intervals per ray, each sampled once."""
    bins: int = 64
    """Bins per ray in which the proposal's density is evaluated; a multiple of 16."""
    voxels: int = 64**3
    """Nodes of the proposal's grid."""
    learning_rate_proposal: float = 0.5
    """Adam's learning rate of the proposal's raw densities, at the start."""
    anneal_until: float = 0.1
    """Share of the training during which the proposal is annealed (flattened less and less)."""
    update_every: int = 5
    """Once annealing is over, the proposal is updated in every so many updates of the field."""

    def __post_init__(self) -> None:
        """Refuse what nothing can be drawn from."""
        require_whole("sampler.samples", self.samples, 2)
        require_whole("sampler.bins", self.bins, PACK)
        if self.bins % PACK or max(self.bins, self.samples) > MOST:
            raise InputError(
                f"sampler.bins must be a multiple of {PACK}, and neither bins nor samples above "
                f"{MOST}, not {said(self.bins)} and {self.samples}."
            )
        require_whole("sampler.voxels", self.voxels, 8)
        require_positive("sampler.learning_rate_proposal", self.learning_rate_proposal)
        if not 0.0 <= self.anneal_until < 1.0:
            raise InputError(
                f"sampler.anneal_until must lie in [0, 1), not {said(self.anneal_until)}."
            )
        require_whole("sampler.update_every", self.update_every, 1)
        registry.keep_plain(self, "sampler")

    @property
    def stored(self) -> ProposedDensity:
        """The storage of the proposal network: a small dense density grid."""
        return ProposedDensity(learning_rate=self.learning_rate_proposal)

    def part(self, load: Load, own: Any) -> Any:
        """The kernels' sampler: intervals of each ray."""
        return load("sampling.resampled").INTERVALS

    def samples_of(self, marched: float) -> float:
        """Samples per ray, by cost: one in each interval, and a quarter of one for a bin."""
        return self.samples + 0.25 * self.bins

    def training_bytes(self, n_rays: int) -> int:
        """Training memory in bytes: the proposal's grid, histograms and intervals of rays."""
        grid = self.voxels * self.stored.n_floats * NUMBER_BYTES
        return grid + n_rays * 4 * (4 * self.bins + 2 * self.samples + 4)

    def anneal(self, fraction: float) -> float:
        """The annealing exponent of proposal weights.

        Source: Barron et al. 2022 (Mip-NeRF 360), eq. 18, with a slope of 10.

        Args:
            fraction: Of the training, that is done, [0, 1].

        Returns:
            The power that weights of bins are raised to, (0, 1].
        """
        if fraction >= self.anneal_until:
            return 1.0
        share = fraction / self.anneal_until
        return max(1e-3, 10.0 * share / (9.0 * share + 1.0))

    def is_due(self, update: int, fraction: float) -> bool:
        """Whether the proposal network is trained in an update.

        Args:
            update: Which one, from 0 on.
            fraction: Of the training, that is done, [0, 1].

        Returns:
            True while it is annealed, and then in one of ``update_every`` updates.
        """
        return fraction < self.anneal_until or update % self.update_every == 0


@dataclass(frozen=True, kw_only=True)
class ProposedDensity(Model):
    """What a proposal holds: raw densities. Nobody renders it, or names it."""

    name: ClassVar[str] = "proposal"
    learning_rate: float = 0.5
    """Of its densities."""

    @property
    def n_features(self) -> int:
        """None."""
        return 0

    @property
    def n_floats(self) -> int:
        """A density, without padding."""
        return 1

    def parts(self, load: Load) -> Any:
        """It has no head; this one stands for that."""
        return load("launch.assembly").Parts(head=load("heads.rgb").rgb())

    def learning_rates(self, optim: Rates) -> np.ndarray:
        """Of its densities."""
        rates = np.zeros(self.n_floats)
        rates[0] = self.learning_rate
        return rates

    def variation(self, optim: Rates) -> np.ndarray:
        """It is not smoothed."""
        return np.zeros(self.n_floats)


MARCHED = Marched()
CLIPPED = Clipped()
AUTO_SAMPLER = AutoSampler()

SAMPLER_KINDS: dict[str, type[SamplerKind]] = {
    AutoSampler.name: AutoSampler,
    Marched.name: Marched,
    Resampled.name: Resampled,
}
"""By name."""


def sampler_of(name: str) -> SamplerKind:
    """The sampler of a name, as it is configured by default.

    Raises:
        InputError: There is none.
    """
    require_one_of("sampler", name, tuple(SAMPLER_KINDS))
    return SAMPLER_KINDS[name]()


def checked_sampler(sampler: object) -> SamplerKind:
    """A sampler, or that of a name.

    Raises:
        InputError: It is none.
    """
    if isinstance(sampler, str):
        return sampler_of(sampler)
    if not isinstance(sampler, SamplerKind):
        raise InputError(f"sampler must be a name or a sampler, not {said(sampler)}.")
    return sampler


def from_json(tree: Any) -> SamplerKind:
    """The kind that ``registry.to_json`` wrote.

    Raises:
        ValueError: It is none that this version knows.
    """
    kind = registry.from_json(SAMPLER_KINDS, tree, "sampler", {})
    assert isinstance(kind, SamplerKind)
    return kind
