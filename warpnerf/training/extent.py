"""Scene extent of a training: content distances, reach, ray-marching steps. Needs no Warp."""

from __future__ import annotations

import math

import numpy as np

from warpnerf.checks import InputError
from warpnerf.config import MarchConfig, TrainConfig
from warpnerf.rendering.steps import MOST_LINEAR, Steps
from warpnerf.scenes.cameras.focus import find_focus
from warpnerf.scenes.cameras.overlap import views_of_content
from warpnerf.scenes.extent.frustum import FARTHEST
from warpnerf.scenes.extent.space import Space, reach_of_places
from warpnerf.scenes.scene import Scene

FAR_BOXES = 64.0
"""How far an unbounded scene is sampled, in half edges of its box; beyond lies the background."""

MOST_STEPS = 2**16
"""Steps of a ray through the box: more take minutes a batch, and no kernel is stopped midway."""

GROWTH, MOST_GROWTH = 0.02, 0.1
"""By which steps outside a box grow, times its border: a wider shell has shorter voxels; and at
most."""

FEW_VIEWS = 7.0
"""Cameras that see the same content, up to which auto scales all the way to its distance."""
LEAST_SHARE, LEAST_SHARE_AROUND = 0.5, 0.7
"""Least share of that distance, however many cameras see the same: where they look at no common
point, and where they do."""


def content_distances(scene: Scene, config: TrainConfig) -> tuple[float, list[float]]:
    """The content distance of the scene, and those of its training views.

    With auto, a camera's is the geometric mean of the scene's and of its own where that is known: a
    camera close to a wall shall draw the wall, but in a scene of few photographs a camera's own is
    the distance of its floaters as often as not. Where many cameras see the same, it is less, down
    to LEAST_SHARE or LEAST_SHARE_AROUND: they contradict a floater before one of them, and scaling
    would only slow down what the nearer of them draw.

    Raises:
        InputError: It is per-camera, and the scene has none.
    """
    chosen, train = config.content_distance, scene.splits["train"]
    if chosen == "per-camera":
        if scene.content_distances is None and not config.coarse_steps:
            raise InputError(
                f"content_distance is per-camera, but {scene.name} brings no points, and with "
                "coarse_steps 0, as DVGO's presets have it, none are looked for; use auto, or a "
                "number."
            )
        if scene.content_distances is None:
            raise InputError(
                f"content_distance is per-camera, but {scene.name} brings no points, and no short "
                "training has found what each camera sees: that takes 500 steps or more, time for "
                "them, and photographs that show something opaque; use auto, or a number."
            )
        return scene.content_distance, [float(scene.content_distances[i]) for i in train]
    if chosen == "auto" and scene.content_distances is not None:
        one, each = scene.content_distance, scene.content_distances[list(train)]
        cameras = scene.training_cameras
        least = LEAST_SHARE if find_focus(cameras).guessed else LEAST_SHARE_AROUND
        share = min(1.0, max(least, FEW_VIEWS / views_of_content(cameras, each)))
        return one, [share * math.sqrt(one * float(own)) for own in each]
    one = scene.content_distance if chosen == "auto" else float(chosen)
    return one, [one] * len(train)


def require_samples(scene: Scene, space: Space, march: MarchConfig) -> None:
    """Raise InputError where march.near and march.far leave no sample inside the box to any ray.

    Args:
        scene: Whose training cameras are asked about.
        space: That the grid fills.
        march: How rays are stepped.
    """
    low, high = _box_in_scene(scene, space)
    positions = np.array([camera.position for camera in scene.training_cameras])
    outside = np.maximum(0.0, np.maximum(low - positions, positions - high))
    across = np.maximum(np.abs(low - positions), np.abs(high - positions))
    begin = float(np.linalg.norm(outside, axis=1).min())
    end = float(np.linalg.norm(across, axis=1).max())
    what = "box"
    if space.frustum is not None:
        depths, what = space.frustum.depths(positions), "frustum"
        begin = space.frustum.near - float(depths.max())
        end = FARTHEST * space.frustum.near - float(depths.min())
    elif space.kind.contracts:
        begin = 0.0  # space outside the box is sampled too
    if march.near >= end:
        raise InputError(
            f"march.near is {march.near:g}, but the scene's {what} ends {end:.4g} scene units from "
            "the farthest camera, so nothing of it would be sampled; use a smaller --near."
        )
    if march.far is not None and march.far <= begin:
        raise InputError(
            f"march.far is {march.far:g}, but the scene's {what} begins {begin:.4g} scene units "
            "from the nearest camera, so nothing of it would be sampled; use a larger one."
        )


def reach(scene: Scene, space: Space) -> float:
    """Distance from the outermost training camera to the farthest corner of the box."""
    places = np.array([scene.views[i].camera.position for i in scene.splits["train"]])
    return reach_of_places(*_box_in_scene(scene, space), places)


def _box_in_scene(scene: Scene, space: Space) -> tuple[np.ndarray, np.ndarray]:
    """The box of a space; where that is a frustum's, the scene's."""
    if space.frustum is not None:
        return scene.box_min, scene.box_max
    return space.box_min, space.box_max


def march_steps(
    march: MarchConfig, space: Space, size: tuple[int, int, int], reach: float
) -> Steps:
    """How rays are marched through a grid.

    Args:
        march: What is configured.
        space: That the grid fills.
        size: Its nodes along each axis.
        reach: See there, scene units: how far steps have one length where space is contracted.

    Raises:
        InputError: Steps are too short.
    """
    step = march.step_voxels * float(space.voxel_edges(size).min())
    across = float(np.linalg.norm(space.box_max - space.box_min))
    _require_few(march, across, step, MOST_STEPS)
    if space.frustum is None:
        _require_few(march, reach, step, MOST_LINEAR)
    half = float(0.5 * (space.box_max - space.box_min).max())
    far = march.far
    if far is None:
        far = march.near + FAR_BOXES * half + reach if space.contracted else math.inf
    n_linear = math.ceil(max(0.0, (reach - march.near) / step))
    return Steps(
        near=march.near,
        far=min(far, 1e30),
        step=step,
        n_linear=n_linear if space.contracted else 0,
        growth=_growth(march, space) if space.contracted else 0.0,
        transmittance_min=march.transmittance_min,
        in_ndc=space.frustum is not None,
    )


def _require_few(march: MarchConfig, length: float, step: float, most: int) -> None:
    """Raise InputError where a ray takes too many steps over a length."""
    if not length <= most * step:
        raise InputError(
            f"march.step_voxels {march.step_voxels:g} is too short: over {length:.4g} units a ray "
            f"would take more than {most} steps; use a longer one."
        )


def _growth(march: MarchConfig, space: Space) -> float:
    if isinstance(march.growth, str):
        return min(GROWTH / space.border, MOST_GROWTH)
    return march.growth
