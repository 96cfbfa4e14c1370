"""How far from the cameras content is, and where, from a short training on a small grid.

Not every capture brings points, and cameras tell little: what they look at is nearer than most of
what they see, and where they look outward, or in parallel directions, there is no such thing. So
photographs without points are trained on for a moment, in a box that may be several times too
small, with all space around it folded in. What half of the light of a ray has met is a point of the
scene; what points tell, these tell (``warpnerf.scenes.points.seen_extent``).

Where cameras look at a common point, the box stays around that: what lies behind it is seen, too,
but is not what the box is for. Elsewhere the box is found as well, and a second round begins with
the box and the distance of the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.config import MIN_COARSE_STEPS, TrainConfig
from warpnerf.model.grid import VoxelGrid
from warpnerf.model.nodes import points_of
from warpnerf.rendering.field import Field
from warpnerf.rendering.rays import camera_rays
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.camera import Camera
from warpnerf.scenes.frustum import contraction_of
from warpnerf.scenes.points import SeenExtent, seen_extent
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.extent import require_grid
from warpnerf.training.state import Progress, TrainingState
from warpnerf.training.trainer import Trainer

ROUNDS = 2
"""Where cameras look at no common point; elsewhere one."""
VOXELS = 48**3
STEPS_SHARE = 0.1
"""Of a training's steps, that a round takes at most."""
TIME_SHARE = 0.12
"""The same of its time limit, all rounds together."""

RAYS = 128
"""Of each camera, at most."""
DISTANCES = 32
"""At which opacity is looked at, from NEAREST to FARTHEST."""
NEAREST, FARTHEST = 0.005, 64.0
"""In longest edges of the box."""
OUTSIDE = 0.05
"""Share of what cameras see that may lie outside the box at each face: depths of so short a
training are rougher than matched points are."""

EMPTY = -200.0
"""Raw density so low that a few hundred updates do not raise it to anything visible."""

NOTHING_SEEN = (
    "a short training met too little that is opaque, or had too little time: content distance and "
    "box stay what the cameras suggest"
)


def begin(
    scene: Scene,
    config: TrainConfig,
    resume: TrainingState | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> Trainer:
    """A training before its next update, its extent looked for where need be.

    Args:
        scene: What is trained on.
        config: How.
        resume: Where to go on; what was found then is used again.
        on_progress: Called while the extent is looked for, with the share of that.

    Raises:
        InputError: As for ``Trainer``, and for ``find_sight``.
    """
    sight, seconds = None, 0.0
    if resume is None and is_needed(scene, config):
        require_grid(scene, config, Workers(config.device, config.threads).device)
        sight, seconds = find_sight(scene, config, on_progress)
        if sight is None:
            scene = replace(scene, notes=(*scene.notes, NOTHING_SEEN))
    return Trainer(scene, config, resume, sight=sight, seconds=seconds)


def is_needed(scene: Scene, config: TrainConfig) -> bool:
    """Whether a better extent than the scene's is of use, and training long enough to look for it.

    Args:
        scene: Where it brings points, these tell; cameras of an object with alpha stand around it.
        config: Where it says a content distance, only a box that is a guess is looked for.
    """
    if scene.content_distances is not None or _steps(config) < MIN_COARSE_STEPS:
        return False
    if config.content_distance == "per-camera":
        return True
    if not scene.unbounded:
        return config.content_distance == "auto" and not scene.has_alpha
    folded = config.grid.contraction != "none"
    return folded and (scene.guessed or config.content_distance == "auto")


def find_sight(
    scene: Scene,
    config: TrainConfig,
    on_progress: Callable[[Progress], None] | None = None,
) -> tuple[SeenExtent | None, float]:
    """Find out what the cameras of a scene see, by short trainings.

    Args:
        scene: Its box and content distance are where the first one begins.
        config: Of the training that it is for.
        on_progress: Called with each report of these, its fraction that of all of them.

    Returns:
        What they see, None where too few see anything opaque; seconds of training, to which
        compiling and looking at depths do not count.

    Raises:
        InputError: No ray has met anything opaque after all steps, and no content distance is
            given.
    """
    limit, given = config.time_limit, config.content_distance
    rounds = ROUNDS if scene.guessed else 1
    contraction = contraction_of(scene, config)
    small = replace(
        config,
        steps=_steps(config),
        time_limit=None if limit is None else TIME_SHARE * limit / rounds,
        content_distance="auto" if isinstance(given, str) else given,
        scaling="clamped",  # so that trainings with and without have one extent
        grid=replace(
            config.grid,
            voxels=min(VOXELS, config.grid.voxels),
            contraction="linf" if contraction == "ndc" else contraction,
            grow_at=(),
        ),
    )
    sight, seconds, blind = None, 0.0, False
    for done in range(rounds):

        def report(progress: Progress, done: int = done) -> None:
            if on_progress is not None:
                on_progress(replace(progress, fraction=(done + progress.fraction) / rounds))

        trainer = Trainer(scene, small, sight=sight)
        leave_out_near(trainer.grid, scene.training_cameras, config.march.near)
        seconds += trainer.run(report).seconds
        n_steps, field = trainer.steps_done, trainer.field()
        del trainer  # its copy of the photographs, before the next one makes its own
        if n_steps < MIN_COARSE_STEPS:
            break
        points = seen_points(scene, field)
        found = seen_extent(scene.cameras, points, scene.splits["train"], OUTSIDE)
        if found is None:
            blind = n_steps == config.coarse_steps and not any(map(len, points))
            break
        sight = found
        if isinstance(given, str):
            # cameras' own distances are too rough yet for the next round to follow
            small = replace(small, content_distance=found.content_distance)
    if sight is None and blind and isinstance(given, str):
        raise InputError(
            f"{scene.name}: {config.coarse_steps} steps of a short training met nothing opaque, so "
            "photographs and poses show no common surface; look at them with `warpnerf inspect`, "
            "or give a content distance (--content-distance) to train all the same."
        )
    return sight, seconds


def leave_out_near(grid: VoxelGrid, cameras: Sequence[Camera], near: float) -> None:
    """Empty for good the nodes that lie nearer than the near plane to a camera: it stood there.

    Source: DirectVoxGO, Sun et al. 2022. The camera itself samples nothing there, others would.

    Args:
        grid: New; its raw densities are changed.
        cameras: The training cameras.
        near: Scene units; 0 leaves out nothing.
    """
    if near <= 0.0:
        return
    points = points_of(grid, np.indices(grid.size).reshape(3, -1).T)
    within = np.zeros(len(points), bool)
    for camera in cameras:
        within |= np.square(points - camera.position).sum(axis=1) < near * near
    values = grid.values.numpy()
    values[within, 0] = EMPTY
    grid.values.assign(values)


def _steps(config: TrainConfig) -> int:
    return min(config.coarse_steps, int(STEPS_SHARE * config.steps))


def seen_points(scene: Scene, field: Field) -> list[np.ndarray]:
    """Where rays of each camera of a scene meet something opaque: [n, 3] scene units each."""
    origins, directions, owner = _some_rays(scene.views, field)
    distance = median_distances(field, origins, directions)
    points = origins + distance[:, None] * directions
    return [
        points[(owner == index) & np.isfinite(distance)].astype(np.float64)
        for index in range(len(scene.views))
    ]


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
