"""Training schedule: when the grid grows, gradient accumulation, learning-rate decay."""

from __future__ import annotations

from dataclasses import dataclass

from warpnerf.checks import require_shares
from warpnerf.config import TrainConfig
from warpnerf.optim_config import SceneKind


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """What happens after which share of a training."""

    grow_at: tuple[float, ...]
    """Shares of the training at which the grid grows."""
    accumulate_at: tuple[float, ...]
    """Shares of the training from which an update takes twice as many steps as before."""
    decay: float
    """What is left of the learning rates at the end."""
    restart_at_growth: bool = False
    """Whether the decay continues from the learning rates of the start where the grid grows."""

    def __post_init__(self) -> None:
        """Refuse shares that are none."""
        require_shares("schedule.grow_at", self.grow_at)
        require_shares("schedule.accumulate_at", self.accumulate_at)

    @staticmethod
    def of(config: TrainConfig, kind: SceneKind) -> Schedule:
        """What is configured, auto decided for a kind of scene.

        Args:
            config: How to train.
            kind: object, bounded or unbounded.
        """
        return Schedule(
            grow_at=config.grid.grows_at(kind),
            accumulate_at=config.optim.accumulates_at(kind),
            decay=config.optim.decay,
            restart_at_growth=config.optim.restart_at_growth,
        )

    def growths(self, fraction: float) -> int:
        """How often the grid should have grown."""
        return sum(fraction >= at for at in self.grow_at)

    def steps_an_update(self, fraction: float) -> int:
        """Steps whose losses are accumulated for one update."""
        return 1 << sum(fraction >= at for at in self.accumulate_at)

    @property
    def most_steps_an_update(self) -> int:
        """At the end of the training."""
        return 1 << len(self.accumulate_at)

    def rate(self, fraction: float, grown: int, n_steps: int) -> float:
        """What learning rates are multiplied by.

        Args:
            fraction: Share of the training.
            grown: How often the grid has grown.
            n_steps: Steps of the update.
        """
        begin = self.grow_at[grown - 1] if grown and self.restart_at_growth else 0.0
        return float(self.decay ** max(0.0, fraction - begin) * n_steps**0.25)
