"""Empty-space skipping: what a training neither samples nor draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpnerf.config import MarchConfig, TrainConfig
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
from warpnerf.training.state import TrainingState

FIRST_SETTLED = 1000
"""Steps before a training settles: in short ones surfaces do not stand yet."""
SETTLED_TRANSMITTANCE = 1e-2
"""Early ray termination once a training has settled: less light than this is not followed. Before
that, what lies behind fog learns from as little light as ``MarchConfig.transmittance_min``."""


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


def has_settled(state: TrainingState) -> bool:
    """Whether a training to be resumed has settled: rays of its field end earlier than configured.

    Args:
        state: Of that training.
    """
    return state.field.steps.transmittance_min != state.config.march.transmittance_min


class SampledSpace:
    """What a training samples and draws: cells that are not free, pixels that see some, and once it
    has settled, as surfaces then stand where they will stay, rays that end earlier."""

    def __init__(
        self,
        config: TrainConfig,
        sampler: PixelSampler,
        free: FreeCells,
        settled: bool,
        workers: Workers,
    ) -> None:
        """Free cells as they are known, and all pixels.

        Args:
            config: Of the training.
            sampler: Draws its batches.
            free: Of the first lattice, or of that of a training to be resumed.
            settled: Whether the training to be resumed has settled.
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
        self._settled = settled

    def settle(self, fraction: float, steps_done: int) -> bool:
        """Settle, if it is time to.

        Args:
            fraction: Of the training, that is done.
            steps_done: Of its steps.

        Returns:
            Whether it has settled just now.
        """
        at = self._config.settle_at
        if self._settled or at is None or fraction < at or steps_done < FIRST_SETTLED:
            return False
        self._settled = True
        return True

    def terminated(self, steps: Steps) -> Steps:
        """How rays are marched, with early termination as it stands.

        Args:
            steps: As configured. A least transmittance that is not the usual one is left as it is.
        """
        usual = steps.transmittance_min == MarchConfig.transmittance_min
        if not (self._settled and usual):
            return steps
        return replace(steps, transmittance_min=SETTLED_TRANSMITTANCE)

    def update_occupancy(self, storage: Storage, steps: Steps) -> None:
        """Compute the occupancy grid: which cells need not be sampled.

        Until the training has settled, the nodes around a cell count as well, so that surfaces can
        grow into it; always where there may be more between nodes than at them.

        Args:
            storage: What the field is stored in.
            steps: How rays are marched through it.
        """
        config = self._config
        assert isinstance(config.model, Model)
        march = march_struct(config.model, "float32", steps, self._workers)
        sampler = parts_of(config.model, "float32", config.field).sampler
        margin = 0 if self._settled and storage.kind.seen_share == 1.0 else 1
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
