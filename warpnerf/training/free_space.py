"""Empty-space skipping: what a training neither samples nor draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpnerf.config import TrainConfig
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import Storage
from warpnerf.model.interface import Model
from warpnerf.model.storage_kinds import parts_of
from warpnerf.rendering.rays import PixelSampler
from warpnerf.rendering.steps import Steps
from warpnerf.rendering.structs import march_struct
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.scene import Scene
from warpnerf.training.plan import TrainingPlan

SETTLED_TRANSMITTANCE = 1e-2
"""Light below which rays end from ``TrainConfig.settle_at`` on. Before that, what lies behind fog
learns from as little light as ``MarchConfig.transmittance_min``."""


def pixel_sampler(scene: Scene, plan: TrainingPlan, workers: Workers) -> PixelSampler:
    """What draws the batches of a training.

    Args:
        scene: What is trained on.
        plan: Of the training.
        workers: Where to work.
    """
    config = plan.config
    return PixelSampler(
        [scene.views[i] for i in scene.splits["train"]],
        np.array(plan.content_distances),
        None if plan.random_background else plan.background,
        config.rays_per_step,
        config.march.jitter,
        config.seed,
        workers,
    )


class EmptySpace:
    """What a training neither samples nor draws: free cells, pixels that see nothing, and, once
    surfaces stand where they will stay, what lies behind them."""

    def __init__(
        self, config: TrainConfig, sampler: PixelSampler, free: FreeCells, workers: Workers
    ) -> None:
        """Free cells as they are known, all pixels, and nothing settled.

        Args:
            config: Of the training.
            sampler: Draws its batches.
            free: Of the first lattice, or of that of a training to be resumed.
            workers: Where to work.
        """
        self._config = config
        self._sampler = sampler
        self._workers = workers
        self.free = free
        """Which cells hold nothing that could be seen."""
        self.occupied = free.share()
        """The share of the others."""
        self.seen = 1.0
        """Share of the pixels that are drawn from, (0, 1]."""
        self._settled = False

    def settles(self, fraction: float) -> bool:
        """Whether surfaces stand where they will stay from now on, and did not before.

        Args:
            fraction: Of the training, that is done.
        """
        at = self._config.settle_at
        if self._settled or at is None or fraction < at:
            return False
        self._settled = True
        return True

    def shortened(self, steps: Steps) -> Steps:
        """How rays are marched: they end earlier once what lies behind surfaces learns no more.

        Args:
            steps: How they are marched before that.
        """
        if not self._settled:
            return steps
        return replace(steps, transmittance_min=max(steps.transmittance_min, SETTLED_TRANSMITTANCE))

    def look(self, storage: Storage, steps: Steps) -> None:
        """Compute the occupancy grid: which cells need not be sampled.

        Until surfaces stand, the nodes around a cell count as well, so that they can grow into it.

        Args:
            storage: What the field is stored in.
            steps: How rays are marched through it.
        """
        config = self._config
        assert isinstance(config.model, Model)
        march = march_struct(config.model, "float32", steps, self._workers)
        sampler = parts_of(config.model, "float32", config.field).sampler
        margin = 0 if self._settled else 1
        self.free = FreeCells.of(storage, self._workers, march, config.alpha_min, sampler, margin)
        self.occupied = self.free.share()

    def cull_background(self, lattice: Lattice) -> None:
        """Draw no pixels whose rays meet free space only. In contracted space all see something.

        A single cell tells nothing: it is what there is before the first look, too.

        Args:
            lattice: The nodes as they stand, whose free cells these are.
        """
        looked = self.free.size != (1, 1, 1)
        culls = looked and self._config.skip_empty_rays and lattice.kind.bounded
        self.seen = self._sampler.cull_background(lattice, self.free) if culls else 1.0


def occupied_box(lattice: Lattice, free: FreeCells) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around what is occupied, [3] each; never larger than before.

    Args:
        lattice: Not in contracted space.
        free: What of it is not occupied.
    """
    box_min, box_max = lattice.box_min, lattice.box_max
    occupied = free.occupied_range()
    if occupied is None:
        return box_min, box_max
    edges = box_max - box_min
    return box_min + occupied[0] * edges, box_min + occupied[1] * edges
