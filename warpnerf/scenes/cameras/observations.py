"""What cameras see, one row for each camera and place: where it is, from where, and how fine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpnerf.scenes.cameras.camera import Camera

MOST = 12_000
"""Observations in all, about."""
PER_CAMERA = (4, 40)
"""Observations of a camera, at least and at most."""
NEAR, FAR = 0.1, 4.0
"""In medians of its camera; what is nearer or farther may be a wrong match."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Observations:
    """Places on surfaces, each seen by one camera; all cameras weigh as much."""

    positions: np.ndarray
    """[n, 3] float64, scene units."""
    directions: np.ndarray
    """[n, 3] float64, unit vectors from the camera to the place."""
    pixels: np.ndarray
    """[n] float64, pixels that a scene unit across the line of sight covers there."""
    weights: np.ndarray
    """[n] float64, share of all pixels; their sum is 1."""

    def __len__(self) -> int:
        """How many there are."""
        return len(self.positions)

    def of(self, kept: np.ndarray) -> Observations:
        """Some of them.

        Args:
            kept: [n] bool, at least one.
        """
        columns = (self.positions, self.directions, self.pixels, self.weights)
        return _normalised(*(column[kept] for column in columns))


def observe(
    cameras: Sequence[Camera], seen: Sequence[np.ndarray], training: Sequence[int]
) -> Observations:
    """Choose places from those that cameras see.

    Args:
        cameras: Of all views.
        seen: For each, places that it sees, [n, 3] scene units, none at the camera itself.
        training: Indices of the cameras that count; one of them at least sees something.

    Returns:
        Some of them, spread evenly over each camera's.
    """
    most = int(np.clip(MOST // max(1, len(training)), *PER_CAMERA))
    rows = []
    for index in training:
        camera, places = cameras[index], seen[index]
        places = places[:: max(1, -(-len(places) // most))]
        away = np.linalg.norm(places - camera.position, axis=1)
        middle = np.median(away) if len(away) else 0.0
        kept = (away > NEAR * middle) & (away < FAR * middle)
        rows.append(_rows(camera, places[kept], away[kept]))
    columns = [np.concatenate(column) for column in zip(*rows, strict=True)]
    return _normalised(*columns)


def guessed(cameras: Sequence[Camera], distance: float) -> Observations:
    """What lies on the optical axes of cameras, where nothing is known but how far content is.

    Args:
        cameras: At least one.
        distance: From each of them, scene units.
    """
    rows = [
        _rows(camera, (camera.position + distance * camera.forward)[None], np.array([distance]))
        for camera in cameras
    ]
    return _normalised(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def quantiles(values: np.ndarray, weights: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """Values [n] below which such shares of the weight [n] lie."""
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    at = np.searchsorted(total, np.array(shares) * total[-1])
    return np.asarray(values[order[np.minimum(at, len(values) - 1)]])


def _rows(
    camera: Camera, places: np.ndarray, away: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The columns of ``Observations`` for one camera; its weights sum up to 1."""
    return (
        places,
        (places - camera.position) / away[:, None],
        np.sqrt(camera.fx * camera.fy) / away,
        np.full(len(places), 1.0 / max(1, len(places))),
    )


def _normalised(
    positions: np.ndarray, directions: np.ndarray, pixels: np.ndarray, weights: np.ndarray
) -> Observations:
    return Observations(
        positions=positions,
        directions=directions,
        pixels=pixels,
        weights=weights / weights.sum(),
    )
