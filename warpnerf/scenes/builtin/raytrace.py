"""An exact ray tracer for convex solids in a closed room, in numpy; light is Lambertian and baked.

Vectors are component-first, [3, ...], inside this module. Light at a surface point depends on the
point alone, never on the viewer: soft shadows and ambient occlusion are evaluated on a lattice that
covers every face, and interpolated linearly, so that all views see the same radiance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.builtin.solids import Box, Surface, Vec3, make_rays
from warpnerf.scenes.cameras.camera import Camera

Item = TypeVar("Item")
Result = TypeVar("Result")

_CHUNK = 1 << 16  # rays per batch of `first_hit`: small enough to stay in cache
_LIFT = 1e-3  # scene units by which rays to lights start above a surface and off its edges
_REACH = 0.7  # scene units: what is farther away leaves the ambient light alone
_OPEN_RAYS = 24  # directions that sample the ambient light
_GROUP = 2048  # nodes that are lit together: enough to make numpy's calls worth while
_CELL = 1.0  # scene units: nodes that are lit together are about as near to each other
_PIECES = 4  # of rays to lights, each compared with the solids' boxes
_ROUNDING = 1e-4  # scene units by which boxes are larger then, so that no hit is lost
_AHEAD = 1e-6  # scene units in front of a camera where outlines are cut off
_EDGES = np.array([(a, a + bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]).T


def in_threads(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Do the work for each item, on all cores: numpy lets go of Python's lock.

    Returns:
        The results in the order of the items. They do not depend on the number of threads.
    """
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(work, items))


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
        self._patches = np.zeros((len(self.solids), 7, 6), np.float32)  # see _baked_light
        lattices: list[tuple[slice, int, int]] = []
        nodes: list[tuple[np.ndarray, np.ndarray]] = []
        glow: list[np.ndarray] = []
        start = 0
        for index, solid in enumerate(self.solids):
            for face, (u0, u1, v0, v1) in solid.faces().items():
                nu, nv = (2 + int(length / spacing) for length in (u1 - u0, v1 - v0))
                density = (nu - 1) / (u1 - u0), (nv - 1) / (v1 - v0)
                self._patches[index, :, face] = u0, v0, *density, nu, nv, start
                u, v = np.meshgrid(
                    np.linspace(u0 + _LIFT, u1 - _LIFT, nu), np.linspace(v0 + _LIFT, v1 - _LIFT, nv)
                )
                nodes.append(solid.place(face, u.ravel(), v.ravel()))
                glow.append(np.full(nu * nv, solid.glow))
                lattices.append((slice(start, start + nu * nv), nv, nu))
                start += nu * nv
        points, normals = np.concatenate(nodes, axis=-1)
        baked = np.tile(np.concatenate(glow), (3, 1))  # [3, node]
        lit = np.flatnonzero(baked[0] == 0.0)
        baked[:, lit] = self._bake(points.take(lit, 1), normals.take(lit, 1), lights, ambient)
        for part, nv, nu in lattices:
            baked[:, part] = _smooth(baked[:, part].reshape(3, nv, nu)).reshape(3, -1)
        self._baked = baked.astype(np.float32)

    def _bake(
        self, points: np.ndarray, normals: np.ndarray, lights: Sequence[Light], ambient: Vec3
    ) -> np.ndarray:
        """Light [3, n] at nodes [3, n]; just the ambient where a face lies against a wall."""
        above = points + _LIFT * normals
        low, high = (corners[0][:, None] for corners in (self._lo, self._hi))
        inside = np.flatnonzero(((above > low) & (above < high)).all(axis=0))
        by_cell = inside[np.lexsort(np.floor(points.take(inside, 1) / _CELL))]
        groups = np.array_split(by_cell, 1 + len(by_cell) // _GROUP)

        def work(group: np.ndarray) -> np.ndarray:
            return self._light(points.take(group, 1), normals.take(group, 1), lights, ambient)

        light = np.tile(np.array(ambient)[:, None], len(points[0]))
        light[:, by_cell] = np.concatenate(in_threads(work, groups), axis=1)
        return light

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
            lit = np.flatnonzero(cosine.any(axis=0))
            if lit.size:
                far, cosine = far.take(lit, axis=1), cosine.take(lit, axis=1)
                seen = self._nearest(origins.take(lit, axis=2), way.take(lit, axis=2)) >= 1.0
                share = (seen * cosine / far**2).mean(axis=0)
                total[:, lit] += np.array(light.power)[:, None] * share
        return total

    def _nearest(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Least ``t`` in [0, 1] at which rays [3, m, n] meet a solid; 1 where they meet none.

        Args:
            origins: [3, 1, n] scene units.
            directions: [3, m, n] to where the rays end, scene units.
        """
        rays = make_rays(origins, directions)
        nearest = np.ones(directions.shape[1:], np.float32)
        in_reach = self._in_reach(origins, directions)
        for index in np.flatnonzero(in_reach.any(axis=1)):
            columns = np.flatnonzero(in_reach[index])
            part = slice(None), slice(columns[0], columns[-1] + 1)
            np.fmin(nearest[part], self.solids[index].hit(rays.within(*part)), out=nearest[part])
        return nearest

    def _in_reach(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Which opaque solids the rays of ``_nearest`` may meet, [solid, n]."""
        share = np.linspace(0.0, 1.0, 1 + _PIECES, dtype=np.float32)[:, None]
        low = origins + share * directions.min(axis=1, keepdims=True)  # [3, end of piece, n]
        high = origins + share * directions.max(axis=1, keepdims=True)
        low, high = np.minimum(low[:, 1:], low[:, :-1]), np.maximum(high[:, 1:], high[:, :-1])
        lo, hi = self._lo - _ROUNDING, self._hi + _ROUNDING
        about = (low.min(axis=(1, 2)) <= hi) & (high.max(axis=(1, 2)) >= lo)
        near = np.flatnonzero(about.all(axis=1) & self._opaque)
        lo, hi = (corners[near].T[..., None, None] for corners in (lo, hi))
        meets = (low[:, None] <= hi) & (high[:, None] >= lo)  # [3, solid, piece, n]
        found = np.zeros((len(self.solids), low.shape[2]), bool)
        found[near] = meets.all(axis=0).any(axis=1)
        return found

    def _baked_light(self, index: int, at: Surface) -> np.ndarray:
        """Light [3, n] at points of a solid, interpolated between nodes."""
        u0, v0, ku, kv, nu, nv, start = self._patches[index].take(at.face, axis=1)
        x = np.clip((at.u - u0) * ku, 0.0, nu - 1.001)
        y = np.clip((at.v - v0) * kv, 0.0, nv - 1.001)
        i, j = x.astype(np.int32), y.astype(np.int32)
        x, y, row = x - i, y - j, nu.astype(np.int32)
        node = (start.astype(np.int32) + j * row + i).astype(np.intp)
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
            t = self.solids[index].hit(rays.within(*part))
            closer = t < nearest[part]
            np.fmin(nearest[part], t, out=nearest[part])
            np.maximum(which[part], closer * np.uint8(index), out=which[part])  # they ascend
        return rays.directions, nearest, which

    def _footprints(
        self, camera: Camera, samples: int
    ) -> Iterator[tuple[int, tuple[slice, slice]]]:
        """Solids that may be in sight, each with the rows and columns of samples it may cover."""
        corner = np.indices((2, 2, 2)).reshape(3, 8).T == 1
        corners = np.where(corner, self._hi[:, None], self._lo[:, None])  # [solid, 8, 3]
        local = (corners - camera.position) @ camera.c2w[:, :3]
        one, other = local[:, _EDGES[0]], local[:, _EDGES[1]]  # [solid, 12, 3]
        slope = np.where(one[..., 2] == other[..., 2], np.inf, other[..., 2] - one[..., 2])
        share = np.clip((-_AHEAD - one[..., 2]) / slope, 0.0, 1.0)  # where edges are cut off
        local = np.concatenate([local, one + share[..., None] * (other - one)], axis=1)
        ahead = local[..., 2] < -_AHEAD / 2  # [solid, 20]
        x, y = np.moveaxis(local[..., :2] / np.minimum(local[..., 2:], -_AHEAD / 2), 2, 0)
        outline = []
        for at, count in (
            (camera.cy + camera.fy * y, camera.height * samples),
            (camera.cx - camera.fx * x, camera.width * samples),
        ):
            low = np.where(ahead, at, np.inf).min(axis=1) * samples - 1
            high = np.where(ahead, at, -np.inf).max(axis=1) * samples + 2
            outline += [np.clip(edge, 0, count).astype(int) for edge in (low, high)]
        top, bottom, left, right = outline
        for index in np.flatnonzero((top < bottom) & (left < right)):
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
        order = np.argsort(which, axis=None, kind="stable")
        points = directions.reshape(3, -1).take(order, axis=1) * t.take(order)
        points += camera.position[:, None].astype(np.float32)
        radiance = np.empty_like(points)
        start = 0
        for index, n in enumerate(np.bincount(which.ravel(), minlength=len(self.solids))):
            if n:
                part = slice(start, start + n)
                at = self.solids[index].locate(points[:, part])
                light = self._baked_light(index, at)
                np.multiply(light, self.solids[index].texture(at), out=radiance[:, part])
            start += n
        back = np.empty_like(order)
        back[order] = np.arange(order.size)
        radiance = radiance.take(back, axis=1)
        pixels = radiance.reshape(3, camera.height, samples, camera.width, samples)
        total = sum(pixels[:, :, i, :, j] for i in range(samples) for j in range(samples))
        display = np.clip(total / np.float32(samples**2), 0.0, 1.0) ** (1 / 2.2)
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
            nearest[part] = np.fmin.reduce([solid.hit(rays) for solid in self.solids])
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
