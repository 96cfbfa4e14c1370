"""View overlap: how many cameras have the same in their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpnerf.scenes.cameras.camera import Camera

CAMERAS = 64
"""Whose content is looked at, at most, spread evenly."""

PIXELS = 48
"""Of each of them, at most, spread evenly."""

FEW_CAMERAS, FEW_PIXELS = 32, 20
"""The same, where many distances are looked at."""

REACH, POINTS = 100.0, 61
"""Distances along rays: from 1 / REACH to REACH content distances, so many."""


def in_picture(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Which points fall into a camera's picture, whether something is before them or not.

    Args:
        camera: The camera; its distortion is left out of account.
        points: [n, 3] scene units.

    Returns:
        [n] bool.
    """
    x, y, z = ((points - camera.position) @ camera.c2w[:, :3]).T
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if camera.fisheye:  # as far from the middle as the angle to the axis is large
            aside = np.hypot(x, y)
            scale = np.where(aside > 0.0, np.arctan2(aside, -z) / aside, 0.0)
        else:
            scale = -1.0 / z
        u, v = camera.cx + camera.fx * x * scale, camera.cy - camera.fy * y * scale
    inside = (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
    return np.asarray(inside & (z < 0.0))


def views_of_content(cameras: Sequence[Camera], distances: np.ndarray) -> float:
    """How many cameras have a place in their pictures that one of them looks at.

    Args:
        cameras: At least one; their distortion is left out of account, and so is what hides one
            thing behind another.
        distances: [n_cameras] how far from each camera that is which it looks at, scene units.

    Returns:
        The median over places, at least 1: each camera counts itself.
    """
    spread = slice(None, None, -(-len(cameras) // CAMERAS))
    places = np.concatenate(
        [_content(*pair) for pair in zip(cameras[spread], distances[spread], strict=True)]
    )
    return float(np.median(np.sum([in_picture(camera, places) for camera in cameras], axis=0)))


@dataclass(frozen=True, kw_only=True, eq=False)
class RayOverlap:
    """What a point on a ray has of all cameras, by its distance from the ray's own."""

    distances: np.ndarray
    """[n] scene units, in equal ratios."""
    cameras: np.ndarray
    """[n] how many cameras have the point in their pictures, mean over points."""
    density: np.ndarray
    """[n] pixels' rays of all cameras per area across them, mean over points: 1 / scene unit^2. All
    pixels count as if they were on the axis; others of a pinhole camera are denser, by 1 / cos^3.
    With samples at even distances, times one in so many scene units, samples per volume."""


def overlap_along_rays(cameras: Sequence[Camera], content_distance: float) -> RayOverlap:
    """Overlap along the cameras' rays, whatever hides one thing behind another.

    Philip & Deschaintre 2023, figure 4: near a camera hardly any other sees what it sees, and it
    alone samples that space as 1 / distance^2.

    Args:
        cameras: At least one; their distortion is left out of account.
        content_distance: The middle of the distances, scene units.
    """
    distances = content_distance * np.geomspace(1.0 / REACH, REACH, POINTS)
    spread = cameras[:: -(-len(cameras) // FEW_CAMERAS)]
    places = np.stack(
        [np.concatenate([_content(c, t, FEW_PIXELS) for c in spread]) for t in distances]
    )
    flat = places.reshape(-1, 3)
    counts, density = np.zeros(len(flat)), np.zeros(len(flat))
    for camera in cameras:
        seen = np.flatnonzero(in_picture(camera, flat))
        squared = np.sum((flat[seen] - camera.position) ** 2, axis=1)
        counts[seen] += 1.0
        density[seen] += camera.fx * camera.fy / np.maximum(squared, distances[0] ** 2)
    return RayOverlap(
        distances=distances,
        cameras=counts.reshape(POINTS, -1).mean(axis=1),
        density=density.reshape(POINTS, -1).mean(axis=1),
    )


def _content(camera: Camera, distance: float, n_pixels: int = PIXELS) -> np.ndarray:
    """Points at a distance from a camera, on rays of pixels spread over its image, [n, 3]."""
    block = camera.block_for(n_pixels)
    u, v = np.meshgrid(
        np.arange(block // 2, camera.width, block) + 0.5,
        np.arange(block // 2, camera.height, block) + 0.5,
    )
    return content_at(camera, u.ravel(), v.ravel(), np.full(u.size, distance))


def content_at(camera: Camera, u: np.ndarray, v: np.ndarray, distances: np.ndarray) -> np.ndarray:
    """Points on rays of pixels.

    Args:
        camera: The camera; its distortion is left out of account.
        u: [n] pixels from the left.
        v: [n] pixels from the top.
        distances: [n] along the rays, scene units.

    Returns:
        [n or fewer, 3] scene units: pixels behind a fisheye's plane have none.
    """
    x, y = (u - camera.cx) / camera.fx, (camera.cy - v) / camera.fy
    if camera.fisheye:
        angle = np.hypot(x, y)
        aside, ahead = np.sinc(angle / np.pi), np.cos(angle)  # sin(angle) / angle
        x, y, z = aside * x, aside * y, -ahead
        seen = ahead > 0.0
    else:
        z = -np.ones_like(x)
        seen = np.ones(len(x), bool)
    directions = np.stack([x, y, z], axis=1)[seen]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    along = distances[seen, None] * directions
    return np.asarray(camera.position + along @ camera.c2w[:, :3].T)
