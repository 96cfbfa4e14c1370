"""Sparse points from structure from motion, and the scene extent that they give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from warpnerf.checks import MAX_COORDINATE
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.focus import Extent
from warpnerf.scenes.cameras.observations import Observations, observe, quantiles
from warpnerf.scenes.cameras.overlap import in_picture
from warpnerf.scenes.scene import Scene, View

MAX_PROJECTED = 5000
"""Points without tracks that are looked for in each photograph; of more every n-th is taken."""

MAX_SEEN = 2000
"""Points that count of those matched in a photograph; of more every n-th is taken."""

FEW = 10
"""A camera that sees fewer points has no distance of its own."""

MIN_SHARE = 0.5
"""Share of the training cameras that must see enough points for these to be used."""

OUTSIDE = 0.02
"""Share of what cameras see that may lie outside the box at each of its faces, and is left out as
noise, or as background far behind."""

BACKGROUND = 4.0
"""Points farther than so many times the median of their camera are behind what the box is for."""

MARGIN = 0.05
"""Of the box, on each side, in its edges."""

MIN_EDGE = 0.2
"""Least edge of the box, in longest edges."""

NEARER = 0.01
"""Share of the points seen that are nearer than the near content: floaters of the matching."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Points:
    """Points that a capture brings."""

    positions: np.ndarray
    """[n, 3] float64, scene units; finite."""
    tracks: Mapping[str, np.ndarray] | None
    """Indices of the points that were matched in a photograph, by the photograph's name; None: not
    known."""
    source: str
    """The file, relative to the scene's folder."""
    tried: bool = False
    """Whether no file of the scene names them, so that they may be of something else."""

    def seen_by(self, name: str, camera: Camera) -> np.ndarray:
        """The points that a camera sees.

        Without tracks those that fall into its picture, whether something is before them or not.

        Args:
            name: Of its photograph.
            camera: The camera; its distortion is left out of account.

        Returns:
            [n, 3] scene units, all in front of the camera.
        """
        if self.tracks is not None:
            indices = self.tracks.get(name, np.empty(0, np.int64))
            points = self.positions[_spread(indices, MAX_SEEN)]
            return points[(points - camera.position) @ camera.forward > 0.0]
        return self.sample[in_picture(camera, self.sample)]

    @property
    def sample(self) -> np.ndarray:
        """Some of the positions, to show, [n, 3]."""
        return _spread(self.positions, MAX_PROJECTED)


@dataclass(frozen=True, kw_only=True, eq=False)
class ObservedExtent:
    """The observed extent of a scene: what cameras see of it, by its points."""

    distances: np.ndarray
    """[n_views] median distance of the points that each camera sees, scene units; the content
    distance where it sees few."""
    content_distance: float
    """Median of the training cameras' own, scene units."""
    near_content: float
    """Nearest distance that is seen, but for one point in a hundred, scene units."""
    middle: np.ndarray
    """[3] median of the points seen, scene units."""
    box_min: np.ndarray
    """[3] lower corner of the box around them, but for outliers, scene units."""
    box_max: np.ndarray
    """[3] upper corner."""
    observations: Observations
    """Some of the points, as training cameras see them."""
    found_by: str = "points"
    """What tells it, in words."""


def observed_extent(
    cameras: Sequence[Camera],
    seen: Sequence[np.ndarray],
    training: Sequence[int],
    outside: float = OUTSIDE,
    nearer: float = NEARER,
) -> ObservedExtent | None:
    """The observed extent: how far from the cameras content is, and where.

    All training cameras count as much, however many points they see. All figures are medians and
    quantiles, so that a few wrong points, near cameras or far behind, change little.

    Args:
        cameras: Of all views.
        seen: For each, the points that it sees, [n, 3] scene units.
        training: Indices of the training cameras, which alone decide but for distances of others.
        outside: Share of what cameras see that may lie outside the box at each of its faces.
        nearer: Share of it that is nearer than the near content.

    Returns:
        What they see; None where points do not tell it to enough of the training cameras.
    """
    away = [
        np.linalg.norm(points - camera.position, axis=1)
        for camera, points in zip(cameras, seen, strict=True)
    ]
    own = np.array([np.median(a) if len(a) >= FEW else np.nan for a in away])
    own[own <= 0.0] = np.nan
    if np.isfinite(own[list(training)]).mean() < MIN_SHARE:
        return None
    content_distance = float(np.nanmedian(own[list(training)]))
    distances = np.where(np.isfinite(own), own, content_distance)

    distance = np.concatenate([away[i] for i in training])
    near = np.concatenate([away[i] <= BACKGROUND * distances[i] for i in training])
    weight = np.concatenate(
        [np.full(len(a), 1.0 / max(len(a), FEW)) for a in (away[i] for i in training)]
    )
    points = np.concatenate([seen[i] for i in training])[near]
    shares = (outside, 0.5, 1.0 - outside)
    low, middle, high = np.stack([quantiles(axis, weight[near], shares) for axis in points.T], 1)
    edges = high - low
    if edges.max() <= 0.0:  # all in one place
        return None
    # A facade is flat, its box is not.
    margin = np.maximum(MARGIN * edges, 0.5 * (MIN_EDGE * edges.max() - edges))
    return ObservedExtent(
        distances=distances,
        content_distance=content_distance,
        near_content=float(quantiles(distance, weight, (nearer,))[0]),
        middle=middle,
        box_min=low - margin,
        box_max=high + margin,
        observations=observe(cameras, seen, training),
    )


def extent_by_points(
    extent: Extent,
    points: Points,
    views: Sequence[View],
    training: Sequence[int],
    unbounded: bool,
) -> tuple[Extent, ObservedExtent | None]:
    """The extent by what cameras see; the box of an object stays what the cameras look at.

    Args:
        extent: As the cameras alone tell.
        points: Of the scene.
        views: All.
        training: Indices of those that are trained on.
        unbounded: Whether the scene is more than an object.

    Returns:
        The extent, with notes that say what it is of, and what the points tell; None where too few
        tell something.
    """
    cameras = [view.camera for view in views]
    seen = [points.seen_by(view.name, view.camera) for view in views]
    observed = observed_extent(cameras, seen, training)
    if observed is None:
        note = f"points of {points.source} are not used: too few tell what the cameras see"
        return replace(extent, notes=(*extent.notes, note)), None
    distance = (
        f"content distance {observed.content_distance:.3g}: median distance of the points of "
        f"{points.source} that a training camera sees"
    )
    extent = replace(
        extent, content_distance=observed.content_distance, notes=(distance, extent.notes[1])
    )
    if not (unbounded or extent.guessed):
        return extent, observed
    edges = " x ".join(f"{edge:.3g}" for edge in observed.box_max - observed.box_min)
    box = f"box of edges {edges}: where these points are, but for outliers and what is far behind"
    extent = replace(
        extent, box_min=observed.box_min, box_max=observed.box_max, notes=(distance, box)
    )
    return extent, observed


def with_extent(scene: Scene, observed: ObservedExtent) -> Scene:
    """The scene with what its cameras see, without points; its box only where it was a guess."""
    note = f"content distance {observed.content_distance:.3g}"
    if scene.guessed:
        edges = " x ".join(f"{edge:.3g}" for edge in observed.box_max - observed.box_min)
        note += f" and box of edges {edges}"
    return replace(
        scene,
        box_min=observed.box_min if scene.guessed else scene.box_min,
        box_max=observed.box_max if scene.guessed else scene.box_max,
        content_distance=observed.content_distance,
        content_distances=observed.distances,
        near_content=observed.near_content,
        observations=observed.observations,
        guessed=False,
        notes=(*scene.notes, f"{note} instead: what the cameras see, found by {observed.found_by}"),
    )


def _spread(values: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the values [n, ...], spread evenly over their order."""
    return values[:: max(1, -(-len(values) // most))]


def usable(positions: np.ndarray) -> np.ndarray:
    """Which of positions [n, 3] are finite and of a size that a scene can have, [n] bool."""
    return (np.abs(positions) <= MAX_COORDINATE).all(axis=1)
