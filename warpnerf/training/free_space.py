"""Empty-space skipping: what a training neither samples nor draws."""

from __future__ import annotations

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


def free_cells(config: TrainConfig, storage: Storage, steps: Steps, workers: Workers) -> FreeCells:
    """Compute the occupancy grid: which cells need not be sampled.

    Args:
        config: Of the training.
        storage: What the field is stored in.
        steps: How rays are marched through it.
        workers: Where to work.
    """
    assert isinstance(config.model, Model)
    march = march_struct(config.model, "float32", steps, workers)
    sampler = parts_of(config.model, "float32", config.field).sampler
    return FreeCells.of(storage, workers, march, config.alpha_min, sampler)


def cull_background(
    sampler: PixelSampler, config: TrainConfig, lattice: Lattice, free: FreeCells
) -> float:
    """Cull the background: draw no pixels whose rays meet free space only.

    In contracted space all see something.

    A single cell tells nothing: it is what there is before the first look, too.

    Args:
        sampler: Of the training.
        config: Of the training.
        lattice: The nodes as they stand.
        free: Of this lattice.

    Returns:
        The share of the pixels that are drawn from, (0, 1].
    """
    looked = free.size != (1, 1, 1)
    if looked and config.skip_empty_rays and lattice.kind.bounded:
        return sampler.cull_background(lattice, free)
    return 1.0


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
