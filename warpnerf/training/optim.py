"""The optimiser, Adam: a rule for each kind of parameter."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import ClassVar, Protocol, TypeVar

import warp as wp
from warpnerf_kernels.base import tiles
from warpnerf_kernels.base.types import vector
from warpnerf_kernels.optim import adam

from warpnerf.fields.gradients import Gradients
from warpnerf.fields.parameters import Parameter
from warpnerf.fields.storage import Storage
from warpnerf.fields.total_variation import thread_spans
from warpnerf.model import registry
from warpnerf.optim_config import OptimConfig
from warpnerf.runtime.parallel import NODES, Workers


@dataclass(frozen=True)
class Update:
    """An update of all parameters."""

    number: int
    """Counts from 1."""
    factor: float
    """On the learning rates."""
    config: OptimConfig
    """The rest."""
    decays: Mapping[str, wp.array] = field(default_factory=dict)
    """By parameter, as of ``Storage.decays``."""


@cache
def _no_decay(device: str) -> wp.array:
    """In place of decays, for a kernel that reads none."""
    return wp.empty(0, dtype=wp.float32, device=device)


class Rule(Protocol):
    """How a kind of parameter is updated, and what is kept for that."""

    state_names: ClassVar[tuple[str, ...]]
    """What ``state`` holds, and checkpoints after the parameter's name."""

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        """What is kept before the first update: by name, of float32, or uint32 as moments are."""

    @staticmethod
    def resized(
        name: str, state: dict[str, wp.array], storage: Storage, other: Storage, workers: Workers
    ) -> dict[str, wp.array]:
        """The state on another lattice.

        Args:
            name: Of the parameter.
            state: On the first lattice.
            storage: Over the first.
            other: Over the other one, from ``Storage.resized``.
            workers: Where to work.
        """

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: Update,
        workers: Workers,
    ) -> None:
        """Update a parameter and its state; its gradient is zeroed.

        Args:
            parameter: Which one.
            state: Of it.
            gradients: With its own, by the names that it gives.
            update: Which one it is, and how far it moves.
            workers: Where to work.
        """


def adam_struct(update: Update, epsilon: float | None = None) -> adam.Adam:
    """The numbers of an update that are the same for all entries, as kernels take them.

    Args:
        update: Which one.
        epsilon: Of the parameter, if it has one of its own.
    """
    config, numbers = update.config, adam.Adam()
    numbers.beta1, numbers.beta2 = config.beta1, config.beta2
    numbers.epsilon = config.epsilon if epsilon is None else epsilon
    numbers.correction1 = 1.0 / (1.0 - config.beta1**update.number)
    numbers.correction2 = 1.0 / (1.0 - config.beta2**update.number)
    return numbers


class GridAdam:
    """Lazy Adam over the nodes of a grid: where no ray has been, nothing changes."""

    state_names: ClassVar[tuple[str, ...]] = ("moments",)

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        """Running moments before the first update: [n_nodes], see optim.adam."""
        dtype = adam.moments_type(len(parameter.learning_rates))
        return {"moments": wp.zeros(parameter.values.shape[0], dtype=dtype, device=workers.device)}

    @staticmethod
    def resized(
        name: str, state: dict[str, wp.array], storage: Storage, other: Storage, workers: Workers
    ) -> dict[str, wp.array]:
        """Moments are read off those of the first lattice."""
        moments = storage.resized_moments(name, state["moments"], other, workers)
        return {"moments": moments}

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: Update,
        workers: Workers,
    ) -> None:
        """Update nodes from their gradients, which are zeroed."""
        n_floats = len(parameter.learning_rates)
        decay = update.decays.get(parameter.name)
        workers.launch(
            adam.adam_kernel(n_floats, decays=decay is not None),
            *thread_spans(parameter.values, workers),
            update.number,
            vector(n_floats)(*(update.factor * parameter.learning_rates)),
            _no_decay(str(workers.device)) if decay is None else decay,
            adam_struct(update, parameter.epsilon),
            gradients.entries(*parameter.gradient),
            parameter.values,
            state["moments"],
            at_once=NODES // tiles.NODES_PER_THREAD,
            cache=gradients.launches,
        )
        gradients.arrays[parameter.gradient[1]].zero_()


class WeightsAdam:
    """Adam over weights that all rays share."""

    state_names: ClassVar[tuple[str, ...]] = ("mean", "square")

    @staticmethod
    def first_state(parameter: Parameter, workers: Workers) -> dict[str, wp.array]:
        """Running moments before the first update: [n_weights] each."""
        return {name: wp.zeros_like(parameter.values) for name in WeightsAdam.state_names}

    @staticmethod
    def resized(
        name: str, state: dict[str, wp.array], storage: Storage, other: Storage, workers: Workers
    ) -> dict[str, wp.array]:
        """The same: weights do not depend on the lattice."""
        return state

    @staticmethod
    def step(
        parameter: Parameter,
        state: dict[str, wp.array],
        gradients: Gradients,
        update: Update,
        workers: Workers,
    ) -> None:
        """Update weights from the workers' gradients, which are zeroed."""
        workers.launch(
            adam.adam_weights,
            parameter.values.shape[0],
            update.factor * float(parameter.learning_rates[0]),
            adam_struct(update, parameter.epsilon),
            gradients.arrays[parameter.gradient[0]],
            parameter.values,
            state["mean"],
            state["square"],
            cache=gradients.launches,
        )


class LinesRule(WeightsAdam):
    """The same over lines of nodes, which all rays share, but depend on the lattice."""

    @staticmethod
    def resized(
        name: str, state: dict[str, wp.array], storage: Storage, other: Storage, workers: Workers
    ) -> dict[str, wp.array]:
        """Moments are read off those of the first lattice."""
        return {
            key: storage.resized_moments(name, moments, other, workers)
            for key, moments in state.items()
        }


OPTIMISERS: dict[str, type[Rule]] = {"nodes": GridAdam, "weights": WeightsAdam, "lines": LinesRule}
"""By name, which a parameter gives."""

AnyRule = TypeVar("AnyRule", bound=type[Rule])


def register_rule(name: str) -> Callable[[AnyRule], AnyRule]:
    """Make a rule known by its name, to parameters and files; a decorator.

    Args:
        name: Of the rule.

    Raises:
        ValueError: Another rule has that name.
    """

    return lambda rule: registry.add(OPTIMISERS, name, rule, "rule")


def first_states(
    parameters: tuple[Parameter, ...], workers: Workers
) -> dict[str, dict[str, wp.array]]:
    """Initial optimiser state of each parameter, by its name.

    Raises:
        ValueError: A parameter names a rule that there is not.
    """
    rules = {p.name: registry.find(OPTIMISERS, p.rule, "rule") for p in parameters}
    return {p.name: rules[p.name].first_state(p, workers) for p in parameters}


def adam_step(
    parameters: tuple[Parameter, ...],
    states: dict[str, dict[str, wp.array]],
    gradients: Gradients,
    update: int,
    factor: float,
    config: OptimConfig,
    workers: Workers,
    decays: Mapping[str, wp.array] = MappingProxyType({}),
) -> None:
    """Adam over all parameters of a model. Source: Kingma & Ba 2015, algorithm 1.

    Args:
        parameters: Updated; an entry whose gradient is exactly zero is left alone.
        states: Of each, from ``first_states``; updated, too.
        gradients: Of the update's steps; zeroed.
        update: Counts from 1.
        factor: On the learning rates.
        config: The rest.
        workers: Where to work.
        decays: How far it lowers raw densities besides, from ``Storage.decays``.
    """
    this = Update(update, factor, config, decays)
    for parameter in parameters:
        state = states[parameter.name]
        OPTIMISERS[parameter.rule].step(parameter, state, gradients, this, workers)
