"""View overlap: how many cameras have the same in their pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpnerf.scenes.cameras.camera import Camera

CAMERAS = 64
"""Whose content is looked at, at most, spread evenly."""

PIXELS = 48
"""Of each of them, at most, spread evenly."""


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


def _content(camera: Camera, distance: float) -> np.ndarray:
    """Points at a distance from a camera, on rays of pixels spread over its image, [n, 3]."""
    block = camera.block_for(PIXELS)
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
