"""Where the voxels of an unbounded scene go: the box and border that blur photographs least.

A grid has so many voxels, and inside its box they are cubes of one size. Outside, contraction makes
them larger the farther away they are: the smaller the box, the finer it is, and the coarser is what
lies around. What a voxel w pixels wide blurs differs from the photograph by about w^1.25 in the
square, as trainings in many boxes have shown (docs/decisions/space-by-pixels.md). So of many boxes
the one is taken whose mean of that, over all that cameras see, is least. Small voxels have a price,
for they take more samples of a ray.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from warpnerf.checks import InputError
from warpnerf.config import TrainConfig
from warpnerf.model.spaces import SPACES, SpaceKind
from warpnerf.scenes.cameras.observations import Observations, quantiles
from warpnerf.scenes.cameras.overlap import in_picture
from warpnerf.scenes.extent.frustum import contraction_of, fit_frustum
from warpnerf.scenes.extent.space import Space
from warpnerf.scenes.scene import Scene

BLUR_POWER = 1.25
"""Error in the square goes with this power of a voxel's width in pixels."""
DEPTH_SHARE = 0.3
"""Of a voxel's length along the direction of view, that blurs: about the sine of the angle between
cameras that see the same."""
PRICE = 0.8
"""Decibels of error that halving all voxels must save for the time it takes."""
TRIMMED = 0.01
"""Share of the widest voxels that do not count: wrong matches lie there."""

MIN_GAIN = 0.25
"""Decibels by which another box must be better than the scene's own with the narrowest border: what
is predicted to be closer than that, trainings order otherwise."""

BORDERS = (0.2, 0.3, 0.5, 0.75, 1.0)
"""That are tried."""
OUTSIDE = (0.02, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
"""Shares of what cameras see outside the boxes that are tried, at each face."""
MIN_EDGES = (0.2, 0.4, 0.7, 1.0)
"""Least edges of these boxes, in longest edges; 1: cubes."""

UNSEEN_BORDER = 0.5
"""Where nothing is known of what cameras see."""
LOOKED_AT = 12
"""Points of a box along each axis, of which a camera must see one."""


def resolve_space(scene: Scene, config: TrainConfig) -> Space:
    """The space that the grid of a training fills: what is configured, auto decided for a scene.

    Args:
        scene: Its own box, and what its cameras see.
        config: Contraction, box, border, and how many voxels there are.

    Raises:
        InputError: The scene has no frustum; planes, a box, a border or growing steps are given
            for a grid without; or no training camera sees anything of a given box.
    """
    contraction, grid = contraction_of(scene, config), config.grid
    kind = SPACES[contraction]
    grid.require_planes_used(contraction)
    _require_contraction(kind, config)
    if kind.has_frustum:
        frustum, (low, high) = fit_frustum(scene, grid.planes, grid.n_nodes)
        return Space(box_min=low, box_max=high, contraction=contraction, frustum=frustum)
    low, high = scene.box_min, scene.box_max
    if not isinstance(grid.box, str):
        low, high = np.array(grid.box[:3], np.float64), np.array(grid.box[3:], np.float64)
        _require_seen(scene, low, high)
    space = Space(box_min=low, box_max=high, contraction=contraction)
    if not kind.contracts:
        return space
    border = None if isinstance(grid.border, str) else grid.border
    if scene.observations is None:
        space = replace(space, border=UNSEEN_BORDER if border is None else border)
    else:
        chosen = grid.box == "auto"
        space = plan_space(space, scene.observations, grid.n_nodes, border, box=chosen)
    content = np.stack([scene.box_min, scene.box_max])
    if np.array_equal(content, [space.box_min, space.box_max]):
        return space
    return replace(space, content=content)


def _require_contraction(kind: SpaceKind, config: TrainConfig) -> None:
    """Raise InputError where something is given that is of contracted space, or of a box."""
    if kind.has_frustum and not isinstance(config.grid.box, str):
        raise InputError(
            "grid.box does nothing in normalised device coordinates, whose box is a frustum before "
            "the cameras; leave --box out, or choose --contraction linf."
        )
    given = {"grid.border": config.grid.border, "march.growth": config.march.growth}
    for name, value in given.items():
        if not kind.contracts and not isinstance(value, str):
            raise InputError(
                f"{name} is {value:g}, but grid.contraction is {kind.name}, and {name} is of "
                "contracted space; leave it out, or choose linf or l2."
            )


def _require_seen(scene: Scene, low: np.ndarray, high: np.ndarray) -> None:
    """Raise InputError unless a training camera has a part of a box in its picture."""
    inside = [camera.position for camera in scene.training_cameras]
    if scene.observations is not None:
        inside += list(scene.observations.positions)
    if ((low <= inside) & (np.array(inside) <= high)).all(axis=1).any():
        return
    shares = (np.indices((LOOKED_AT,) * 3).reshape(3, -1).T + 0.5) / LOOKED_AT
    places = low + shares * (high - low)
    if not any(in_picture(camera, places).any() for camera in scene.training_cameras):
        raise InputError(
            f"grid.box from {_corner(low)} to {_corner(high)} lies outside of what every training "
            f"camera of {scene.name} sees; its content is about from {_corner(scene.box_min)} to "
            f"{_corner(scene.box_max)}: give a --box there, or leave it out."
        )


def _corner(point: np.ndarray) -> str:
    return " ".join(f"{value:.4g}" for value in point)


def plan_space(
    space: Space, observations: Observations, voxels: int, border: float | None, *, box: bool
) -> Space:
    """Choose box and border of a contracted space.

    Args:
        space: Contracted; its box is one of those that are tried.
        observations: What cameras see.
        voxels: Nodes of the grid.
        border: As it is given; None: it is chosen.
        box: Whether the box is chosen, too; else it stays.

    Returns:
        The space with the least ``predicted_error``; its own box with the narrowest border where
        that is hardly less.
    """
    tried = spaces(space, observations, border, box=box)
    errors = [predicted_error(space, observations, voxels) for space in tried]
    best = int(np.argmin(errors))
    return tried[best if errors[best] <= errors[0] - MIN_GAIN else 0]


def spaces(
    space: Space, observations: Observations, border: float | None, *, box: bool
) -> list[Space]:
    """All that ``plan_space`` tries, whose arguments these are; first the one that it begins with.

    Returns:
        Spaces of one contraction.
    """
    borders = BORDERS if border is None else (border,)
    boxes = [(space.box_min, space.box_max)]
    if box:
        boxes += list(_boxes(observations))
    return [
        replace(space, box_min=low, box_max=high, border=each)
        for low, high in boxes
        for each in borders
    ]


def predicted_error(space: Space, observations: Observations, voxels: int) -> float:
    """What blur by voxels costs in a space, and the time that small ones take.

    Args:
        space: Where the grid is.
        observations: What cameras see.
        voxels: Nodes of the grid.

    Returns:
        Decibels, up to a constant of the scene.
    """
    blur = space.voxel_widths(observations, voxels, DEPTH_SHARE) ** BLUR_POWER
    order = np.argsort(blur, kind="stable")
    weights = observations.weights[order]
    kept = np.cumsum(weights) <= 1.0 - TRIMMED
    kept[0] = True
    mean = (weights * blur[order])[kept].sum() / weights[kept].sum()
    return float(10.0 * np.log10(mean) - PRICE * np.log2(space.voxel_edge(voxels)))


def _boxes(observations: Observations) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Boxes around most of what cameras see: of their pixels, and of what these resolve."""
    for weights in (observations.weights, observations.weights * observations.pixels):
        for outside in OUTSIDE:
            shares = (outside, 1.0 - outside)
            ends = [quantiles(axis, weights, shares) for axis in observations.positions.T]
            low, high = np.array(ends).T
            edges = high - low
            if edges.max() <= 0.0:
                continue
            for least in MIN_EDGES:
                middle, half = 0.5 * (low + high), 0.5 * np.maximum(edges, least * edges.max())
                yield middle - half, middle + half
