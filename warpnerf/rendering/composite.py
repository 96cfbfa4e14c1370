"""Several fields as one: each is seen within a cell of its own, and the cells fill space."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from warpnerf.checked import checked, checked_arguments
from warpnerf.checks import InputError, require_rays, said
from warpnerf.rendering.field import Field, Rendering, checked_crop, require_distance
from warpnerf.rendering.rays import camera_rays
from warpnerf.runtime.parallel import Workers
from warpnerf.scenes.cameras.camera import Camera

CROSSINGS = 1 << 22
"""Pairs of a ray and a cell that are looked at together."""

Member = Callable[[], Field]
"""One of the fields, loaded when it is first seen."""


@checked("CompositeField")
@dataclass(frozen=True, kw_only=True, eq=False)
class CompositeField:
    """A radiance field put together from several, composited front to back.

    Along a ray a field counts only within its cell. Cells are disjoint and convex, so parts of a
    ray in different cells have an order, and nothing is counted twice.
    """

    cells: np.ndarray
    """[n, 2, 3] float64, lower and upper corners of the cells, scene units; may be infinite. The
    lower faces belong to them, the upper ones do not."""
    members: Sequence[Member]
    """[n] the field of each cell; all have one background."""
    surroundings: tuple[np.ndarray, np.ndarray]
    """Corners, [3] scene units, of a box around what they hold."""
    background: tuple[float, float, float]
    """rgb in [0, 1], seen where rays pass through."""
    transmittance_min: float
    """A ray ends where less light than this would pass."""
    workers: Workers
    """The device that all are on."""
    near: float = 0.0
    """Nothing is seen that is nearer, scene units."""
    far: float = np.inf
    """Nothing is seen at or beyond it, scene units; nor what a field's own steps do not reach."""

    @property
    def in_ndc(self) -> bool:
        """Whether steps are lengths in normalised device coordinates: never."""
        return False

    def __post_init__(self) -> None:
        """Refuse what is no field.

        Raises:
            InputError: Cells are no boxes, or not one for each member.
        """
        shape = (len(self.members), 2, 3)
        if self.cells.shape != shape or not (self.cells[:, 0] < self.cells[:, 1]).all():
            raise InputError(
                f"CompositeField.cells must be {list(shape)}, a lower corner below an upper one "
                f"for each of {shape[0]} members, not {said(self.cells)}."
            )

    @checked_arguments
    def cropped(self, low: Sequence[float], high: Sequence[float]) -> CompositeField:
        """Crop to a box: rays see nothing outside of it.

        Args:
            low: Lower corner, [3] scene units.
            high: Upper corner, above the lower one.

        Returns:
            The part of it within the box, to its faces.

        Raises:
            InputError: It is no box.
        """
        box = checked_crop(low, high)
        cells = np.stack(
            [np.maximum(self.cells[:, 0], box[0]), np.minimum(self.cells[:, 1], box[1])], axis=1
        )
        kept = np.flatnonzero((cells[:, 0] < cells[:, 1]).all(axis=1))
        return replace(self, cells=cells[kept], members=[self.members[int(k)] for k in kept])

    @checked_arguments
    def beyond(self, distance: float) -> CompositeField:
        """All that is not nearer than a distance, see ``Field.beyond``.

        Args:
            distance: From where rays begin, scene units.

        Returns:
            The same fields, from there on.

        Raises:
            InputError: It is no distance.
        """
        require_distance(distance)
        return replace(self, near=max(self.near, distance))

    @checked_arguments
    def up_to(self, distance: float) -> CompositeField:
        """All that is nearer than a distance, see ``Field.up_to``.

        Args:
            distance: From where rays begin, scene units.

        Returns:
            The same fields, nearer than that.

        Raises:
            InputError: It is no distance.
        """
        require_distance(distance)
        members = [partial(_marched, member) for member in self.members]
        far = min(self.far, distance)
        return replace(self, members=members, far=far, transmittance_min=0.0)

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
        camera.check()
        origins, directions = (rays.numpy() for rays in camera_rays(camera, self.workers))
        seen = self._render(origins, directions)
        shape = camera.height, camera.width
        return Rendering(
            rgb=seen.rgb.reshape(*shape, 3),
            depth=seen.depth.reshape(shape),
            opacity=seen.opacity.reshape(shape),
        )

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
        return self._render(origins, directions)

    def render_between(
        self, origins: np.ndarray, directions: np.ndarray, ends: np.ndarray
    ) -> Rendering:
        """Render parts of rays, over black, see ``Field.render_between``.

        Args:
            origins: [n_rays, 3], scene units.
            directions: [n_rays, 3] of unit length.
            ends: [n_rays, 2] where each part begins and ends, scene units.

        Returns:
            rgb [n_rays, 3], depth [n_rays] and opacity [n_rays].
        """
        return replace(self, background=(0.0, 0.0, 0.0))._render(origins, directions, ends)

    def _render(
        self, origins: np.ndarray, directions: np.ndarray, ends: np.ndarray | None = None
    ) -> Rendering:
        """Composite the parts of rays.

        rgb = sum_j T_j rgb_j + T_end background,  T_{j+1} = T_j T of part j,

        as volume rendering is over the samples of the whole ray.
        """
        n = len(origins)
        rgb, depth = np.zeros((n, 3), np.float32), np.zeros(n, np.float32)
        light = np.ones(n, np.float32)
        at_once = max(1, CROSSINGS // max(1, len(self.cells)))
        for begin in range(0, n, at_once):
            some = slice(begin, begin + at_once)
            within = None if ends is None else ends[some]
            of_rays = origins[some], directions[some], light[some]
            for rays, number, cut in self._parts(*of_rays, within):
                rays = rays + begin
                part = self.members[number]().render_between(origins[rays], directions[rays], cut)
                rgb[rays] += light[rays, None] * part.rgb
                depth[rays] += light[rays] * part.depth
                light[rays] *= 1.0 - part.opacity
        rgb += light[:, None] * np.array(self.background, np.float32)
        return Rendering(rgb=rgb.clip(0.0, 1.0), depth=depth, opacity=1.0 - light)

    def _parts(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        light: np.ndarray,
        within: np.ndarray | None,
    ) -> Iterator[tuple[np.ndarray, int, np.ndarray]]:
        """Parts of rays in cells, those nearer to where a ray begins first.

        Args:
            origins: [n, 3]
            directions: [n, 3]
            light: [n] that passes all parts that were given so far; rays without end there.
            within: [n, 2] where rays begin and end, scene units; None: nowhere.

        Yields:
            Indices [m] of rays, the number of a cell, and their ends there, [m, 2] scene units.
        """
        enter, leave = crossings(self.cells, origins, directions)
        enter, leave = np.maximum(enter, self.near), np.minimum(leave, self.far)
        if within is not None:
            enter, leave = np.maximum(enter, within[:, 0]), np.minimum(leave, within[:, 1])
        enter[enter >= leave] = np.inf
        order = np.argsort(enter, axis=0, kind="stable")
        for number in range(len(self.cells)):
            nearest = order[number]
            there = np.isfinite(enter[nearest, np.arange(len(nearest))])
            if not there.any():
                return
            for cell in np.unique(nearest[there]):
                alive = light >= self.transmittance_min
                rays = np.flatnonzero(there & (nearest == cell) & alive)
                if len(rays):
                    yield rays, int(cell), np.stack([enter[cell, rays], leave[cell, rays]], axis=1)


AnyField = Field | CompositeField
"""What can be rendered."""


def crossings(
    cells: np.ndarray, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where rays enter and leave boxes.

    Two boxes with a common face have the same distance for it, to the bit.

    Args:
        cells: [n_cells, 2, 3] lower and upper corners, which may be infinite.
        origins: [n, 3]
        directions: [n, 3]

    Returns:
        [n_cells, n] float64 distances, at least 0; a ray misses a box that it does not leave
        later than it enters it.
    """
    enter = np.zeros((len(cells), len(origins)))
    leave = np.full((len(cells), len(origins)), np.inf)
    for axis in range(3):
        origin, direction = origins[:, axis].astype(np.float64), directions[:, axis]
        low, high = cells[:, 0, axis, None], cells[:, 1, axis, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (low - origin) / direction, (high - origin) / direction
        along = direction == 0.0
        a = np.where(along, np.where(low <= origin, -np.inf, np.inf), a)
        b = np.where(along, np.where(origin < high, np.inf, -np.inf), b)
        enter = np.maximum(enter, np.minimum(a, b))
        leave = np.minimum(leave, np.maximum(a, b))
    return enter, leave


def _marched(member: Member) -> Field:
    """All that a field holds, as ``Field.up_to`` has it."""
    return member().up_to(np.inf)
