"""An exact ray tracer for convex solids in a closed room, in numpy; light is Lambertian and baked.

Vectors are component-first, [3, ...], inside this module. Light at a surface point depends on the
point alone, never on the viewer: soft shadows and ambient occlusion are evaluated on a lattice that
covers every face, and interpolated linearly, so that all views see the same radiance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from warpnerf.camera import Camera

Vec3 = tuple[float, float, float]

_CHUNK = 1 << 16  # rays per batch of `first_hit`: small enough to stay in cache
_LIFT = 1e-3  # scene units by which rays to lights start above a surface and off its edges
_REACH = 0.7  # scene units: what is farther away leaves the ambient light alone
_OPEN_RAYS = 24  # directions that sample the ambient light


class Rays(NamedTuple):
    """Rays whose directions need not be unit vectors: ``t`` counts lengths of the direction."""

    origins: np.ndarray
    """[3, ...] broadcasts against the directions, scene units."""
    directions: np.ndarray
    """[3, ...]"""
    inverse: np.ndarray
    """[3, ...] 1 / directions, kept finite."""


def make_rays(origins: np.ndarray, directions: np.ndarray) -> Rays:
    """Rays from component-first origins and directions, [3, ...] each."""
    tiny = np.asarray(1e-12, directions.dtype)
    safe = np.where(np.abs(directions) < tiny, np.copysign(tiny, directions), directions)
    return Rays(origins, directions, 1.0 / safe)


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

    @property
    def centre(self) -> np.ndarray:
        """[3] scene units."""
        return (np.array(self.lo) + np.array(self.hi)) / 2

    @property
    def radius(self) -> float:
        """Half the extent along x, scene units."""
        return (self.hi[0] - self.lo[0]) / 2

    def interval(
        self, rays: Rays, axes: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray]:
        """Where each ray enters and leaves the solid, [...] each; enter > leave: it misses."""
        kind = rays.inverse.dtype
        spans = []
        for axis in axes:
            a = (self.lo[axis] - rays.origins[axis]).astype(kind) * rays.inverse[axis]
            b = (self.hi[axis] - rays.origins[axis]).astype(kind) * rays.inverse[axis]
            spans.append((np.minimum(a, b), np.maximum(a, b)))
        enter, leave = spans[0]
        for near, far in spans[1:]:
            enter, leave = np.maximum(enter, near), np.minimum(leave, far)
        return enter, leave

    def hit(self, rays: Rays) -> np.ndarray:
        """First ``t`` on the solid, [...]: infinite where a ray misses, 0 if it starts inside."""
        enter, leave = self.interval(rays)
        return np.where((enter <= leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)

    def faces(self) -> dict[int, Extent]:
        """The extent of each face, by its number."""
        (x0, y0, z0), (x1, y1, z1) = self.lo, self.hi
        sides = ((y0, y1, z0, z1), (x0, x1, z0, z1), (x0, x1, y0, y1))
        return {face: sides[face // 2] for face in range(6)}

    def locate(self, points: np.ndarray) -> Surface:
        """Face, u and v of points [3, n] on the surface."""
        half = (np.array(self.hi) - np.array(self.lo)) / 2
        off = (points - self.centre[:, None].astype(points.dtype)) / half[:, None].astype(
            points.dtype
        )
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
        return np.where((enter < 0.0) & (leave > 0.0), leave, 0.0)

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Box; normals point into the room."""
        points, normals = super().place(face, u, v)
        return points, -normals


class Cylinder(Box):
    """Upright cylinder, touching the sides of its box; faces 0 (curved), 4 and 5 (caps)."""

    def interval(
        self, rays: Rays, axes: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        near, far = _quadric(self.centre[:2], self.radius, rays)
        bottom, top = super().interval(rays, axes=(2,))
        return np.maximum(near, bottom), np.minimum(far, top)

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

    def interval(
        self, rays: Rays, axes: Sequence[int] = (0, 1, 2)
    ) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        return _quadric(self.centre, self.radius, rays)

    def faces(self) -> dict[int, Extent]:
        """See Box."""
        half = np.pi * self.radius
        return {0: (-half, half, -half / 2, half / 2)}

    def locate(self, points: np.ndarray) -> Surface:
        """See Box."""
        x, y, z = (points - self.centre[:, None].astype(points.dtype)) / self.radius
        u, v = np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0))
        return Surface(points, np.zeros(u.shape, np.int32), u * self.radius, v * self.radius)

    def place(self, face: int, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See Box."""
        azimuth, latitude = u / self.radius, v / self.radius
        flat = np.cos(latitude)
        normals = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(latitude)])
        return self.centre[:, None] + self.radius * normals, normals


def _quadric(centre: np.ndarray, radius: float, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """Interval within ``radius`` of ``centre`` [k] in the first k axes: circle or sphere."""
    kind = rays.directions.dtype
    axes = range(len(centre))
    offset = [(rays.origins[k] - centre[k]).astype(kind) for k in axes]
    a = np.maximum(sum(rays.directions[k] ** 2 for k in axes), np.asarray(1e-18, kind))
    b = sum(rays.directions[k] * offset[k] for k in axes)
    below = b * b - a * (sum(o * o for o in offset) - np.asarray(radius**2, kind))
    root = np.sqrt(np.maximum(below, 0.0))
    return np.where(below > 0.0, (-b - root) / a, np.inf).astype(kind), (root - b) / a


@dataclass(frozen=True, kw_only=True, eq=False)
class Light:
    """A light of some size: point sources that add up to it."""

    points: np.ndarray
    """[3, n_points] scene units."""
    facing: Vec3
    """Unit vector into the half space that it lights most, or zeros: it lights all alike."""
    power: Vec3
    """Irradiance rgb at one scene unit, straight ahead, from all points together."""


class Tracer:
    """Solids in a room, with light baked on them: traces distances and draws pictures."""

    def __init__(
        self, solids: Sequence[Box], lights: Sequence[Light], ambient: Vec3, *, spacing: float
    ) -> None:
        """Bake the light.

        Args:
            solids: The room first, then what is in it.
            lights: What shines on them.
            ambient: Light rgb from all around, before occlusion by what is nearby.
            spacing: Largest distance between neighbouring nodes of baked light, scene units.
        """
        self.solids = tuple(solids)
        self._lo = np.array([solid.lo for solid in self.solids])  # [solid, 3]
        self._hi = np.array([solid.hi for solid in self.solids])
        self._opaque = np.array([solid.glow == 0.0 for solid in self.solids])  # [solid]
        self._patch = np.zeros((len(self.solids), 6), np.int32)  # [solid, face] -> column below
        patches: list[tuple[float, ...]] = []
        baked: list[np.ndarray] = []
        start = 0
        for index, solid in enumerate(self.solids):
            for face, (u0, u1, v0, v1) in solid.faces().items():
                nu, nv = (2 + int(length / spacing) for length in (u1 - u0, v1 - v0))
                u, v = np.meshgrid(
                    np.linspace(u0 + _LIFT, u1 - _LIFT, nu), np.linspace(v0 + _LIFT, v1 - _LIFT, nv)
                )
                light = np.full((3, nv, nu), solid.glow)
                if solid.glow == 0.0:
                    nodes = solid.place(face, u.ravel(), v.ravel())
                    light = _smooth(self._light(*nodes, lights, ambient).reshape(3, nv, nu))
                self._patch[index, face] = len(patches)
                patches.append((u0, v0, (nu - 1) / (u1 - u0), (nv - 1) / (v1 - v0), nu, nv, start))
                baked.append(light.reshape(3, -1))
                start += nu * nv
        self._patches = np.array(patches, np.float32).T  # [7, patch]
        self._baked = np.concatenate(baked, axis=1).astype(np.float32)  # [3, node]

    def _light(
        self, points: np.ndarray, normals: np.ndarray, lights: Sequence[Light], ambient: Vec3
    ) -> np.ndarray:
        """Light [3, n] that reaches points [3, n] with normals [3, n]."""
        origins = (points + _LIFT * normals).astype(np.float32)[:, None]
        towards = _hemispheres(normals).astype(np.float32)
        open_t = self._nearest(origins, _REACH * towards)
        total = np.array(ambient)[:, None] * np.minimum(open_t, 1.0).mean(axis=0)
        for light in lights:
            way = light.points[:, :, None].astype(np.float32) - origins
            far = np.sqrt((way * way).sum(axis=0))
            cosine = np.maximum((way * normals[:, None]).sum(axis=0) / far, 0.0)
            if any(light.facing):
                ahead = -(way * np.array(light.facing)[:, None, None]).sum(axis=0) / far
                cosine *= np.maximum(ahead, 0.0)
            if cosine.any():
                seen = self._nearest(origins, way) >= 1.0
                total += np.array(light.power)[:, None] * (seen * cosine / far**2).mean(axis=0)
        return total

    def _nearest(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Least ``t`` in [0, 1] at which rays [3, m, n] meet a solid; 1 where they meet none."""
        rays = make_rays(origins, directions)
        ends = origins + directions
        lo = np.minimum(ends, origins).min(axis=(1, 2))
        hi = np.maximum(ends, origins).max(axis=(1, 2))
        nearest = np.ones(directions.shape[1:], np.float32)
        close = self._opaque & ((lo <= self._hi) & (hi >= self._lo)).all(axis=1)
        for index in np.flatnonzero(close):
            np.minimum(nearest, self.solids[index].hit(rays), out=nearest)
        return nearest

    def _baked_light(self, index: int, at: Surface) -> np.ndarray:
        """Light [3, n] at points of a solid, interpolated between nodes."""
        u0, v0, ku, kv, nu, nv, start = self._patches[:, self._patch[index, at.face]]
        x = np.clip((at.u - u0) * ku, 0.0, nu - 1.001)
        y = np.clip((at.v - v0) * kv, 0.0, nv - 1.001)
        i, j = x.astype(np.int32), y.astype(np.int32)
        x, y, row = x - i, y - j, nu.astype(np.int32)
        node = start.astype(np.int32) + j * row + i
        take = self._baked.take
        low = take(node, axis=1) * (1 - x) + take(node + 1, axis=1) * x
        node += row
        return low * (1 - y) + (take(node, axis=1) * (1 - x) + take(node + 1, axis=1) * x) * y

    def _trace(self, camera: Camera, samples: int, kind: type) -> tuple[np.ndarray, ...]:
        """Directions [3, H s, W s] of one unit along the axis, their ``t``, and the solid hit."""
        rotation, position = camera.c2w[:, :3], camera.c2w[:, 3]
        x = ((np.arange(camera.width * samples) + 0.5) / samples - camera.cx) / camera.fx
        y = (camera.cy - (np.arange(camera.height * samples) + 0.5) / samples) / camera.fy
        right, up, back = (rotation[:, axis, None, None] for axis in range(3))
        rays = make_rays(position[:, None, None], (right * x + up * y[:, None] - back).astype(kind))
        nearest: np.ndarray = np.full(rays.directions.shape[1:], np.inf, kind)
        which = np.zeros(nearest.shape, np.uint8)
        for index, part in self._footprints(camera, samples):
            rows, columns = part
            t = self.solids[index].hit(Rays(rays.origins, *(a[:, rows, columns] for a in rays[1:])))
            closer = t < nearest[part]
            np.copyto(nearest[part], t, where=closer)
            np.copyto(which[part], np.uint8(index), where=closer)
        return rays.directions, nearest, which

    def _footprints(
        self, camera: Camera, samples: int
    ) -> Iterator[tuple[int, tuple[slice, slice]]]:
        """Solids that may be in sight, each with the rows and columns of samples it may cover."""
        corner = np.indices((2, 2, 2)).reshape(3, 8).T == 1
        corners = np.where(corner, self._hi[:, None], self._lo[:, None])  # [solid, 8, 3]
        x, y, z = np.moveaxis((corners - camera.position) @ camera.c2w[:, :3], 2, 0)
        ahead = z.max(axis=1) < -1e-3  # entirely; else its outline may be anywhere
        z = np.minimum(z, -1e-3)
        outline = []
        for at, count in (
            (camera.cy + camera.fy * y / z, camera.height),
            (camera.cx - camera.fx * x / z, camera.width),
        ):
            low, high = at.min(axis=1) * samples - 1, at.max(axis=1) * samples + 2
            low, high = np.where(ahead, low, 0), np.where(ahead, high, count * samples)
            outline += [np.clip(edge, 0, count * samples).astype(int) for edge in (low, high)]
        top, bottom, left, right = outline
        for index in np.flatnonzero((top < bottom) & (left < right) & (z.min(axis=1) < -1e-3)):
            yield (
                int(index),
                (slice(top[index], bottom[index]), slice(left[index], right[index])),
            )

    def depth(self, camera: Camera) -> np.ndarray:
        """Distance to the first surface along the ray through each pixel's centre.

        Returns:
            [H, W] float32, scene units, traced in double precision.
        """
        directions, t, _ = self._trace(camera, 1, np.float64)
        return (t * np.linalg.norm(directions, axis=0)).astype(np.float32)

    def image(self, camera: Camera, samples: int) -> np.ndarray:
        """What the camera sees, averaged over samples x samples rays in each pixel.

        Returns:
            [H, W, 3] uint8 rgb, gamma 2.2.
        """
        directions, t, which = self._trace(camera, samples, np.float32)
        order = np.argsort(which.ravel(), kind="stable")
        points = directions.reshape(3, -1)[:, order] * t.ravel()[order]
        points += camera.position[:, None].astype(np.float32)
        radiance = np.empty_like(points)
        ends = np.cumsum(np.bincount(which.ravel(), minlength=len(self.solids)))
        for index, end in enumerate(ends):
            part = slice(ends[index - 1] if index else 0, end)
            if part.start < part.stop:
                at = self.solids[index].locate(points[:, part])
                light = self._baked_light(index, at)
                radiance[:, order[part]] = light * self.solids[index].texture(at)
        radiance = radiance.reshape(3, camera.height, samples, camera.width, samples)
        display = np.clip(radiance.mean(axis=(2, 4)), 0.0, 1.0) ** (1 / 2.2)
        return np.ascontiguousarray(np.rint(display * 255).astype(np.uint8).transpose(1, 2, 0))

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Distance to the first surface, in double precision.

        Args:
            origins: [n, 3] scene units.
            directions: [n, 3] unit vectors.

        Returns:
            [n] float64 scene units; 0 for a ray that starts inside a solid or outside the room.
        """
        nearest = np.empty(len(origins))
        for start in range(0, len(origins), _CHUNK):
            part = slice(start, start + _CHUNK)
            rays = make_rays(
                *(np.asarray(a[part], np.float64).T.copy() for a in (origins, directions))
            )
            nearest[part] = np.min([solid.hit(rays) for solid in self.solids], axis=0)
        return nearest


def _hemispheres(normals: np.ndarray) -> np.ndarray:
    """Unit vectors [3, m, n] around normals [3, n], on a spiral, dense as the cosine."""
    k = np.arange(_OPEN_RAYS) + 0.5
    radius, angle = np.sqrt(k / _OPEN_RAYS), k * np.pi * (3 - np.sqrt(5.0))
    helper = np.where(np.abs(normals[2]) > 0.9, [[1.0], [0.0], [0.0]], [[0.0], [0.0], [1.0]])
    right = np.cross(helper, normals, axis=0)
    right /= np.linalg.norm(right, axis=0)
    up = np.cross(normals, right, axis=0)
    across = (radius * np.cos(angle))[:, None] * right[:, None]
    across = across + (radius * np.sin(angle))[:, None] * up[:, None]
    return across + np.sqrt(1 - radius**2)[:, None] * normals[:, None]


def _smooth(light: np.ndarray) -> np.ndarray:
    """Binomial filter over nodes [3, nv, nu]: joins the steps of shadows of point sources."""
    for axis in (1, 2):
        size = light.shape[axis]
        lower = light.take(np.maximum(np.arange(size) - 1, 0), axis=axis)
        upper = light.take(np.minimum(np.arange(size) + 1, size - 1), axis=axis)
        light = (lower + 2 * light + upper) / 4
    return light
