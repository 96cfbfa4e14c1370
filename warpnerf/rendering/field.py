"""A radiance field that can be rendered: its storage, free space, and how to march through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp
from warpnerf_kernels.base.types import real, vec2, vec3
from warpnerf_kernels.launch import assembly

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError, is_finite, require_rays, said
from warpnerf.fields.lattice import Lattice
from warpnerf.fields.nodes import cells_within, points_of
from warpnerf.fields.occupancy import FreeCells
from warpnerf.fields.storage import Storage
from warpnerf.model.interface import Model
from warpnerf.rendering.proposal import Proposal, Proposer
from warpnerf.rendering.rays import camera_rays, rays_struct
from warpnerf.rendering.render import RenderedRays, render_rays
from warpnerf.rendering.steps import ClippedSteps, Steps
from warpnerf.rendering.structs import AnySteps
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.extent.space import reach_of_places

PROPOSED = 1 << 14
"""Rays that intervals are drawn for at a time: what that takes is not to grow with pictures."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Rendering:
    """A rendering: RGB, opacity and depth of a camera or a set of rays; [...] is [H, W] or
    [n_rays]."""

    rgb: np.ndarray
    """[..., 3] float32 in [0, 1], background included."""
    depth: np.ndarray
    """[...] float32, sum of weight times t, scene units; nothing is added for the background."""
    opacity: np.ndarray
    """[...] float32 in [0, 1]."""


def checked_crop(low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """The corners of a box to crop to, [2, 3] float64.

    Raises:
        InputError: It is no box.
    """
    corners = (*low, *high)
    three = len(low) == len(high) == 3 and all(map(is_finite, corners))
    if not three or not all(x < y for x, y in zip(low, high, strict=True)):
        raise InputError(
            "crop must be a lower and an upper corner, x y z each, the first below the second, "
            f"not {said(corners)}."
        )
    return np.array([low, high], np.float64)


def between(corners: Sequence[np.ndarray] | np.ndarray) -> str:
    """Where a box with two corners lies, in words."""
    low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in corners)
    return f"between {low} and {high}"


def require_distance(distance: float) -> None:
    """Raise InputError unless a number is at least 0; it may be infinite."""
    if not distance >= 0.0:
        raise InputError(f"distance must be at least 0, not {said(distance)}.")


@dataclass(frozen=True, kw_only=True, eq=False)
class Field:
    """A trained radiance field."""

    model: Model
    """What it holds, and how that becomes colour."""
    storage: Storage
    """Densities and features."""
    weights: wp.array
    """[n_weights] of the model's MLP; none without one."""
    free: FreeCells
    """What of its lattice is skipped."""
    steps: Steps
    """How rays are marched."""
    background: tuple[float, float, float]
    """rgb in [0, 1], seen where rays pass through."""
    workers: Workers
    """The device that it lives on."""
    proposal: Proposal | None = None
    """Where to sample rays; None: in steps that are the same for all."""

    @property
    def lattice(self) -> Lattice:
        """The voxel lattice: its nodes and the space that they fill."""
        return self.storage.lattice

    @property
    def surroundings(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, [3] scene units, of a box around what it holds."""
        return self.lattice.surroundings

    @property
    def in_ndc(self) -> bool:
        """Whether its steps are lengths in normalised device coordinates."""
        return self.steps.in_ndc

    def copied_to(self, device: wp.Device) -> Field:
        """A deep copy: the same field with arrays of its own.

        Args:
            device: Where they lie.

        Returns:
            A field that is rendered where this one is.
        """
        distance = wp.clone(self.free.distance, device=device)
        return replace(
            self,
            storage=self.storage.copied_to(device),
            weights=wp.clone(self.weights, device=device),
            free=replace(self.free, distance=distance),
            proposal=None if self.proposal is None else self.proposal.copied_to(device),
        )

    @checked_arguments
    def cropped(self, low: Sequence[float], high: Sequence[float]) -> Field:
        """Crop a field to a box: rays see nothing outside of it.

        Args:
            low: Lower corner, [3] scene units.
            high: Upper corner, above the lower one.

        Returns:
            A field with the same storage, cut to cells of two voxels.

        Raises:
            InputError: It is no box, or holds nothing that could be seen.
        """
        box = checked_crop(low, high)
        inside = cells_within(self.lattice, *box)
        if not inside.any():
            raise InputError(
                "crop holds no cell of the field, of two voxels along each side; enlarge the box."
            )
        free = self.free.cropped(self.lattice, inside, self.workers)
        if free.occupied_range() is None:
            raise InputError(
                f"crop {between(box)} holds nothing that could be seen; choose a box that meets "
                f"what the field holds, which lies {between(self._held())}."
            )
        return replace(self, free=free)

    def _held(self) -> tuple[np.ndarray, np.ndarray]:
        """Corners, [3] scene units, of a box around what it holds, without free space."""
        around, occupied = self.surroundings, self.free.occupied_range()
        if occupied is None or self.lattice.frustum is not None:
            return around
        corners = np.stack(np.meshgrid(*np.stack(occupied).T), axis=-1).reshape(-1, 3)
        points = points_of(self.lattice, corners * (np.array(self.lattice.size) - 1))
        return np.clip(points.min(axis=0), *around), np.clip(points.max(axis=0), *around)

    @checked_arguments
    def render(self, camera: Camera) -> Rendering:
        """Render a camera's image: colour, opacity and depth by volume rendering.

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

    @checked_arguments
    def render_rays(self, origins: np.ndarray, directions: np.ndarray) -> Rendering:
        """Render rays: colour, opacity and depth by volume rendering.

        Args:
            origins: [n_rays, 3], scene units.
            directions: [n_rays, 3] of unit length.

        Returns:
            rgb [n_rays, 3], depth [n_rays] and opacity [n_rays].

        Raises:
            InputError: Shapes differ, or a direction is not of unit length.
        """
        require_rays(origins, directions)
        rays = self._array(origins, vec3), self._array(directions, vec3)
        return self._rendering(self._render(*rays, places=origins), (len(origins),))

    def render_between(
        self, origins: np.ndarray, directions: np.ndarray, ends: np.ndarray
    ) -> Rendering:
        """Render parts of rays, over black: what the field holds between two distances.

        The parts of a ray, composited, are the ray: where an end cuts a step, each part has its
        share of it. With a proposal each part has intervals of its own.

        Args:
            origins: [n_rays, 3], scene units.
            directions: [n_rays, 3] of unit length.
            ends: [n_rays, 2] where each part begins and ends, scene units.

        Returns:
            rgb [n_rays, 3], depth [n_rays] and opacity [n_rays].
        """
        rays = self._array(origins, vec3), self._array(directions, vec3)
        between = self._array(ends.clip(0.0, 1e30), vec2)
        dark = replace(self, background=(0.0, 0.0, 0.0))
        return self._rendering(dark._render(*rays, origins, between), (len(origins),))

    @checked_arguments
    def beyond(self, distance: float) -> Field:
        """All of the field that is not nearer than a distance.

        Args:
            distance: From where rays begin, scene units.

        Returns:
            A field with the same storage.

        Raises:
            InputError: It is no distance.
        """
        require_distance(distance)
        if distance <= self.steps.near:
            return self
        return replace(self, steps=replace(self.steps, near=min(distance, 1e30)))

    @checked_arguments
    def up_to(self, distance: float) -> Field:
        """All of the field that is nearer than a distance, marched, also what hardly any light
        passes.

        Args:
            distance: From where rays begin, scene units.

        Returns:
            A field with the same storage.

        Raises:
            InputError: It is no distance.
        """
        require_distance(distance)
        far = min(self.steps.far, distance)
        steps = replace(self.steps, far=far, transmittance_min=0.0)
        return replace(self, steps=steps, proposal=None)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        values = np.ascontiguousarray(values, np.float32)
        return wp.array(values, dtype=dtype, device=self.workers.device)

    def _render(
        self,
        origins: wp.array,
        directions: wp.array,
        places: np.ndarray,
        ends: wp.array | None = None,
    ) -> RenderedRays:
        """Look along rays from some places, [n, 3]; all the way, or between ends, [n_rays] vec2."""
        reach = reach_of_places(self.lattice.box_min, self.lattice.box_max, places)
        steps = self.steps.reaching(reach)
        if self.proposal is None:
            walked = steps if ends is None else ClippedSteps(steps=steps, ends=ends)
            return self._walk(walked, origins, directions)
        n = origins.shape[0]
        proposer = Proposer(min(n, PROPOSED), self.proposal, steps, self.workers)
        seen = RenderedRays.room(n, self.workers)
        for begin in range(0, n, PROPOSED):
            some = slice(begin, min(begin + PROPOSED, n))
            rays = origins[some], directions[some]
            proposer.run(
                self.free,
                rays_struct(assembly, *rays, *self._same_for_all),
                ends=None if ends is None else ends[some],
            )
            seen.write(begin, self._walk(proposer.intervals, *rays))
        return seen

    def _walk(self, steps: AnySteps, origins: wp.array, directions: wp.array) -> RenderedRays:
        """Look along rays through given steps."""
        return render_rays(
            self.model,
            self.storage,
            self.weights,
            self.free,
            steps,
            origins,
            directions,
            *self._same_for_all,
            self.workers,
        )

    @property
    def _same_for_all(self) -> tuple[wp.array, wp.array]:
        """Offsets and background of rays: samples sit in the middles of steps."""
        device = self.workers.device
        return (
            wp.full(1, 0.5, dtype=real, device=device),
            wp.full(1, vec3(*self.background), dtype=vec3, device=device),
        )

    @staticmethod
    def _rendering(rays: RenderedRays, shape: tuple[int, ...]) -> Rendering:
        return Rendering(
            rgb=rays.rgb.numpy().reshape(*shape, 3).clip(0.0, 1.0),  # an MLP may add too much
            depth=rays.depth.numpy().reshape(shape),
            opacity=1.0 - rays.transmittance.numpy().reshape(shape),
        )
