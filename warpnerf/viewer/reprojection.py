"""Reprojection (3D warping) of a picture by its depth, from one viewpoint to another.

It takes milliseconds where rendering takes tenths of a second: what a page sees while its camera
moves, until the next picture has been rendered.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import mat33, real, vec2, vec3
from warpnerf_kernels.space import reprojection as kernels

from warpnerf.runtime.parallel import LaunchCache, Workers
from warpnerf.scenes.cameras.camera import Camera


class Reprojector:
    """Warps pictures on the CPU, in one thread: the others are the renderer's and the browser's."""

    def __init__(self) -> None:
        """Allocate nothing yet."""
        self._workers = Workers("cpu", 1)
        self._cache = LaunchCache()

    def warp(
        self, picture: np.ndarray, distance: np.ndarray, source: Camera, target: Camera
    ) -> tuple[np.ndarray, np.ndarray]:
        """Forward-warp the depth of a picture, then inverse-warp its colours.

        Args:
            picture: [H, W, 3] uint8, seen by the source.
            distance: [H, W] float32 along its rays, scene units; infinite for the background, and 0
                where nothing is known.
            source: Camera of H x W pixels, without distortion.
            target: Camera of h x w pixels, likewise.

        Returns:
            The picture [h, w, 3] uint8 from the target, and where it is known, [h, w] bool; it is
            black elsewhere.
        """
        size = target.height, target.width
        views = _pinhole(source), _pinhole(target)
        # What is infinitely far away moves by the camera's rotation only.
        far = np.float32(1e4) * np.float32(
            1.0 + np.abs(distance[np.isfinite(distance)]).max(initial=0.0)
        )
        distances = _lent(np.minimum(distance, far), real)
        pixels = _lent(picture, wp.uint8)
        buffer = _coarser(target)
        depths = np.full((buffer.height, buffer.width), kernels.NOTHING, np.float32)
        warped, seen = np.zeros((*size, 3), np.uint8), np.empty(size, np.uint8)
        depth_buffer = _lent(depths, real)
        self._workers.launch(
            kernels.splat_depths,
            -(-source.height // kernels.COARSE),
            *(views[0], _pinhole(buffer), distances, depth_buffer),
            cache=self._cache,
        )
        self._workers.launch(
            kernels.inverse_warp,
            target.height,
            *(*views, _pinhole(buffer), pixels, distances, depth_buffer),
            *(_lent(warped, wp.uint8), _lent(seen, wp.uint8)),
            cache=self._cache,
        )
        return warped, seen.astype(bool)


def _lent(values: np.ndarray, dtype: type) -> wp.array:
    """Values of whatever shape as a flat array of kernels, without a copy."""
    flat = np.ascontiguousarray(values).reshape(-1)
    return wp.array(flat, dtype=dtype, device="cpu", copy=False)


def _coarser(camera: Camera) -> Camera:
    """The camera with the larger pixels of the depth buffer."""
    share = 1.0 / kernels.COARSE
    return replace(
        camera,
        width=-(-camera.width // kernels.COARSE),
        height=-(-camera.height // kernels.COARSE),
        fx=share * camera.fx,
        fy=share * camera.fy,
        cx=share * camera.cx,
        cy=share * camera.cy,
    )


def _pinhole(camera: Camera) -> kernels.Pinhole:
    view = kernels.Pinhole()
    view.rotation = mat33(*camera.c2w[:, :3].ravel())
    view.position = vec3(*camera.c2w[:, 3])
    view.focal = vec2(camera.fx, camera.fy)
    view.principal = vec2(camera.cx, camera.cy)
    view.width, view.height = camera.width, camera.height
    return view
