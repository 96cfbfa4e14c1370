"""Where content is and how far from the cameras, from a short training on a small grid.

Cameras that look outward, or in parallel directions, do not tell, and not every capture brings
points. So such scenes are trained for a moment, in a box that may be several times too small, with
all space around it folded in. What half of the light of a ray has met is a point of the scene; what
points tell, these tell (``warpnerf.scenes.points.seen_extent``). A second round begins with the box
and the distance of the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpnerf.config import GridConfig, TrainConfig
from warpnerf.rendering.field import Field
from warpnerf.rendering.rays import camera_rays
from warpnerf.scenes.points import SeenExtent, seen_extent
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.state import TrainingState
from warpnerf.training.trainer import Trainer

ROUNDS = 2
VOXELS = 48**3
MIN_STEPS = 50
"""Of a round; in fewer nothing has grown yet."""
STEPS_SHARE = 0.1
"""Of a training's steps, that a round takes at most."""
TIME_SHARE = 0.06
"""The same of its time limit."""

RAYS = 128
"""Of each camera, at most."""
DISTANCES = 32
"""At which opacity is looked at, from NEAREST to FARTHEST."""
NEAREST, FARTHEST = 0.005, 64.0
"""In longest edges of the box."""
OUTSIDE = 0.05
"""Share of what cameras see that may lie outside the box at each face: depths of so short a
training are rougher than matched points are."""


def begin(scene: Scene, config: TrainConfig, resume: TrainingState | None = None) -> Trainer:
    """A training before its next update, its box and content distance looked for where need be.

    Raises:
        InputError: As for ``Trainer``.
    """
    sight, seconds = None, 0.0
    if resume is None and is_needed(scene, config):
        sight, seconds = find_sight(scene, config)
    return Trainer(scene, config, resume, sight=sight, seconds=seconds)


def is_needed(scene: Scene, config: TrainConfig) -> bool:
    """Whether a scene's extent is a guess, and training long enough to look for a better one."""
    folded = scene.unbounded and config.grid.contraction != "none"
    return scene.guessed and folded and _steps(config) >= MIN_STEPS


def find_sight(scene: Scene, config: TrainConfig) -> tuple[SeenExtent | None, float]:
    """Find out what the cameras of a scene see, by short trainings.

    Args:
        scene: Its box and content distance are where the first one begins.
        config: Of the training that it is for.

    Returns:
        What they see, None where nothing opaque has grown; seconds of training, to which compiling
        and looking at depths do not count.
    """
    limit, given = config.time_limit, config.content_distance
    small = replace(
        config,
        steps=_steps(config),
        time_limit=None if limit is None else TIME_SHARE * limit,
        content_distance="auto" if isinstance(given, str) else given,
        grid=GridConfig(
            voxels=min(VOXELS, config.grid.voxels),
            contraction=config.grid.contraction,
            grow_at=(),
        ),
    )
    sight, seconds = None, 0.0
    for _ in range(ROUNDS):
        trainer = Trainer(scene, small, sight=sight)
        seconds += trainer.run().seconds
        found = sight_of(scene, trainer.field())
        del trainer  # its copy of the photographs, before the next one makes its own
        if found is None:
            break
        sight = found
    return sight, seconds


def _steps(config: TrainConfig) -> int:
    return min(config.coarse_steps, int(STEPS_SHARE * config.steps))


def sight_of(scene: Scene, field: Field) -> SeenExtent | None:
    """What the cameras of a scene see of a field of it; None where too few see anything."""
    origins, directions, owner = _some_rays(scene.views, field)
    distance = median_distances(field, origins, directions)
    points = origins + distance[:, None] * directions
    seen = [
        points[(owner == index) & np.isfinite(distance)].astype(np.float64)
        for index in range(len(scene.views))
    ]
    return seen_extent(scene.cameras, seen, scene.splits["train"], OUTSIDE)


def median_distances(field: Field, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """How far half of the light of rays comes, between the two distances looked at around it.

    Args:
        field: Any.
        origins: [n_rays, 3] scene units.
        directions: [n_rays, 3] unit vectors.

    Returns:
        [n_rays] scene units; NaN where less than half meets anything.
    """
    edge = float((field.grid.box_max - field.grid.box_min).max())
    begin = max(NEAREST * edge, field.steps.near)
    far = np.geomspace(begin, max(2.0 * begin, min(FARTHEST * edge, field.steps.far)), DISTANCES)
    opacity = np.stack(
        [
            replace(field, steps=replace(field.steps, far=float(t)))
            .render_rays(origins, directions)
            .opacity
            for t in far
        ]
    )
    after = (opacity >= 0.5).argmax(axis=0)
    rays = np.arange(len(origins))
    before = np.maximum(after - 1, 0)
    low, high = opacity[before, rays], opacity[after, rays]
    share = np.where(high > low, (0.5 - low) / np.maximum(high - low, 1e-12), 0.0)
    distance = far[before] * (far[after] / far[before]) ** np.clip(share, 0.0, 1.0)
    return np.where(opacity[-1] >= 0.5, distance, np.nan)


def _some_rays(views: Sequence[View], field: Field) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rays spread over the pixels of all views that count: origins, directions, and whose."""
    origins, directions, owners = [], [], []
    for index, view in enumerate(views):
        factor = view.camera.block_for(RAYS)
        coarse = view.camera.downscaled(factor)
        of_camera = [array.numpy() for array in camera_rays(coarse, field.workers)]
        counts = np.ones(coarse.width * coarse.height, bool)
        if view.mask is not None:
            middles = view.mask[factor // 2 :: factor, factor // 2 :: factor]
            counts = middles[: coarse.height, : coarse.width].reshape(-1)
        origins.append(of_camera[0][counts])
        directions.append(of_camera[1][counts])
        owners.append(np.full(int(counts.sum()), index))
    return np.concatenate(origins), np.concatenate(directions), np.concatenate(owners)
