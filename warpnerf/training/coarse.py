"""Estimation of a scene's extent before its training, by a short one if need be.

Not every capture brings points, and cameras tell little: what they look at is nearer than most of
what they see, and where they look outward, or in parallel directions, there is no such thing. There
most photographs tell it by a plane sweep (``warpnerf.scenes.extent.swept``). Others are trained on
for a moment, in a box that may be several times too small, with all space around it contracted.
What half of the light of a ray has met is a point of the scene; what points tell, these tell
(``warpnerf.scenes.extent.points.observed_extent``).

Where cameras look at a common point, the box stays around that: what lies behind it is seen, too,
but is not what the box is for. Elsewhere the box is found as well, and a second round begins with
the box and the distance of the first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.config import MIN_COARSE_STEPS, GridConfig, TrainConfig
from warpnerf.fields.dense import DenseGrid
from warpnerf.fields.nodes import points_of
from warpnerf.model.sampler_kinds import MARCHED
from warpnerf.model.storage_kinds import DENSE
from warpnerf.rendering.field import Field
from warpnerf.rendering.rays import camera_rays
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.extent.points import ObservedExtent, observed_extent
from warpnerf.scenes.extent.swept import OUTSIDE, extent_by_sweep
from warpnerf.scenes.scene import Scene, View
from warpnerf.training.growth import require_room
from warpnerf.training.peers import ALONE, Peers
from warpnerf.training.plan import TrainingPlan, coarse_steps, resolve
from warpnerf.training.state import Progress, TrainingState
from warpnerf.training.trainer import Trainer

ROUNDS = 2
"""Where cameras look at no common point; elsewhere one."""
VOXELS = 48**3
TIME_SHARE = 0.12
EARLY = 0.25
"""Losses weigh as after this share of a training."""
"""Of a training's time limit, that all rounds together take at most."""

QUICK_BORDER, QUICK_GROWTH = 0.2, 0.1
"""Of the grid of a short training, and of its steps outside its box: as quick as they can be."""

RAYS = 128
"""Of each camera, at most."""
DISTANCES = 32
"""At which opacity is looked at, from NEAREST to FARTHEST."""
NEAREST, FARTHEST = 0.005, 64.0
"""In longest edges of the box."""
EMPTY = -200.0
"""Raw density so low that a few hundred updates do not raise it to anything visible."""

NOTHING_SEEN = (
    "a short training met too little that is opaque, or had too little time: content distance and "
    "box stay what the cameras suggest"
)


def prepare_trainer(
    scene: Scene,
    config: TrainConfig | TrainingPlan,
    resume: TrainingState | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    peers: Peers = ALONE,
) -> Trainer:
    """Prepare a trainer, its scene's extent estimated first where its plan says so.

    Args:
        scene: What is trained on.
        config: How; a plan where that is resolved already.
        resume: Where to resume; what was found then is used again.
        on_progress: Called while the extent is looked for, with the share of that.
        peers: The processes that train.

    Raises:
        InputError: As for ``Trainer``, and for ``extent_by_training``.
    """
    if resume is not None:
        return Trainer(scene, config, resume, peers=peers)
    plan = config if isinstance(config, TrainingPlan) else resolve(scene, config)
    if not plan.looks_first:
        return Trainer(scene, plan, peers=peers)
    config = plan.config
    require_room(plan, Workers(config.device, config.threads).device)
    observed, seconds = None, 0.0
    if scene.unbounded and scene.guessed:  # in a box that is about right a training tells it better
        observed = peers.from_first(lambda: extent_by_sweep(scene))
    if observed is None:
        observed, seconds = extent_by_training(scene, plan, on_progress, peers)
    if observed is None:
        scene = replace(scene, notes=(*scene.notes, NOTHING_SEEN))
    return Trainer(scene, config, observed=observed, seconds=seconds, peers=peers)


def extent_by_training(
    scene: Scene,
    plan: TrainingPlan,
    on_progress: Callable[[Progress], None] | None = None,
    peers: Peers = ALONE,
) -> tuple[ObservedExtent | None, float]:
    """Estimate a scene's extent, what its cameras see, by short trainings.

    Args:
        scene: Its box and content distance are where the first one begins.
        plan: Of the training that it is for.
        on_progress: Called with each report of these, its fraction that of all of them.
        peers: The processes that train.

    Returns:
        What they see, None where too few see anything opaque; seconds of training, to which
        compiling and looking at depths do not count.

    Raises:
        InputError: No ray has met anything opaque after all steps, and no content distance is
            given.
    """
    config, space = plan.config, plan.space.kind
    limit, given = config.time_limit, config.content_distance
    rounds = ROUNDS if scene.guessed else 1
    contracted = not space.bounded
    small = replace(
        config,
        steps=coarse_steps(config),
        time_limit=None if limit is None else TIME_SHARE * limit / rounds,
        content_distance="auto" if isinstance(given, str) else given,
        scaling="clamped",  # so that trainings with and without have one extent
        grid=replace(
            config.grid,
            voxels=min(VOXELS, config.grid.n_nodes),
            contraction="linf" if space.has_frustum else space.name,
            planes=GridConfig.planes,
            grow_at=(),
            shift_at_growth=0.0,
            box="scene",
            border=QUICK_BORDER if contracted else "auto",
        ),
        march=replace(config.march, growth=QUICK_GROWTH if contracted else "auto"),
        # Without a decay: what is near is not known yet.
        optim=replace(config.optim, restart_at_growth=False, near_decay=0.0),
        appearance="none",
        settle_at=None,
        loss=config.loss.at(EARLY),
        field=DENSE,
        sampler=MARCHED,
    )
    observed, seconds, blind = None, 0.0, False
    for done in range(rounds):

        def report(progress: Progress, done: int = done) -> None:
            if on_progress is not None:
                on_progress(replace(progress, fraction=(done + progress.fraction) / rounds))

        trainer = Trainer(scene, small, observed=observed, peers=peers)
        assert isinstance(trainer.storage, DenseGrid)
        leave_out_near(trainer.storage, scene.training_cameras, config.march.near)
        seconds += trainer.run(report).seconds
        n_steps, field = trainer.steps_done, trainer.field()
        del trainer  # its copy of the photographs, before the next one makes its own
        if n_steps < MIN_COARSE_STEPS:
            break
        points = seen_points(scene, field)
        found = observed_extent(scene.cameras, points, scene.splits["train"], OUTSIDE)
        if found is None:
            blind = n_steps == config.coarse_steps and not any(map(len, points))
            break
        observed = replace(found, found_by="a short training")
        if isinstance(given, str):
            # cameras' own distances are too rough yet for the next round to follow
            small = replace(small, content_distance=found.content_distance)
    if observed is None and blind and isinstance(given, str):
        raise InputError(
            f"{scene.name}: {config.coarse_steps} steps of a short training met nothing opaque, so "
            "photographs and poses show no common surface; look at them with `warpnerf inspect`, "
            "or give a content distance (--content-distance) to train all the same."
        )
    return observed, seconds


def leave_out_near(grid: DenseGrid, cameras: Sequence[Camera], near: float) -> None:
    """Empty for good the nodes that lie nearer than the near plane to a camera: it stood there.

    Source: DirectVoxGO, Sun et al. 2022. The camera itself samples nothing there, others would.

    Args:
        grid: New; its raw densities are changed.
        cameras: The training cameras.
        near: Scene units; 0 leaves out nothing.
    """
    if near <= 0.0:
        return
    points = points_of(grid.lattice, np.indices(grid.lattice.size).reshape(3, -1).T)
    within = np.zeros(len(points), bool)
    for camera in cameras:
        within |= np.square(points - camera.position).sum(axis=1) < near * near
    values = grid.values.numpy()
    values[within, 0] = EMPTY
    grid.values.assign(values)


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
    edge = float((field.lattice.box_max - field.lattice.box_min).max())
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
