"""Convex solids, where rays meet them, and the coordinates of points on their faces, in numpy.

Vectors are component-first, [3, ...]. Built for speed: numpy is quick on whole arrays and slow at
choosing between two, so a miss is not replaced by a number but divided by zero.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

Vec3 = tuple[float, float, float]


class Rays(NamedTuple):
    """Rays whose directions need not be unit vectors: ``t`` counts lengths of the direction."""

    origins: np.ndarray
    """[3, ...] broadcasts against the directions, scene units."""
    directions: np.ndarray
    """[3, ...]"""
    inverse: np.ndarray
    """[3, ...] 1 / directions, kept finite."""
    squares: np.ndarray
    """[2, ...] squared lengths of the horizontal part and of the whole, kept positive."""

    def within(self, rows: slice, columns: slice) -> Rays:
        """Some of the rays [3, rows, columns] whose origins are one, or one for each column."""
        origins = self.origins if self.origins.shape[2] == 1 else self.origins[..., columns]
        return Rays(origins, *(a[:, rows, columns] for a in self[1:]))


def make_rays(origins: np.ndarray, directions: np.ndarray) -> Rays:
    """Rays from component-first origins and directions, [3, ...] each."""
    tiny = np.asarray(1e-12, directions.dtype)
    level = np.abs(directions) < tiny
    safe = np.where(level, np.copysign(tiny, directions), directions) if level.any() else directions
    x, y, z = directions
    squares = np.empty((2, *x.shape), x.dtype)
    np.add(x * x, y * y, out=squares[0])
    np.add(squares[0], z * z, out=squares[1])
    np.maximum(squares, np.asarray(1e-18, x.dtype), out=squares)
    return Rays(origins, directions, 1.0 / safe, squares)


class Surface(NamedTuple):
    """Points on one solid, with the coordinates in which textures and light are expressed."""

    points: np.ndarray
    """[3, n] scene units."""
    face: np.ndarray
    """[n] int32: 0 -x, 1 +x, 2 -y, 3 +y, 4 -z, 5 +z; 0 where a face is curved."""
    u: np.ndarray
    """[n] scene units along the face: horizontal, or around the vertical axis."""
    v: np.ndarray
    """[n] scene units along the face: up; y on horizontal faces."""


Texture = Callable[[Surface], np.ndarray]
"""Albedo [3, n] in [0, 1], linear light, at points of a surface."""

Extent = tuple[float, float, float, float]
"""The rectangle u0, u1, v0, v1 that a face covers, scene units."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """Axis-aligned opaque box, and the base of the solids that touch all its sides."""

    lo: Vec3
    """Lower corner, scene units."""
    hi: Vec3
    """Upper corner, scene units."""
    texture: Texture
    """Albedo of its surface."""
    glow: float = 0.0
    """Radiance per albedo of a lamp or window, which is not lit and casts no shadow; 0: lit."""

    @cached_property
    def centre(self) -> np.ndarray:
        """[3] scene units."""
        return (np.array(self.lo) + np.array(self.hi)) / 2

    @cached_property
    def radius(self) -> float:
        """Half the extent along x, scene units."""
        return (self.hi[0] - self.lo[0]) / 2

    def interval(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """Where each ray enters and leaves the solid, [...] each, new; it misses unless <=."""
        return self._slabs(rays, slice(None))

    def _slabs(self, rays: Rays, axes: slice) -> tuple[np.ndarray, np.ndarray]:
        """Where each ray enters and leaves the space between the box's sides along some axes."""
        origins, inverse = rays.origins[axes], rays.inverse[axes]
        a, b = (
            (_column(np.array(corner[axes]), origins) - origins).astype(inverse.dtype) * inverse
            for corner in (self.lo, self.hi)
        )
        near, far = np.minimum(a, b), np.maximum(a, b, out=a)
        return np.maximum.reduce(near), np.minimum.reduce(far)

    @np.errstate(divide="ignore", invalid="ignore")
    def hit(self, rays: Rays) -> np.ndarray:
        """First ``t`` on the solid, [...]: 0 if a ray starts inside, not finite if it misses."""
        enter, leave = self.interval(rays)
        met = enter <= leave
        met &= leave > 0.0
        np.maximum(enter, np.zeros_like(enter), out=enter)
        return np.divide(enter, met, out=enter)  # by 1 or 0

    def faces(self) -> dict[int, Extent]:
        """The extent of each face, by its number."""
        (x0, y0, z0), (x1, y1, z1) = self.lo, self.hi
        sides = ((y0, y1, z0, z1), (x0, x1, z0, z1), (x0, x1, y0, y1))
        return {face: sides[face // 2] for face in range(6)}

    def locate(self, points: np.ndarray) -> Surface:
        """Face, u and v of points [3, n] on the surface."""
        half = (np.array(self.hi) - np.array(self.lo)) / 2
        off = (points - _column(self.centre, points)) / _column(half, points)
        size = np.abs(off)
        is_z = (size[2] > size[0]) & (size[2] > size[1])
        is_x = ~is_z & (size[0] > size[1])
        upper = np.where(is_x, off[0], np.where(is_z, off[2], off[1])) > 0.0
        face = (2 - 2 * is_x + 2 * is_z + upper).astype(np.int32)
        u = np.where(is_x, points[1], points[0])
        return Surface(points, face, u, np.where(is_z, points[1], points[2]))

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and outward unit normals, [3, n] each, at coordinates of a face."""
        axis, upper = divmod(face, 2)
        plane = np.full_like(u, (self.lo, self.hi)[upper][axis])
        normals = np.zeros((3, *u.shape))
        normals[axis] = 2 * upper - 1
        return np.stack([(plane, u, v), (u, plane, v), (u, v, plane)][axis]), normals


class Room(Box):
    """The hollow of a box, seen from inside: floor, ceiling and walls."""

    def hit(self, rays: Rays) -> np.ndarray:
        """See Box; 0 for a ray that starts outside the room."""
        enter, leave = self.interval(rays)
        return np.maximum(leave, np.zeros_like(leave), out=leave) * (enter < 0.0)

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Box; normals point into the room."""
        points, normals = super().place(face, u, v)
        return points, -normals


class Cylinder(Box):
    """Upright cylinder, touching the sides of its box; faces 0 (curved), 4 and 5 (caps)."""

    def interval(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        near, far = _quadric(self.centre[:2], self.radius, rays)
        bottom, top = self._slabs(rays, slice(2, 3))
        return np.maximum(near, bottom, out=near), np.minimum(far, top, out=far)

    def faces(self) -> dict[int, Extent]:
        """See Box."""
        half = np.pi * self.radius
        caps = super().faces()
        return {0: (-half, half, self.lo[2], self.hi[2]), 4: caps[4], 5: caps[5]}

    def locate(self, points: np.ndarray) -> Surface:
        """See Box."""
        x, y, z = points
        dx, dy = x - float(self.centre[0]), y - float(self.centre[1])
        depth = self.radius - np.hypot(dx, dy)
        face = np.where(z - self.lo[2] < depth, 4, np.where(self.hi[2] - z < depth, 5, 0))
        u = np.where(face == 0, np.arctan2(dy, dx) * self.radius, x)
        return Surface(points, face.astype(np.int32), u, np.where(face == 0, z, y))

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        if face != 0:
            return super().place(face, u, v)
        angle = u / self.radius
        normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(u)])
        x, y = self.radius * normals[:2] + self.centre[:2, None]
        return np.stack([x, y, v]), normals


class Ball(Box):
    """Sphere, touching the sides of its box; (u, v) = (azimuth, latitude) times radius."""

    def interval(self, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        return _quadric(self.centre, self.radius, rays)

    def faces(self) -> dict[int, Extent]:
        """See Box."""
        half = np.pi * self.radius
        return {0: (-half, half, -half / 2, half / 2)}

    def locate(self, points: np.ndarray) -> Surface:
        """See Box."""
        x, y, z = (points - _column(self.centre, points)) / self.radius
        u, v = np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))
        return Surface(points, np.zeros(u.shape, np.int32), u * self.radius, v * self.radius)

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        azimuth, latitude = u / self.radius, v / self.radius
        flat = np.cos(latitude)
        normals = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(latitude)])
        return self.centre[:, None] + self.radius * normals, normals


def _column(values: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Values [k] as an array [k, 1, ...] of the kind and number of axes of another."""
    return values.astype(like.dtype).reshape(-1, *(1,) * (like.ndim - 1))


def _quadric(centre: np.ndarray, radius: float, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Interval within ``radius`` of ``centre`` [k] in the first k axes: circle or sphere.

    The roots of a t^2 + 2 b t + c; nan, which is not <= anything, where there are not two.
    """
    k = len(centre)
    kind = rays.directions.dtype
    origins = rays.origins[:k]
    offset = (origins - centre.reshape(-1, *(1,) * (origins.ndim - 1))).astype(kind)
    a, minus_b = rays.squares[k - 2], -np.add.reduce(rays.directions[:k] * offset)
    below = minus_b * minus_b - a * (np.add.reduce(offset * offset) - np.asarray(radius**2, kind))
    np.divide(below, below > 0.0, out=below)
    root = np.sqrt(below, out=below)
    enter = np.divide(minus_b - root, a)
    return enter, np.divide(np.add(root, minus_b, out=root), a, out=root)
