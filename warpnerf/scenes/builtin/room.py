"""The built-in scenes: a furnished room, traced exactly, with true depth.

"builtin:room" has enough training views that every test view's content is seen by several.
"builtin:room-sparse" has a quarter of them, and little is seen by more than a few. Some things
stand within half a metre of some cameras and metres away from others: that is where radiance fields
trained without gradient scaling grow floaters. Lengths are metres; z is up; the
sofa is along the wall at -x, the window at +x, the bookshelf at +y, the plant in the corner at -y.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from itertools import count

import numpy as np

from warpnerf.checks import InputError, require_rays
from warpnerf.scenes.builtin.raytrace import Light, Tracer, in_threads
from warpnerf.scenes.builtin.room_textures import (
    checks,
    globe,
    leaves,
    outdoors,
    painting,
    plain,
    rug,
    shell,
    spines,
    stripes,
    wood,
)
from warpnerf.scenes.builtin.solids import Ball, Box, Cylinder, Room, Texture, Vec3
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View

WIDTH, HEIGHT = 160, 120
FIELD_OF_VIEW = np.radians(65.0)  # horizontal
ROOM_MIN: Vec3 = (-2.0, -2.5, 0.0)
ROOM_MAX: Vec3 = (2.0, 2.5, 2.6)
MARGIN = 0.05  # metres of the scene's box outside the walls

N_WALKING = 90
"""Training views of "builtin:room" besides those of "builtin:room-sparse"."""

WALK_MIN: Vec3 = (-1.78, -2.28, 0.5)
WALK_MAX: Vec3 = (1.78, 2.28, 1.9)
"""Where they are taken from, metres, but not within ``CLEARANCE`` of any furniture."""

CLEARANCE = 0.25
"""Metres."""

LOOK_MIN: Vec3 = (-1.8, -2.3, 0.1)
LOOK_MAX: Vec3 = (1.8, 2.3, 1.6)
"""What they look at, metres, ``LOOK_AWAY`` away or more."""

LOOK_AWAY = 1.5
"""Metres."""

MAX_CLIMB = 0.6
"""Most that a view of theirs looks up or down: the sine of the angle to the level."""


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


def room_solids() -> tuple[Box, ...]:
    """The room, which is hollow, and all that stands in it."""
    return _tracer().solids


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


def photograph(camera: Camera, samples: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """What a camera in the room sees.

    Args:
        camera: Anywhere inside; its distortion is not simulated.
        samples: Squared, the rays of each pixel.

    Returns:
        rgb [H, W, 3] uint8, and the true depth [H, W] float32 in scene units.
    """
    return _tracer().image(camera, samples), _tracer().depth(camera)


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
    ((1.2, 0.4, 0.5), (-0.3, 0.0, 0.55)),
    ((-0.6, 1.3, 0.65), (0.3, -0.8, 0.35)),
)

_CLOSE: tuple[tuple[Vec3, Vec3], ...] = (
    ((0.85, -1.2, 0.8), (0.45, -1.55, 0.5)),  # crate, 0.4 m away
    ((0.45, -0.95, 0.6), (0.45, -1.55, 0.5)),
    ((0.3, 0.25, 0.75), (-0.3, 0.15, 0.62)),  # table
    ((-0.75, 0.2, 0.85), (-0.28, 0.15, 0.62)),
    ((-0.9, -0.35, 0.8), (-1.6, -0.6, 0.6)),  # sofa
    ((1.3, -0.35, 1.0), (1.8, -0.5, 0.75)),  # sideboard
    ((0.6, 1.7, 1.2), (0.7, 2.4, 1.15)),  # bookshelf
    ((1.15, -0.6, 0.85), (0.75, -0.42, 0.45)),  # stool
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


def _sparse_poses() -> Iterator[tuple[Vec3, Vec3]]:
    """Position and target of 30 training cameras: around the table, outward, and close."""
    for k in range(12):  # standing
        a = 2 * np.pi * k / 12 + 0.1
        z = 1.3 + 0.3 * np.sin(5 * a) + 0.12 * np.sin(2 * a)
        reach = 1.0 + 0.08 * np.sin(7 * a)
        eye = (0.1 + 1.25 * reach * np.cos(a), 1.7 * reach * np.sin(a), z)
        yield eye, (-0.2 + 0.25 * np.cos(3 * a), 0.3 * np.sin(4 * a), 0.55 + 0.15 * np.sin(a))
    yield from _LOW
    for k in range(7):  # outward, all around, up and down
        a = 2 * np.pi * k / 7 + 0.2
        eye = (0.15 - 0.45 * np.cos(a), -0.5 * np.sin(a), 1.35 + 0.15 * np.sin(3 * a))
        yield (
            eye,
            (eye[0] + np.cos(a), eye[1] + np.sin(a), eye[2] + (-0.4, 0.35)[k % 2]),
        )
    yield from _CLOSE


def _walking_poses() -> Iterator[tuple[Vec3, Vec3]]:
    """Position and target of 90 more training cameras, all over the room.

    Points of an additive sequence in six dimensions, three of the position and three of the target,
    less those that do not fit. Its steps are powers of the root of x^7 = x + 1: Roberts 2018,
    "The Unreasonable Effectiveness of Quasirandom Sequences". Seen from above, positions are denser
    towards the walls and targets towards the middle, so that many views look across the corners'
    free space; where none does, it fills with fog that test views from there look through.
    """
    root = 1.0
    for _ in range(60):  # converges; rounding ends it long before
        root = (1.0 + root) ** (1.0 / 7.0)
    lo = np.array([WALK_MIN, LOOK_MIN])
    hi = np.array([WALK_MAX, LOOK_MAX])
    furniture = np.array([(solid.lo, solid.hi) for solid in _furniture()][1:])  # [solid, 2, 3]
    found = 0
    for k in count(1):
        share = ((0.5 + k * root ** -np.arange(1.0, 7.0)) % 1.0).reshape(2, 3)
        share[0, :2] = (1.0 - np.cos(np.pi * share[0, :2])) / 2.0
        share[1, :2] = np.arccos(1.0 - 2.0 * share[1, :2]) / np.pi
        eye, target = lo + share * (hi - lo)
        apart = np.maximum(furniture[:, 0] - eye, eye - furniture[:, 1])
        if np.linalg.norm(np.maximum(apart, 0.0), axis=1).min() < CLEARANCE:
            continue
        away = float(np.linalg.norm(target - eye))
        if away < LOOK_AWAY or abs(target[2] - eye[2]) > MAX_CLIMB * away:
            continue
        yield tuple(eye), tuple(target)
        found += 1
        if found == N_WALKING:
            return


def _camera(c2w: np.ndarray) -> Camera:
    """The camera of the undivided scene at a pose."""
    focal = float(WIDTH / 2 / np.tan(FIELD_OF_VIEW / 2))
    return Camera(
        width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=WIDTH / 2, cy=HEIGHT / 2, c2w=c2w
    )


def room_scene(downscale: int = 1, *, sparse: bool = False) -> Scene:
    """Build "builtin:room": 120 training and 10 test views with true depth.

    Args:
        downscale: Divides the width of 160 and the height of 120 pixels, rounding down.
        sparse: Build "builtin:room-sparse": 30 of these training views, and the same test views.

    Returns:
        Scene with [H, W, 3] uint8 images, and the room with a margin as its box; metres.

    Raises:
        ValueError: downscale is not a whole number that leaves at least one pixel.
    """
    if not isinstance(downscale, int) or not 1 <= downscale <= HEIGHT:
        raise InputError(f"downscale must be a whole number from 1 to {HEIGHT}, not {downscale}.")
    samples = min(downscale + 1, 4)  # small images hold more detail in each pixel

    def once_more(camera: Camera) -> np.ndarray | None:
        inside = first_hit(camera.position[None], camera.forward[None])[0] > 0.0
        return photograph(camera, samples)[0] if inside else None

    train_poses = tuple(_sparse_poses()) + (() if sparse else tuple(_walking_poses()))
    cameras = {}
    for kind, poses in (("test", _TEST), ("train", train_poses)):
        digits = len(str(len(poses)))
        for k, (eye, target) in enumerate(poses):
            c2w = _look(eye, target, roll=0.03 * np.sin(2.4 * k))
            cameras[f"{kind}_{k:0{digits}d}.png"] = _camera(c2w).downscaled(downscale)
    _tracer()  # before there are threads: it has its own
    pictures = in_threads(lambda camera: photograph(camera, samples), cameras.values())
    views = [
        View(name=name, camera=camera, image=image, depth=depth)
        for (name, camera), (image, depth) in zip(cameras.items(), pictures, strict=True)
    ]
    train = range(len(_TEST), len(views))
    seen = [view.depth for view in views[train.start :] if view.depth is not None]
    content_distance = float(np.median(np.stack(seen)))
    return Scene(
        name="builtin:room-sparse" if sparse else "builtin:room",
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
        photograph=once_more,
        first_hit=first_hit,
    )
