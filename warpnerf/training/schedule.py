"""When the grid of a training grows, how many steps share an update, and how far that moves."""

from __future__ import annotations

from dataclasses import dataclass

from warpnerf.config import SceneKind, TrainConfig


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """What happens after which share of a training."""

    config: TrainConfig
    """What was asked for."""
    kind: SceneKind
    """Of the scene, by which defaults go."""

    def growths(self, fraction: float) -> int:
        """How often the grid should have grown."""
        return sum(fraction >= at for at in self.config.grid.grows_at(self.kind))

    def steps_an_update(self, fraction: float) -> int:
        """Steps whose losses are added up for one update."""
        return 1 << sum(fraction >= at for at in self.config.optim.accumulates_at(self.kind))

    @property
    def most_steps_an_update(self) -> int:
        """At the end of the training."""
        return 1 << len(self.config.optim.accumulates_at(self.kind))

    def rate(self, fraction: float, grown: int, n_steps: int) -> float:
        """What learning rates are multiplied by.

        Args:
            fraction: Share of the training.
            grown: How often the grid has grown.
            n_steps: Steps of the update.
        """
        optim, begin = self.config.optim, 0.0
        if grown and optim.restart_at_growth:
            begin = self.config.grid.grows_at(self.kind)[grown - 1]
        return float(optim.decay ** (fraction - begin) * n_steps**0.25)
