"""What the built-in room is covered with: albedo as a function of the surface point."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from warpnerf.scenes.builtin.solids import Surface, Texture


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
    return table.take(j * len(table) + i)


def _part(x: np.ndarray) -> np.ndarray:
    """What is left of x above the next lower whole number: np.mod(x, 1), sooner."""
    return x - np.floor(x)


def _odd(x: np.ndarray) -> np.ndarray:
    """1.0 where the next lower whole number is odd, else 0.0."""
    return 2 * _part(np.floor(x) / 2)


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
        band = _odd(across / width)
        return _tint(_mix(rgb_a, rgb_b, band), at.u, at.v, 0.4, 0.18)

    return paint


def checks(a: str, b: str, size: float) -> Texture:
    """Gingham: two crossing stripes, woven."""
    rgb_a, rgb_b = _linear(a), _linear(b)

    def paint(at: Surface) -> np.ndarray:
        band = _odd(at.u / size) + _odd(at.v / size)
        return _tint(_mix(rgb_a, rgb_b, band / 2), at.u, at.v, 0.3, 0.15)

    return paint


def spines(width: float, palette: tuple[str, ...], seed: int) -> Texture:
    """A row of books ``width`` metres thick each on average, standing side by side along u."""
    colours = np.concatenate([_linear(colour) for colour in palette], axis=1)

    def paint(at: Surface) -> np.ndarray:
        cell = np.floor(at.u / width)
        bend = 0.6 * (_hash(cell.astype(np.int32), seed) - 0.5)
        book = (cell + (at.u / width - cell > 0.5 + bend)).astype(np.int32)
        rgb = colours.take((_hash(book, seed + 1) * len(palette)).astype(np.int32), axis=1)
        label = np.abs(np.mod(at.v, 0.34) - 0.1 - 0.12 * _hash(book, seed + 2)) < 0.018
        edge = np.abs(at.u / width - cell - 0.5 - bend) < 0.07
        rgb = _mix(rgb, _linear("e6d9b4"), 0.8 * label) * (1 - 0.6 * edge)
        return _tint(rgb, at.u, at.v, 0.4, 0.15)

    return paint


def leaves(at: Surface) -> np.ndarray:
    """Foliage: light and dark leaves."""
    wave = _noise(at.u + 0.3 * at.points[2], at.v, 0.9)
    rgb = _mix(_linear("2f5d2b"), _linear("8fb356"), np.clip(4 * wave - 1.5, 0, 1))
    return rgb * (1 - 0.45 * (_part(at.v * 18 + 6 * wave) < 0.25))


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
    diamond = np.abs(_part(x / 0.3) - 0.5) + np.abs(_part(y / 0.3) - 0.5)
    rgb = _mix(_linear("8e3b36"), _linear("d8c39a"), (diamond < 0.3) & (diamond > 0.14))
    rgb = _mix(rgb, _linear("3c5570"), diamond < 0.08)
    zigzag = np.abs(_part((x + y) / 0.08) - 0.5) < 0.25
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
    gap = (_part(at.u / 0.13) < 0.05) | (_part(along) < 0.008)
    return _tint(rgb * (1 + 0.1 * grain) * (1 - 0.6 * gap), at.v * 0.2, at.u, 0.5, 0.2)


def _wall(at: Surface, paper: np.ndarray) -> np.ndarray:
    """Wallpaper [3, n] above a panelled dado and a skirting board."""
    panel = np.maximum(np.abs(_part(at.u / 0.5) - 0.5) / 0.42, np.abs(at.v - 0.5) / 0.3)
    dado = _mix(_linear("d9d3c3"), _linear("b9b2a0"), np.abs(panel - 1) < 0.06)
    dado = _mix(dado, _linear("efe9da"), (at.v < 0.12) | (at.v > 0.88))
    return _tint(_mix(paper, dado, at.v < 0.93), at.u, at.v, 1.6, 0.13)


def wall_flowers(at: Surface) -> np.ndarray:
    """Wallpaper: a lattice of small flowers."""
    column = np.floor(at.u / 0.16)
    x = _part(at.u / 0.16) - 0.5
    y = _part(at.v / 0.16 + 0.5 * _odd(column)) - 0.5
    near = np.hypot(x, y)
    petals = near < 0.22 + 0.1 * np.cos(5 * np.arctan2(y, x))
    rgb = _mix(_linear("b9c6b2"), _linear("f0e7d2"), petals)
    return _wall(at, _mix(rgb, _linear("c98b5a"), near < 0.08))


def wall_stripes(at: Surface) -> np.ndarray:
    """Wallpaper: broad and narrow stripes."""
    phase = _part(at.u / 0.2)
    rgb = _mix(_linear("cdb894"), _linear("e3d7bd"), phase < 0.5)
    return _wall(at, _mix(rgb, _linear("a3643f"), np.abs(phase - 0.75) < 0.05))


def wall_door(at: Surface) -> np.ndarray:
    """Striped wallpaper with a panelled door."""
    x, z = at.u - 1.0, at.v
    panel = np.maximum(np.abs(np.abs(x) - 0.2) / 0.14, np.abs(_part(z / 0.66) - 0.5) / 0.38)
    door = wood("b58d5f", "8a6238", upright=True)(at) * (1 - 0.45 * (np.abs(panel - 1) < 0.08))
    door = _mix(door, _linear("efe9da"), np.maximum(np.abs(x) - 0.42, z - 2.0) > 0)
    return _mix(wall_stripes(at), door, (np.abs(x) < 0.5) & (z < 2.08))


def ceiling(at: Surface) -> np.ndarray:
    """Plaster coffers between beams."""
    beam = (np.abs(_part(at.v / 0.8 + 0.5) - 0.5) < 0.075)[None]
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
