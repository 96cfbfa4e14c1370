"""Where a training looks: the warp of space, the first grid, content distances, steps of rays."""

from __future__ import annotations

import math

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import vector

from warpnerf.checks import InputError
from warpnerf.config import MarchConfig, TrainConfig
from warpnerf.model.grid import (
    VoxelGrid,
    grid_size,
    reach_of_places,
    require_memory,
    room_for_nodes,
)
from warpnerf.model.interface import Model
from warpnerf.rendering.render import Steps
from warpnerf.scenes.focus import find_focus
from warpnerf.scenes.frustum import FARTHEST, contraction_of, fit_frustum
from warpnerf.scenes.overlap import views_of_content
from warpnerf.scenes.scene import Scene

FAR_BOXES = 64.0
"""How far an unbounded scene is sampled, in half edges of its box; beyond lies the background."""

FEW_VIEWS = 7.0
"""Cameras that see the same content, up to which auto scales all the way to its distance."""
LEAST_SHARE = 0.5
"""Of the way, that auto scales where many more cameras see the same, and look at no one thing."""


def require_grid(scene: Scene, config: TrainConfig, device: wp.Device) -> None:
    """Raise InputError where the final grid has no place in memory, or the scene no frustum."""
    first_grid(scene, config, 8, device, None)


def first_grid(
    scene: Scene, config: TrainConfig, n_voxels: int, device: wp.Device, resumed: VoxelGrid | None
) -> VoxelGrid:
    """The grid before the first update, all raw values 0.

    Args:
        scene: Its box, or what its frustum is fitted to.
        config: The rest.
        n_voxels: Nodes, about; the final grid has ``config.grid.voxels``.
        device: Where it lies.
        resumed: The grid of a training to be resumed: a frustum anew might be rounded otherwise.

    Raises:
        InputError: The final grid would not fit the memory, or the scene has no frustum.
    """
    assert isinstance(config.model, Model)
    contraction, n_floats = contraction_of(scene, config), config.model.n_floats
    border = config.grid.border if contraction in ("linf", "l2") else 0.0
    frustum, box = None, (scene.box_min, scene.box_max)
    if resumed is not None and resumed.frustum is not None:
        frustum, box = resumed.frustum, (resumed.box_min, resumed.box_max)
    elif contraction == "ndc":
        frustum, box = fit_frustum(scene, config.grid.planes, config.grid.voxels)
    extent = (box[1] - box[0]) * (1.0 + border)
    final = grid_size(extent, config.grid.voxels)
    require_memory(final, n_floats, device)
    size = grid_size(extent, n_voxels)
    voxel = float((extent / (np.array(final) - 1)).min())
    values = room_for_nodes(math.prod(size), vector(n_floats), device)
    values.zero_()
    return VoxelGrid(
        values=values,
        size=size,
        box_min=box[0],
        box_max=box[1],
        contraction=contraction,
        border=border,
        # softplus(shift) is the optical depth of a voxel of the final grid.
        density_shift=math.log(math.expm1(-math.log1p(-config.grid.alpha_init))),
        density_scale=1.0 / voxel,
        frustum=frustum,
    )


def content_distances(scene: Scene, config: TrainConfig) -> tuple[float, list[float]]:
    """The content distance of the scene, and those of its training views.

    With auto, a camera's is the geometric mean of the scene's and of its own where that is known: a
    camera close to a wall shall draw the wall, but in a scene of few photographs a camera's own is
    the distance of its floaters as often as not. Where cameras look at no common point and many see
    the same, it is less, down to half: they contradict a floater before one of them, and scaling
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
        cameras, share = scene.training_cameras, 1.0
        if find_focus(cameras).guessed:
            share = min(1.0, max(LEAST_SHARE, FEW_VIEWS / views_of_content(cameras, each)))
        return one, [share * math.sqrt(one * float(own)) for own in each]
    one = scene.content_distance if chosen == "auto" else float(chosen)
    return one, [one] * len(train)


def require_samples(scene: Scene, config: TrainConfig) -> None:
    """Raise InputError where march.near and march.far leave no sample inside the box to any ray."""
    positions = np.array([camera.position for camera in scene.training_cameras])
    outside = np.maximum(0.0, np.maximum(scene.box_min - positions, positions - scene.box_max))
    across = np.maximum(np.abs(scene.box_min - positions), np.abs(scene.box_max - positions))
    begin = float(np.linalg.norm(outside, axis=1).min())
    end = float(np.linalg.norm(across, axis=1).max())
    march = config.march
    contraction, what = contraction_of(scene, config), "box"
    if contraction == "ndc":
        frustum, _ = fit_frustum(scene, config.grid.planes, config.grid.voxels)
        depths, what = frustum.depths(positions), "frustum"
        begin = frustum.near - float(depths.max())
        end = FARTHEST * frustum.near - float(depths.min())
    elif contraction != "none":
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


def reach(scene: Scene) -> float:
    """Distance from the outermost training camera to the farthest corner of the box."""
    places = np.array([scene.views[i].camera.position for i in scene.splits["train"]])
    return reach_of_places(scene.box_min, scene.box_max, places)


def march_steps(march: MarchConfig, grid: VoxelGrid, reach: float) -> Steps:
    """How rays are marched through a grid.

    Args:
        march: What is configured.
        grid: As it stands.
        reach: See there, scene units: how far steps have one length where space is folded.
    """
    step = march.step_voxels * float(grid.voxel_size.min())
    half = float(0.5 * (grid.box_max - grid.box_min).max())
    far = march.far
    if far is None:
        far = march.near + FAR_BOXES * half + reach if grid.folded else math.inf
    n_linear = max(0, math.ceil((reach - march.near) / step))
    return Steps(
        near=march.near,
        far=min(far, 1e30),
        step=step,
        n_linear=n_linear if grid.folded else 0,
        growth=march.growth if grid.folded else 0.0,
        transmittance_min=march.transmittance_min,
        in_ndc=grid.frustum is not None,
    )
