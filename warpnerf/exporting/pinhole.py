"""Undistortion: photographs through any lens as a pinhole camera would have taken them."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.undistort import COEFFICIENTS, directions, seen_pixels
from warpnerf.scenes.scene import Scene, View

WIDEST = 1.5
"""Tangent of half the field of view of a picture, at most: of fisheye lenses, the middle."""

N_BORDER = 65
"""Points along each side of a photograph that its field of view is measured at."""

COUNTS = 0.999
"""Share of the weights of interpolation in pixels that count, at least, for a pixel to count."""


def pinhole_scene(scene: Scene) -> Scene:
    """Undistort the photographs of a scene.

    Each keeps its size and stands where it did, with the principal point in the middle. It shows
    the largest part about it that the photograph fills, so that no borders are left blank. Ones
    without distortion stay as they are; true depths of the others are dropped.

    Args:
        scene: Any.
    """
    return replace(scene, views=[_undistorted(view) for view in scene.views])


def _undistorted(view: View) -> View:
    camera = view.camera
    if not camera.fisheye and not any(getattr(camera, name) for name in COEFFICIENTS):
        return view
    lens = replace(camera, c2w=np.eye(3, 4))
    key = tuple((name, value) for name, value in vars(lens).items() if name != "c2w")
    pinhole, low, shares = _sampling(key)
    seen = seen_pixels(camera)
    mask = None
    if view.mask is not None or seen is not None:
        full = np.ones((camera.height, camera.width), bool)
        both = (full if view.mask is None else view.mask) & (full if seen is None else seen)
        mask = _interpolated(both.astype(np.float32)[..., None], low, shares)[..., 0] > COUNTS
    image = np.round(_interpolated(view.image, low, shares)).astype(np.uint8)
    return replace(
        view, camera=replace(pinhole, c2w=camera.c2w), image=image, mask=mask, depth=None
    )


@functools.lru_cache(maxsize=4)
def _sampling(lens: tuple) -> tuple[Camera, np.ndarray, np.ndarray]:
    """The pinhole camera of a lens, and where its pixels lie in the photograph.

    Returns:
        The camera; the pixels left of and above them [H, W, 2], and how far beyond their middles
        they lie [H, W, 2].
    """
    camera = Camera(**dict(lens), c2w=np.eye(3, 4))
    width, height = camera.width, camera.height
    along = np.linspace(0.0, 1.0, N_BORDER)
    sides = [
        np.stack([np.full(N_BORDER, 0.5), height * along], axis=1),
        np.stack([np.full(N_BORDER, width - 0.5), height * along], axis=1),
        np.stack([width * along, np.full(N_BORDER, 0.5)], axis=1),
        np.stack([width * along, np.full(N_BORDER, height - 0.5)], axis=1),
    ]
    tangents = []
    for side, axis in zip(sides, (0, 0, 1, 1), strict=True):
        ways = directions(camera, side)
        ahead = np.maximum(-ways[:, 2], 1e-3)
        tangents.append(float(np.abs(ways[:, axis] / ahead).min()))
    half = np.minimum([min(tangents[:2]), min(tangents[2:])], WIDEST)
    fx, fy = 0.5 * np.array([width, height]) / half
    pinhole = Camera(
        width=width,
        height=height,
        fx=float(fx),
        fy=float(fy),
        cx=0.5 * width,
        cy=0.5 * height,
        c2w=np.eye(3, 4),
    )
    x = (np.arange(width) + 0.5 - 0.5 * width) / fx
    y = (np.arange(height) + 0.5 - 0.5 * height) / fy
    points = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    at = camera.distort(points)[0] * (camera.fx, camera.fy) + (camera.cx, camera.cy) - 0.5
    at = np.clip(at.reshape(height, width, 2), 0.0, (width - 1.0, height - 1.0))
    low = np.minimum(np.floor(at).astype(np.int64), (max(width - 2, 0), max(height - 2, 0)))
    return pinhole, low, at - low


def _interpolated(image: np.ndarray, low: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Bilinear interpolation of an image [H, W, C] at pixels [H, W, 2] and shares beyond them."""
    (x, y), (u, v) = low.transpose(2, 0, 1), shares.transpose(2, 0, 1)[..., None]
    right, below = np.minimum(x + 1, image.shape[1] - 1), np.minimum(y + 1, image.shape[0] - 1)
    upper = (1.0 - u) * image[y, x] + u * image[y, right]
    lower = (1.0 - u) * image[below, x] + u * image[below, right]
    return np.asarray((1.0 - v) * upper + v * lower)
