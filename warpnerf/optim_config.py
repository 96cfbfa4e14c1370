"""How a training is optimised: Adam, its schedule, and regularisation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

from warpnerf.checked import checked
from warpnerf.checks import (
    InputError,
    require_at_least,
    require_positive,
    require_shares,
    require_whole,
    said,
)
from warpnerf.model.interface import Model

SceneKind = Literal["object", "bounded", "unbounded"]
"""Bounded with photographs that have alpha, other bounded ones, and those that are not."""

ACCUMULATE_AT: dict[SceneKind, tuple[float, ...]] = {
    "object": (0.3, 0.4, 0.4, 0.5),
    "bounded": (0.4, 0.5, 0.5, 0.7),
    "unbounded": (0.5, 0.7),
}
"""What ``OptimConfig.accumulate_at`` is by default. Where rays meet fewer samples, as they should
where photographs have alpha, updates take more steps, and earlier."""

OPTIM_RATES = ("learning_rate_density", "learning_rate_rgb")
"""Fields of ``OptimConfig`` that are rates of numbers that a field stores."""

OPTIM_VARIATION = ("tv_density", "tv_rgb", "tv_until", "tv_every")
"""Fields of ``OptimConfig`` that configure total variation."""


def model_rates(model: Model) -> tuple[str, ...]:
    """Fields of a model that are such rates."""
    names = (f.name for f in fields(model))  # type: ignore[arg-type]
    return tuple(n for n in names if n.startswith("learning_rate") and n != "learning_rate_mlp")


@checked("optim")
@dataclass(frozen=True, kw_only=True)
class OptimConfig:
    """The optimiser, Adam: learning rates and their decay, and total variation regularisation."""

    learning_rate_density: float = 0.5
    """How far an update of one step moves raw densities, about, at the start; one of n steps moves
    them n^(1/4) times as far."""
    learning_rate_rgb: float = 0.2
    """The same of raw colours. Models with other features have rates of their own for them."""
    decay: float = 0.07
    """What is left of the learning rates at the end of training."""
    restart_at_growth: bool = False
    """Whether the optimiser restarts where the grid grows, as DVGO's does: without moments, and
    with the learning rates of the start, whose decay continues from there at the same pace."""
    beta1: float = 0.9
    """Decay of the first moment."""
    beta2: float = 0.99
    """Decay of the second moment."""
    epsilon: float = 1e-8
    """Added to the root of the second moment; gradients are of the mean over a step's rays,
    accumulated over an update's steps."""
    tv_density: float = 3e-9
    """Weight of the total variation of raw densities, per pair of neighbouring nodes of the final
    grid; of coarser ones as much more as the face between two nodes is larger."""
    tv_rgb: float = 3e-10
    """The same of raw colours and of all other features."""
    tv_until: float = 1.0
    """Share of the training after which there is no total variation."""
    tv_every: int = 8
    """Updates from one total-variation gradient to the next, which counts that many times."""
    near_decay: float = 0.0
    """Decay of raw densities near cameras: how far each update that moves one lowers it besides, in
    learning rates, times 1 - S. S is the mean of min(1, (d / D)^2) over the pixels of training
    cameras that see its node from a distance d (``fields.near_decay``). 0: none. Dense fields
    only."""
    accumulate_at: Literal["auto"] | tuple[float, ...] = "auto"
    """Shares of the training. Before the first, an update of the grid follows each step; from each
    on, twice as many steps, whose rays are processed together and whose losses are accumulated.
    auto: as suits the kind of scene (``ACCUMULATE_AT``). At most six, as the rays of an update are
    in memory at a time."""

    def __post_init__(self) -> None:
        """Refuse what cannot be optimised with."""
        require_positive("optim.learning_rate_density", self.learning_rate_density)
        require_positive("optim.learning_rate_rgb", self.learning_rate_rgb)
        require_positive("optim.decay", self.decay)
        require_positive("optim.epsilon", self.epsilon)
        require_at_least("optim.tv_density", self.tv_density, 0.0)
        require_at_least("optim.tv_rgb", self.tv_rgb, 0.0)
        require_whole("optim.tv_every", self.tv_every, 1)
        if not 0 <= self.near_decay < 1:
            raise InputError(f"optim.near_decay must lie in [0, 1), not {said(self.near_decay)}.")
        if not 0 <= self.tv_until <= 1:
            raise InputError(f"optim.tv_until must lie in [0, 1], not {said(self.tv_until)}.")
        if isinstance(self.accumulate_at, str):
            if self.accumulate_at != "auto":
                raise InputError(
                    "optim.accumulate_at must be auto or shares between 0 and 1, not "
                    f"{self.accumulate_at!r}."
                )
        else:
            require_shares("optim.accumulate_at", self.accumulate_at)
            if (n := len(self.accumulate_at)) > 6:
                raise InputError(
                    f"optim.accumulate_at must hold at most 6 shares, not {n}: with 6, an update "
                    "takes 64 steps."
                )
        for name in ("beta1", "beta2"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(
                    f"optim.{name} must lie in [0, 1), not {said(getattr(self, name))}."
                )

    def accumulates_at(self, kind: SceneKind) -> tuple[float, ...]:
        """When gradient accumulation doubles: ``accumulate_at``, decided for a kind of scene.

        Args:
            kind: object, bounded or unbounded.

        Returns:
            Shares of the training.
        """
        return ACCUMULATE_AT[kind] if isinstance(self.accumulate_at, str) else self.accumulate_at
