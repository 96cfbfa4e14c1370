"""The built-in scene "builtin:room": a furnished room, traced exactly, with true depth.

Some things stand within half a metre of some cameras and metres away from others, which is where
radiance fields trained without gradient scaling grow floaters. Lengths are metres; z is up; the
sofa is along the wall at -x, the window at +x, the bookshelf at +y, the plant in the corner at -y.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from warpnerf.camera import Camera
from warpnerf.checks import InputError, require_rays
from warpnerf.data.raytrace import Ball, Box, Cylinder, Light, Room, Surface, Texture, Tracer, Vec3
from warpnerf.scene import Scene, View

WIDTH, HEIGHT = 160, 120
FIELD_OF_VIEW = np.radians(65.0)  # horizontal
ROOM_MIN: Vec3 = (-2.0, -2.5, 0.0)
ROOM_MAX: Vec3 = (2.0, 2.5, 2.6)
MARGIN = 0.05  # metres of the scene's box outside the walls


# --- Textures: albedo as a function of the surface point -------------------------------------


def _hash(i: np.ndarray, j: np.ndarray | int) -> np.ndarray:
    """Pseudo-random numbers in [0, 1) that depend on two integers alone."""
    h = np.asarray(i).astype(np.uint32) * np.uint32(0x9E3779B1)
    h = h ^ np.asarray(j).astype(np.uint32) * np.uint32(0x85EBCA77)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
    h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return (h >> np.uint32(8)).astype(np.float32) / np.float32(1 << 24)


@lru_cache(maxsize=1)
def _noise_table(size: int = 512) -> np.ndarray:
    """Periodic value noise [size, size] in [0, 1]: octaves of 8 to 128 cells."""
    total = np.zeros((size, size), np.float32)
    for octave, cells in enumerate((8, 16, 32, 64, 128)):
        at = np.arange(size) * cells / size
        i = at.astype(int)
        w = (at - i) ** 2 * (3 - 2 * (at - i))
        near, far = i, (i + 1) % cells
        lattice = _hash(np.arange(cells)[:, None] + 977 * octave, np.arange(cells))
        rows = lattice[near] * (1 - w[:, None]) + lattice[far] * w[:, None]
        total += 0.6**octave * (rows[:, near] * (1 - w) + rows[:, far] * w)
    return (total - total.min()) / (total.max() - total.min())


def _noise(u: np.ndarray, v: np.ndarray, size: float) -> np.ndarray:
    """Value noise in [0, 1] that repeats after ``size`` metres, with detail down to 1/128 of it."""
    table = _noise_table()
    scale = len(table) / size
    i, j = ((a * scale).astype(np.int32) & (len(table) - 1) for a in (u, v))
    return table[j, i]


def _linear(colour: str) -> np.ndarray:
    """Linear rgb [3, 1] of a display colour such as "c08040"."""
    rgb = np.array([int(colour[k : k + 2], 16) for k in (0, 2, 4)], np.float32)
    return ((rgb / 255) ** 2.2)[:, None].astype(np.float32)


def _mix(a: np.ndarray, b: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """a [3, 1 or n] where weight [n] is 0 (or False), b where it is 1."""
    return a + (b - a) * np.asarray(weight, np.float32)


def _tint(rgb: np.ndarray, u: np.ndarray, v: np.ndarray, size: float, amount: float) -> np.ndarray:
    """Darken and lighten a colour by noise."""
    return rgb * (1 - amount + 2 * amount * _noise(u, v, size))


def plain(colour: str, size: float = 0.8, amount: float = 0.25) -> Texture:
    """One colour with cloudy noise."""
    rgb = _linear(colour)
    return lambda at: _tint(rgb, at.u, at.v, size, amount)


def wood(light: str, dark: str, upright: bool = False) -> Texture:
    """Grain along u, or along v if upright."""
    a, b = _linear(light), _linear(dark)

    def paint(at: Surface) -> np.ndarray:
        along, across = (at.v, at.u) if upright else (at.u, at.v)
        wave = np.sin(across * 70 + 9 * _noise(along * 0.3, across, 1.1))
        return _tint(_mix(a, b, 0.5 + 0.5 * wave), along * 0.15, across, 0.5, 0.25)

    return paint


def stripes(a: str, b: str, width: float, upright: bool = True) -> Texture:
    """Stripes ``width`` wide, cloth."""
    rgb_a, rgb_b = _linear(a), _linear(b)

    def paint(at: Surface) -> np.ndarray:
        across = at.u if upright else at.v
        band = np.floor(across / width) % 2
        return _tint(_mix(rgb_a, rgb_b, band), at.u, at.v, 0.4, 0.18)

    return paint


def checks(a: str, b: str, size: float) -> Texture:
    """Gingham: two crossing stripes, woven."""
    rgb_a, rgb_b = _linear(a), _linear(b)

    def paint(at: Surface) -> np.ndarray:
        band = np.floor(at.u / size) % 2 + np.floor(at.v / size) % 2
        return _tint(_mix(rgb_a, rgb_b, band / 2), at.u, at.v, 0.3, 0.15)

    return paint


def spines(width: float, palette: tuple[str, ...], seed: int) -> Texture:
    """A row of books ``width`` metres thick each on average, standing side by side along u."""
    colours = np.concatenate([_linear(colour) for colour in palette], axis=1)

    def paint(at: Surface) -> np.ndarray:
        cell = np.floor(at.u / width)
        bend = 0.6 * (_hash(cell.astype(np.int32), seed) - 0.5)
        book = (cell + (at.u / width - cell > 0.5 + bend)).astype(np.int32)
        rgb = colours[:, (_hash(book, seed + 1) * len(palette)).astype(np.int32)]
        label = np.abs(np.mod(at.v, 0.34) - 0.1 - 0.12 * _hash(book, seed + 2)) < 0.018
        edge = np.abs(at.u / width - cell - 0.5 - bend) < 0.07
        rgb = _mix(rgb, _linear("e6d9b4"), 0.8 * label) * (1 - 0.6 * edge)
        return _tint(rgb, at.u, at.v, 0.4, 0.15)

    return paint


def leaves(at: Surface) -> np.ndarray:
    """Foliage: light and dark leaves."""
    wave = _noise(at.u + 0.3 * at.points[2], at.v, 0.9)
    rgb = _mix(_linear("2f5d2b"), _linear("8fb356"), np.clip(4 * wave - 1.5, 0, 1))
    return rgb * (1 - 0.45 * (np.mod(at.v * 18 + 6 * wave, 1) < 0.25))


def globe(at: Surface) -> np.ndarray:
    """Land, sea, and a graticule."""
    land = _noise(at.u, at.v + 0.21, 0.62) > 0.54
    rgb = _mix(_linear("4f86ab"), _linear("b7a566"), land)
    lines = (np.mod(at.u, 0.0681) < 0.004) | (np.mod(at.v, 0.0681) < 0.004)
    return _tint(_mix(rgb, _linear("e8e4d4"), 0.6 * lines), at.u, at.v, 0.3, 0.12)


def outdoors(at: Surface) -> np.ndarray:
    """The view through the window: sky, clouds, hills, and white glazing bars."""
    y, z = at.u, at.v
    cloud = np.clip(3 * _noise(y * 0.5, z, 1.5) - 1.4, 0, 1)
    rgb = _mix(
        _mix(_linear("d5e5ee"), _linear("8fbbdd"), np.clip((z - 1.3) / 0.8, 0, 1)),
        _linear("ffffff"),
        cloud,
    )
    for base, height, colour in (
        (1.42, 0.22, "9db4a0"),
        (1.28, 0.2, "7fa06c"),
        (1.14, 0.14, "5f8a4a"),
    ):
        hill = z < base + height * (_noise(y + base, np.full_like(y, base), 2.4) - 0.5)
        rgb = _mix(rgb, _linear(colour) * (0.8 + 0.4 * _noise(y, z, 0.8)), hill)
    bars = (np.abs(y - 0.2) < 0.022) | (np.abs(z - 1.72) < 0.02)
    return _mix(rgb, _linear("c9c4b8"), bars)


def painting(at: Surface) -> np.ndarray:
    """A landscape at dusk: sun, bands of sky, mountains, and a lake."""
    y, z = at.u, at.v
    rgb = _mix(
        _linear("e9b872"),
        _linear("49688d"),
        np.clip((z - 1.6 + 0.1 * _noise(y, z, 0.6)) / 0.5, 0, 1),
    )
    rgb = _mix(rgb, _linear("fbe7b2"), np.hypot(y - 0.35, z - 1.78) < 0.075)
    for base, height, colour in (
        (1.72, 0.34, "6d6a86"),
        (1.6, 0.25, "4a5570"),
        (1.52, 0.15, "3c4a45"),
    ):
        rgb = _mix(
            rgb, _linear(colour), z < base + height * (_noise(y, np.full_like(y, base), 1.3) - 0.5)
        )
    wave = 0.35 * (np.sin(z * 260 + 5 * _noise(y, z, 0.5)) > 0.2)
    return _mix(rgb, _mix(_linear("5c7d92"), _linear("d9a971"), wave), z < 1.47)


def rug(at: Surface) -> np.ndarray:
    """Borders, and a field of diamonds."""
    x, y = at.u + 0.05, at.v
    edge = np.minimum(0.95 - np.abs(x), 1.1 - np.abs(y))
    diamond = np.abs(np.mod(x / 0.3, 1) - 0.5) + np.abs(np.mod(y / 0.3, 1) - 0.5)
    rgb = _mix(_linear("8e3b36"), _linear("d8c39a"), (diamond < 0.3) & (diamond > 0.14))
    rgb = _mix(rgb, _linear("3c5570"), diamond < 0.08)
    zigzag = np.abs(np.mod((x + y) / 0.08, 1) - 0.5) < 0.25
    border = _mix(_linear("33465c"), _linear("cdb98f"), zigzag)
    rgb = _mix(
        _mix(rgb, border, edge < 0.16),
        _linear("d8c39a"),
        (edge < 0.03) | (np.abs(edge - 0.17) < 0.015),
    )
    return _tint(rgb, at.u, at.v, 0.35, 0.2)


def floor(at: Surface) -> np.ndarray:
    """Planks along y."""
    row = np.floor(at.u / 0.13)
    tone = row.astype(np.int32)
    along = at.v / 0.9 + _hash(tone, 5)
    plank = _hash(tone, np.floor(along).astype(np.int32))
    rgb = _mix(_linear("a9794a"), _linear("7d5531"), plank)
    grain = np.sin(at.u * 160 + 12 * _noise(at.v * 0.25, at.u + plank, 0.9))
    gap = (np.mod(at.u / 0.13, 1) < 0.05) | (np.mod(along, 1) < 0.008)
    return _tint(rgb * (1 + 0.1 * grain) * (1 - 0.6 * gap), at.v * 0.2, at.u, 0.5, 0.2)


def _wall(at: Surface, paper: np.ndarray) -> np.ndarray:
    """Wallpaper [3, n] above a panelled dado and a skirting board."""
    panel = np.maximum(np.abs(np.mod(at.u / 0.5, 1) - 0.5) / 0.42, np.abs(at.v - 0.5) / 0.3)
    dado = _mix(_linear("d9d3c3"), _linear("b9b2a0"), np.abs(panel - 1) < 0.06)
    dado = _mix(dado, _linear("efe9da"), (at.v < 0.12) | (at.v > 0.88))
    return _tint(_mix(paper, dado, at.v < 0.93), at.u, at.v, 1.6, 0.13)


def wall_flowers(at: Surface) -> np.ndarray:
    """Wallpaper: a lattice of small flowers."""
    column = np.floor(at.u / 0.16)
    x = np.mod(at.u / 0.16, 1) - 0.5
    y = np.mod(at.v / 0.16 + 0.5 * np.mod(column, 2), 1) - 0.5
    near = np.hypot(x, y)
    petals = near < 0.22 + 0.1 * np.cos(5 * np.arctan2(y, x))
    rgb = _mix(_linear("b9c6b2"), _linear("f0e7d2"), petals)
    return _wall(at, _mix(rgb, _linear("c98b5a"), near < 0.08))


def wall_stripes(at: Surface) -> np.ndarray:
    """Wallpaper: broad and narrow stripes."""
    phase = np.mod(at.u / 0.2, 1)
    rgb = _mix(_linear("cdb894"), _linear("e3d7bd"), phase < 0.5)
    return _wall(at, _mix(rgb, _linear("a3643f"), np.abs(phase - 0.75) < 0.05))


def wall_door(at: Surface) -> np.ndarray:
    """Striped wallpaper with a panelled door."""
    x, z = at.u - 1.0, at.v
    panel = np.maximum(np.abs(np.abs(x) - 0.2) / 0.14, np.abs(np.mod(z / 0.66, 1) - 0.5) / 0.38)
    door = wood("b58d5f", "8a6238", upright=True)(at) * (1 - 0.45 * (np.abs(panel - 1) < 0.08))
    door = _mix(door, _linear("efe9da"), np.maximum(np.abs(x) - 0.42, z - 2.0) > 0)
    return _mix(wall_stripes(at), door, (np.abs(x) < 0.5) & (z < 2.08))


def ceiling(at: Surface) -> np.ndarray:
    """Plaster coffers between beams."""
    beam = (np.abs(np.mod(at.v / 0.8 + 0.5, 1) - 0.5) < 0.075)[None]
    plaster = _tint(_linear("e8e3d6"), at.u, at.v, 1.2, 0.15)
    return np.where(beam, wood("9c7349", "6f4c2b")(at), plaster)


def shell(at: Surface) -> np.ndarray:
    """Walls, floor and ceiling of the room."""
    rgb = np.empty_like(at.points)
    for face, texture in enumerate(
        (wall_flowers, wall_flowers, wall_door, wall_stripes, floor, ceiling)
    ):
        here = np.flatnonzero(at.face == face)
        if here.size:
            rgb[:, here] = texture(
                Surface(at.points[:, here], at.face[here], at.u[here], at.v[here])
            )
    return rgb


# --- Furniture ---------------------------------------------------------------------------------

_OAK, _WALNUT = wood("c39a66", "94683c"), wood("8a6140", "5a3a24")
_OAK_UP = wood("c39a66", "94683c", upright=True)
_SOFA, _CREAM, _BRASS = plain("5f7f86", 0.35, 0.3), plain("e6dcc6"), plain("b8924e", 0.2)
_BOOKS = ("7c3b32", "2f4f63", "b0894a", "4d6a4f", "d7cbb0", "6a4a68", "a8633c", "38424a")


def _box(
    x0: float,
    x1: float,
    y0: float,
    y1: float,
    z0: float,
    z1: float,
    paint: Texture,
    glow: float = 0.0,
) -> Box:
    return Box(lo=(x0, y0, z0), hi=(x1, y1, z1), texture=paint, glow=glow)


def _can(
    x: float, y: float, radius: float, z0: float, z1: float, paint: Texture, glow: float = 0.0
) -> Box:
    return Cylinder(
        lo=(x - radius, y - radius, z0), hi=(x + radius, y + radius, z1), texture=paint, glow=glow
    )


def _ball(x: float, y: float, z: float, radius: float, paint: Texture) -> Box:
    return Ball(
        lo=(x - radius, y - radius, z - radius),
        hi=(x + radius, y + radius, z + radius),
        texture=paint,
    )


def _furniture() -> Iterator[Box]:
    """The room first, then everything in it."""
    yield Room(lo=ROOM_MIN, hi=ROOM_MAX, texture=shell)
    yield _box(-1.0, 0.9, -1.1, 1.1, 0.0, 0.012, rug)
    # sofa, pillows, painting
    yield _box(-1.95, -1.15, -0.95, 0.95, 0.06, 0.34, _SOFA)
    yield _box(-1.95, -1.7, -0.95, 0.95, 0.34, 0.82, _SOFA)
    for y in (-1.13, 0.95):
        yield _box(-1.95, -1.15, y, y + 0.18, 0.06, 0.58, _SOFA)
    for y in (-0.945, 0.01):
        yield _box(-1.7, -1.12, y, y + 0.935, 0.34, 0.46, plain("6c8c92", 0.3, 0.3))
    yield _box(-1.7, -1.58, -0.85, -0.45, 0.46, 0.82, checks("efe3c8", "b8563e", 0.04))
    yield _box(-1.7, -1.58, 0.4, 0.8, 0.46, 0.8, stripes("e6d7a8", "c99a3c", 0.05))
    yield _box(-2.0, -1.96, -0.55, 0.75, 1.27, 2.08, _WALNUT)
    yield _box(-2.0, -1.955, -0.5, 0.7, 1.32, 2.03, painting)
    # coffee table and what is on it
    yield _box(-0.65, 0.05, -0.5, 0.6, 0.4, 0.44, _OAK_UP)
    yield _box(-0.6, 0.0, -0.45, 0.55, 0.13, 0.155, _OAK_UP)
    for x in (-0.65, 0.0):
        for y in (-0.5, 0.55):
            yield _box(x, x + 0.05, y, y + 0.05, 0.0, 0.4, _OAK_UP)
    yield _ball(-0.3, 0.2, 0.525, 0.09, stripes("3f6e8c", "e7e0cf", 0.03, upright=False))
    yield _can(-0.3, 0.2, 0.035, 0.59, 0.7, plain("3f6e8c"))
    for x, y, z, colour in (
        (-0.3, 0.2, 0.95, "d9694a"),
        (-0.36, 0.25, 0.88, "e3b04b"),
        (-0.23, 0.24, 0.84, "e8dcc8"),
        (-0.29, 0.12, 0.82, "c9506a"),
    ):
        yield _can(x, y, 0.007, 0.66, z, plain("4d7a3c"))
        yield _ball(x, y, z, 0.045, plain(colour, 0.12, 0.35))
    yield _box(-0.52, -0.28, -0.4, -0.06, 0.44, 0.475, plain("7c3b32"))
    yield _box(-0.5, -0.3, -0.36, -0.08, 0.475, 0.505, plain("d7cbb0"))
    yield _box(-0.49, -0.33, -0.33, -0.1, 0.505, 0.53, plain("2f4f63"))
    yield _can(-0.08, -0.25, 0.045, 0.44, 0.53, stripes("e9e1d0", "b5533c", 0.03, upright=False))
    yield _ball(-0.12, 0.47, 0.5, 0.06, plain("c46a2c", 0.1, 0.2))
    # stool, pouf, crate with a box and a ball
    yield _can(0.8, -0.45, 0.2, 0.43, 0.47, _OAK)
    for x, y in ((0.92, -0.45), (0.74, -0.35), (0.74, -0.55)):
        yield _can(x, y, 0.018, 0.0, 0.43, _OAK_UP)
    yield _can(0.7, 0.85, 0.27, 0.0, 0.36, checks("c98a5c", "f0dfc2", 0.06))
    yield _box(0.2, 0.7, -1.75, -1.3, 0.0, 0.42, stripes("b98d58", "8a6136", 0.07, upright=False))
    yield _box(0.27, 0.5, -1.68, -1.45, 0.42, 0.62, checks("e9e2d0", "4f7f78", 0.033))
    yield _ball(0.6, -1.43, 0.5, 0.08, stripes("d8b24a", "a8443a", 0.042))
    # sideboard, globe, radio, candles; window and curtains above
    yield _box(1.58, 1.98, -0.85, 0.95, 0.08, 0.56, _WALNUT)
    for y in (-0.81, -0.22, 0.37):
        yield _box(1.565, 1.6, y, y + 0.54, 0.12, 0.52, _OAK)
    yield _can(1.76, -0.55, 0.07, 0.56, 0.59, _BRASS)
    yield _ball(1.76, -0.55, 0.73, 0.14, globe)
    yield _box(1.68, 1.88, 0.0, 0.34, 0.56, 0.78, spines(0.02, ("4a3a2c", "c9a25e"), 3))
    for y, z in ((0.62, 0.74), (0.74, 0.82)):
        yield _can(1.76, y, 0.035, 0.56, z, _CREAM)
    yield _box(1.96, 2.0, -0.46, 0.86, 1.06, 2.2, _CREAM)
    yield _box(1.955, 2.0, -0.4, 0.8, 1.12, 2.14, outdoors, glow=1.1)
    for y in (-0.82, 0.86):
        yield _box(1.88, 1.95, y, y + 0.36, 0.75, 2.3, stripes("d8c7a2", "b86f4c", 0.06))
    yield _box(1.9, 1.93, -0.95, 1.35, 2.3, 2.33, _BRASS)
    # bookshelf
    for x in (-0.4, 1.38):
        yield _box(x, x + 0.03, 2.18, 2.5, 0.0, 1.95, _OAK_UP)
    yield _box(-0.37, 1.38, 2.46, 2.5, 0.0, 1.95, wood("a57c4c", "7d5730"))
    for level, z in enumerate((0.05, 0.43, 0.81, 1.19, 1.57, 1.92)):
        yield _box(-0.37, 1.38, 2.18, 2.46, z, z + 0.03, _OAK)
        if level < 5:
            x = -0.37 + 0.35 * (level % 3)
            yield _box(x, x + 0.75, 2.24, 2.46, z + 0.03, z + 0.29, spines(0.05, _BOOKS, level))
            x = 0.62 if level % 3 == 0 else 0.95 if level % 3 == 1 else -0.3
            yield _box(x, x + 0.4, 2.22, 2.46, z + 0.03, z + 0.25, spines(0.04, _BOOKS, 9 + level))
    yield _ball(1.2, 2.32, 1.31, 0.09, plain("b5654a", 0.2, 0.3))
    # floor lamp, pendant
    yield _can(-1.55, 1.75, 0.16, 0.0, 0.03, _BRASS)
    yield _can(-1.55, 1.75, 0.018, 0.03, 1.4, _BRASS)
    yield _can(-1.55, 1.75, 0.21, 1.35, 1.65, stripes("f4e3bd", "e5c890", 0.033), glow=1.0)
    yield _can(-0.3, 0.05, 0.012, 2.15, 2.6, _BRASS)
    yield _can(-0.3, 0.05, 0.22, 1.97, 2.15, stripes("f6ead0", "e8cf9e", 0.06, upright=False), 1.0)
    # plant
    yield _can(-1.45, -1.95, 0.21, 0.0, 0.36, checks("b9623f", "d9996c", 0.07))
    yield _can(-1.45, -1.95, 0.03, 0.36, 0.95, _OAK_UP)
    for x, y, z, radius in (
        (-1.45, -1.95, 1.1, 0.25),
        (-1.25, -1.85, 0.85, 0.17),
        (-1.63, -1.8, 0.9, 0.18),
        (-1.5, -2.15, 0.85, 0.19),
        (-1.3, -2.1, 1.25, 0.18),
        (-1.6, -1.95, 1.4, 0.2),
    ):
        yield _ball(x, y, z, radius, leaves)
    # wall shelf, pictures, door handle
    yield _box(-0.85, 0.15, -2.5, -2.3, 1.25, 1.28, _OAK)
    yield _box(-0.75, -0.4, -2.48, -2.33, 1.28, 1.5, spines(0.04, _BOOKS, 21))
    yield _ball(-0.2, -2.4, 1.36, 0.08, stripes("7d9a8c", "e8e0cc", 0.03, upright=False))
    yield _can(0.03, -2.4, 0.05, 1.28, 1.46, checks("c9a25e", "7a4a34", 0.04))
    for x in (-0.75, -0.2):
        yield _box(x, x + 0.4, -2.5, -2.47, 1.65, 2.1, _WALNUT)
        yield _box(x + 0.04, x + 0.36, -2.5, -2.465, 1.69, 2.06, leaves if x < -0.5 else painting)
    yield _ball(0.66, -2.45, 1.0, 0.03, _BRASS)


def _patch(lo: Vec3, hi: Vec3, counts: tuple[int, int, int]) -> np.ndarray:
    """Midpoints [3, n] of a regular division of a box."""
    axes = [a + (np.arange(n) + 0.5) / n * (b - a) for a, b, n in zip(lo, hi, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1)


@lru_cache(maxsize=1)
def _tracer() -> Tracer:
    """The lit room; built once per process."""
    window = _patch((1.95, -0.4, 1.12), (1.95, 0.8, 2.14), (1, 5, 4))
    pendant = _patch((-0.45, -0.1, 1.96), (-0.15, 0.2, 1.96), (3, 3, 1))
    lamp = _patch((-1.7, 1.6, 1.36), (-1.4, 1.9, 1.64), (2, 2, 2))
    lights = (
        Light(points=window, facing=(-1.0, 0.0, 0.0), power=(1.5, 1.55, 1.6)),
        Light(points=pendant, facing=(0.0, 0.0, -1.0), power=(0.8, 0.72, 0.58)),
        Light(points=lamp, facing=(0.0, 0.0, 0.0), power=(0.35, 0.28, 0.18)),
    )
    return Tracer(list(_furniture()), lights, (0.5, 0.48, 0.45), spacing=0.05)


def first_hit(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Exact distance along each ray to the first surface of the room.

    Args:
        origins: [n, 3] scene units.
        directions: [n, 3] unit vectors.

    Returns:
        [n] float64 scene units; 0 where the ray starts inside a solid or outside the room.

    Raises:
        ValueError: Shapes differ, values are not finite, or a direction is not of unit length.
    """
    require_rays(origins, directions)
    return _tracer().first_hit(origins, directions)


# --- Cameras -----------------------------------------------------------------------------------


def _look(position: Vec3, target: Vec3, roll: float = 0.0) -> np.ndarray:
    """c2w [3, 4] of a camera at position that looks at target, rolled by an angle in radians."""
    back = np.subtract(position, target)
    back = back / np.linalg.norm(back)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * up, c * up - s * right, back, np.array(position)], axis=1)


_LOW: tuple[tuple[Vec3, Vec3], ...] = (  # around the table, kneeling
    ((0.0, -0.95, 0.5), (-0.3, 0.1, 0.5)),
    ((1.15, -0.15, 0.6), (-0.4, 0.1, 0.4)),
    ((1.2, 0.4, 0.5), (-0.3, 0.0, 0.55)),
    ((0.35, 1.55, 0.55), (-0.2, -0.1, 0.4)),
    ((-0.6, 1.3, 0.65), (0.3, -0.8, 0.35)),
    ((-0.75, -1.3, 0.6), (0.3, 0.3, 0.4)),
)

_CLOSE: tuple[tuple[Vec3, Vec3], ...] = (
    ((0.85, -1.2, 0.8), (0.45, -1.55, 0.5)),  # crate, 0.4 m away
    ((0.1, -1.15, 0.85), (0.4, -1.55, 0.52)),
    ((0.45, -0.95, 0.6), (0.45, -1.55, 0.5)),
    ((0.0, -1.7, 0.7), (0.5, -1.45, 0.5)),
    ((0.3, 0.25, 0.75), (-0.3, 0.15, 0.62)),  # table
    ((-0.3, 0.65, 0.95), (-0.3, 0.15, 0.6)),
    ((-0.75, 0.2, 0.85), (-0.28, 0.15, 0.62)),
    ((-0.2, -0.75, 0.8), (-0.35, -0.15, 0.5)),
    ((-0.9, -0.35, 0.8), (-1.6, -0.6, 0.6)),  # sofa
    ((-0.95, 0.45, 0.75), (-1.65, 0.6, 0.6)),
    ((1.3, -0.35, 1.0), (1.8, -0.5, 0.75)),  # sideboard
    ((1.25, 0.5, 0.95), (1.85, 0.4, 0.75)),
    ((0.6, 1.7, 1.2), (0.7, 2.4, 1.15)),  # bookshelf
    ((-1.0, -1.55, 1.2), (-1.5, -2.0, 0.95)),  # plant
    ((1.15, -0.6, 0.85), (0.75, -0.42, 0.45)),  # stool
    ((0.35, 1.2, 0.75), (0.75, 0.8, 0.25)),  # pouf
)

_TEST: tuple[tuple[Vec3, Vec3], ...] = (
    ((1.72, 2.0, 1.7), (-0.4, -0.2, 0.6)),
    ((1.7, -2.2, 1.6), (-0.3, 0.1, 0.6)),
    ((-1.0, -2.1, 1.75), (0.0, 0.3, 0.55)),
    ((-1.05, 2.1, 1.5), (0.1, -0.4, 0.5)),
    ((0.75, -2.15, 1.1), (0.3, 0.2, 0.55)),
    ((1.35, 1.4, 1.1), (-0.6, -0.1, 0.5)),
    ((0.0, 1.9, 1.35), (0.2, -1.0, 0.45)),
    ((1.2, -1.3, 1.15), (-0.9, 0.4, 0.55)),
    ((-0.85, -1.25, 1.0), (0.5, 0.2, 0.5)),
    ((-1.2, 0.0, 1.6), (0.9, -0.2, 0.6)),
)


def _train_poses() -> Iterator[tuple[Vec3, Vec3]]:
    """Position and target of every training camera: around the table, outward, and close."""
    for k in range(24):  # standing
        a = 2 * np.pi * k / 24 + 0.1
        z = 1.3 + 0.3 * np.sin(5 * a) + 0.12 * np.sin(2 * a)
        reach = 1.0 + 0.08 * np.sin(7 * a)
        eye = (0.1 + 1.25 * reach * np.cos(a), 1.7 * reach * np.sin(a), z)
        yield eye, (-0.2 + 0.25 * np.cos(3 * a), 0.3 * np.sin(4 * a), 0.55 + 0.15 * np.sin(a))
    yield from _LOW
    for k in range(14):  # outward, all around, up and down
        a = 2 * np.pi * k / 14 + 0.2
        eye = (0.15 - 0.45 * np.cos(a), -0.5 * np.sin(a), 1.35 + 0.15 * np.sin(3 * a))
        yield (
            eye,
            (eye[0] + np.cos(a), eye[1] + np.sin(a), eye[2] + (-0.4, 0.05, 0.35, -0.1)[k % 4]),
        )
    yield from _CLOSE


def _camera(c2w: np.ndarray) -> Camera:
    """The camera of the undivided scene at a pose."""
    focal = float(WIDTH / 2 / np.tan(FIELD_OF_VIEW / 2))
    return Camera(
        width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=WIDTH / 2, cy=HEIGHT / 2, c2w=c2w
    )


def room_scene(downscale: int = 1) -> Scene:
    """Build the scene "builtin:room": 60 training and 10 test views with true depth.

    Args:
        downscale: Divides the width of 160 and the height of 120 pixels, rounding down.

    Returns:
        Scene with [H, W, 3] uint8 images, and the room with a margin as its box; metres.

    Raises:
        ValueError: downscale is not a whole number that leaves at least one pixel.
    """
    if not isinstance(downscale, int) or not 1 <= downscale <= HEIGHT:
        raise InputError(f"downscale must be a whole number from 1 to {HEIGHT}, not {downscale}.")
    tracer = _tracer()
    samples = min(downscale + 1, 4)  # small images hold more detail in each pixel

    def photograph(camera: Camera) -> np.ndarray | None:
        inside = first_hit(camera.position[None], camera.forward[None])[0] > 0.0
        return tracer.image(camera, samples) if inside else None

    views = []
    for kind, poses in (("test", _TEST), ("train", tuple(_train_poses()))):
        for k, (eye, target) in enumerate(poses):
            c2w = _look(eye, target, roll=0.03 * np.sin(2.4 * k))
            camera = _camera(c2w).downscaled(downscale)
            image, depth = tracer.image(camera, samples), tracer.depth(camera)
            views.append(View(name=f"{kind}_{k:02d}.png", camera=camera, image=image, depth=depth))
    train = range(len(_TEST), len(views))
    seen = [view.depth for view in views[train.start :] if view.depth is not None]
    content_distance = float(np.median(np.stack(seen)))
    return Scene(
        name="builtin:room",
        views=views,
        splits={"train": tuple(train), "test": tuple(range(len(_TEST)))},
        box_min=np.array(ROOM_MIN) - MARGIN,
        box_max=np.array(ROOM_MAX) + MARGIN,
        unbounded=False,
        content_distance=content_distance,
        notes=(
            f"content distance {content_distance:.3g}: median of the true depth over the training "
            "views, which look in, out and close, at no common point",
        ),
        photograph=photograph,
    )
