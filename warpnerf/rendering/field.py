"""A radiance field that can be looked at: a grid, its free space, and how to march through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import real, vec3

from warpnerf.checks import require_rays
from warpnerf.model.grid import FreeCells, VoxelGrid, reach_of_places
from warpnerf.model.interface import Model
from warpnerf.rendering.rays import camera_rays
from warpnerf.rendering.render import RenderedRays, Steps, render_rays
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.camera import Camera


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """What a camera or a set of rays sees; [...] is [H, W] or [n_rays]."""

    rgb: np.ndarray
    """[..., 3] float32 in [0, 1], background included."""
    depth: np.ndarray
    """[...] float32, sum of weight times t, scene units; nothing is added for the background."""
    opacity: np.ndarray
    """[...] float32 in [0, 1]."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Field:
    """A trained scene."""

    model: Model
    """What the grid holds, and how that becomes colour."""
    grid: VoxelGrid
    """Densities and features."""
    weights: wp.array
    """[n_weights] of the model's MLP; none without one."""
    free: FreeCells
    """What of the grid is skipped."""
    steps: Steps
    """How rays are marched."""
    background: tuple[float, float, float]
    """rgb in [0, 1], seen where rays pass through."""
    workers: Workers
    """The device that it lives on."""

    def render(self, camera: Camera) -> Rendering:
        """Look through a camera.

        Args:
            camera: Any camera in the scene's coordinates.

        Returns:
            rgb [H, W, 3], depth [H, W] and opacity [H, W].

        Raises:
            InputError: The camera's pose is not finite.
        """
        camera.check()  # its pose is an array, which may have changed since it was made
        rays = camera_rays(camera, self.workers)
        seen = self._render(*rays, places=camera.position[None])
        return self._rendering(seen, (camera.height, camera.width))

    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> Rendering:
        """Look along rays.

        Args:
            origins: [n_rays, 3], scene units.
            directions: [n_rays, 3] of unit length.

        Returns:
            rgb [n_rays, 3], depth [n_rays] and opacity [n_rays].

        Raises:
            InputError: Shapes differ, or a direction is not of unit length.
        """
        require_rays(origins, directions)
        device = self.workers.device
        rays = (
            wp.array(np.ascontiguousarray(origins, np.float32), dtype=vec3, device=device),
            wp.array(np.ascontiguousarray(directions, np.float32), dtype=vec3, device=device),
        )
        return self._rendering(self._render(*rays, places=origins), (len(origins),))

    def _render(self, origins: wp.array, directions: wp.array, places: np.ndarray) -> RenderedRays:
        """Look along rays from some places, [n, 3]."""
        device = self.workers.device
        return render_rays(
            self.model,
            self.grid,
            self.weights,
            self.free,
            self.steps.reaching(reach_of_places(self.grid.box_min, self.grid.box_max, places)),
            origins,
            directions,
            wp.full(1, 0.5, dtype=real, device=device),
            wp.full(1, vec3(*self.background), dtype=vec3, device=device),
            self.workers,
        )

    @staticmethod
    def _rendering(rays: RenderedRays, shape: tuple[int, ...]) -> Rendering:
        return Rendering(
            rgb=rays.rgb.numpy().reshape(*shape, 3).clip(0.0, 1.0),  # an MLP may add too much
            depth=rays.depth.numpy().reshape(shape),
            opacity=1.0 - rays.transmittance.numpy().reshape(shape),
        )
