"""What a training that resamples has besides: the proposal, and how that learns."""

from __future__ import annotations

import warp as wp

from warpnerf.fields.gradients import Gradients
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.model.sampler_kinds import Resampled
from warpnerf.optim_config import OptimConfig
from warpnerf.rendering.proposal import Intervals, Proposal, Proposer, unit_of
from warpnerf.rendering.rays import RayBatch
from warpnerf.rendering.steps import Steps
from warpnerf.runtime.parallel import Workers
from warpnerf.training.growth import grown_states
from warpnerf.training.optim import adam_step
from warpnerf.training.plan import TrainingPlan

States = dict[str, dict[str, wp.array]]
"""What the optimiser keeps, by parameter and name."""


def first_proposal(plan: TrainingPlan, device: wp.Device) -> Proposal | None:
    """The proposal before the first update; None where rays are marched.

    Args:
        plan: Of the training.
        device: Where it lies.
    """
    kind = plan.sampler
    if not isinstance(kind, Resampled):
        return None
    unit = unit_of(plan.config.march.near, plan.content_distance)
    return Proposal.first(kind, plan.space, unit, device)


def grown_proposal(
    proposal: Proposal, lattice: Lattice, states: States, optim: OptimConfig, workers: Workers
) -> Proposal:
    """A proposal over the space that a field has grown into, and what the optimiser keeps of it.

    Args:
        proposal: As it stands.
        lattice: Of the grown field.
        states: Of all parameters; those of the proposal are replaced.
        optim: How they are updated.
        workers: Where to work.
    """
    grown = proposal.resized(lattice.space, workers)
    parameters = proposal.parameters(optim)
    states |= grown_states(states, parameters, proposal.grid, grown.grid, workers)
    return grown


def resampling_of(
    n_rays: int, proposal: Proposal | None, steps: Steps, workers: Workers
) -> Resampling | None:
    """``Resampling`` where there is a proposal."""
    return None if proposal is None else Resampling(n_rays, proposal, steps, workers)


class Resampling:
    """Proposes intervals to the batches of a training, and learns from what they weigh."""

    def __init__(self, n_rays: int, proposal: Proposal, steps: Steps, workers: Workers) -> None:
        """Allocate what rays need.

        Args:
            n_rays: Of a batch, at most.
            proposal: Whose values are read, and updated.
            steps: Near, far, and by which cells are free.
            workers: Where to work.
        """
        self._proposal, self._workers = proposal, workers
        self._proposer = Proposer(n_rays, proposal, steps, workers, learns=True)

    @property
    def intervals(self) -> Intervals:
        """Where the samples of a batch lie."""
        return self._proposer.intervals

    @property
    def gradients(self) -> Gradients:
        """Of the proposal, accumulated since the last update."""
        assert self._proposer.gradients is not None
        return self._proposer.gradients

    def propose(self, free: FreeCells, batch: RayBatch, fraction: float) -> None:
        """Draw the intervals of a batch.

        Args:
            free: What of the field is skipped.
            batch: Its rays.
            fraction: Of the training, that is done.
        """
        self._proposer.run(free, batch.struct, self._proposal.kind.anneal(fraction))

    def learn(self, batch: RayBatch, share: float, update: int, fraction: float) -> None:
        """Add the gradient of the bound on what intervals weigh, where it is due.

        Args:
            batch: As it was proposed to, and then weighed.
            share: Of the rays that the mean is taken over, times steps; see ``TrainingPass.run``.
            update: From 0 on.
            fraction: Of the training, that is done.
        """
        if self._proposal.kind.is_due(update, fraction):
            self._proposer.learn(batch.struct, share / batch.count)

    def step(self, states: States, update: int, factor: float, optim: OptimConfig) -> None:
        """Update the proposal by its gradient, which is zeroed; without one nothing changes.

        Args:
            states: Of the optimiser; those of the proposal change.
            update: Counts from 1.
            factor: On the learning rate.
            optim: The rest.
        """
        parameters = self._proposal.parameters(optim)
        adam_step(parameters, states, self.gradients, update, factor, optim, self._workers)
