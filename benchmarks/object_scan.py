"""Photographs of an object with thin parts, rendered as those of NeRF-synthetic are.

    python benchmarks/object_scan.py path/to/new/folder

A lattice crane on a studded plate, lacquered, so that highlights move with the camera. Cameras
stand around it on a sphere and see it before nothing: RGBA with straight alpha, written as
Blender's folder of frames. The object is turned against the axes, so that no face lies along a
grid's.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from PIL import Image

from warpnerf.runtime.memory import usable_cores
from warpnerf.scenes.builtin.raytrace import Light, Tracer
from warpnerf.scenes.builtin.room_textures import checks, plain, spines, stripes
from warpnerf.scenes.builtin.solids import Ball, Box, Cylinder, Room, Surface, Texture, Vec3
from warpnerf.scenes.cameras.camera import Camera

AWAY = 4.03
"""Of the cameras from the middle, scene units, as in NeRF-synthetic."""
ANGLE_X = 0.6911112
"""Of their field of view, radians, as there."""
RADIUS = 1.4
"""Around the middle, scene units: the object lies within."""
WALLS = 9.0
"""From the middle to the walls of the tracer's room, which no photograph shows, scene units."""
TURN = np.radians(27.0)
"""Of the object about the vertical axis."""
SAMPLES = 2
"""Squared, the rays of a pixel."""
SUN = np.array([0.36, -0.48, 0.8])
"""Direction to where highlights come from, unit vector."""


class Lacquer:
    """A texture with highlights for who looks from ``eye``, [3] scene units; see Blinn 1977."""

    eye = np.zeros(3)

    def __init__(
        self, under: Texture, normal: Callable[[Surface], np.ndarray], gloss: float
    ) -> None:
        """Lay lacquer over a texture, whose normals [3, n] are given."""
        self._under, self._normal, self._gloss = under, normal, gloss

    def __call__(self, at: Surface) -> np.ndarray:
        """Albedo and highlight, [3, n]."""
        view = Lacquer.eye[:, None] - at.points
        half = view / np.linalg.norm(view, axis=0) + SUN[:, None]
        half /= np.linalg.norm(half, axis=0)
        cosine = np.maximum((half * self._normal(at)).sum(axis=0), 0.0)
        return self._under(at) + self._gloss * cosine.astype(np.float32) ** 24


def box(lo: Vec3, hi: Vec3, under: Texture, gloss: float = 0.25) -> Box:
    """A lacquered box."""
    signed = np.repeat(np.eye(3, dtype=np.float32), 2, axis=1) * np.tile([-1.0, 1.0], 3)
    return Box(lo=lo, hi=hi, texture=Lacquer(under, lambda at: signed.take(at.face, 1), gloss))


def can(x: float, y: float, radius: float, z0: float, z1: float, under: Texture) -> Box:
    """A lacquered upright cylinder."""
    up = np.array([[0.0], [0.0], [1.0]])

    def normal(at: Surface) -> np.ndarray:
        out = np.stack([at.points[0] - x, at.points[1] - y, 0.0 * at.points[2]]) / radius
        return np.where(at.face == 0, out, np.where(at.face == 5, up, -up))

    lo, hi = (x - radius, y - radius, z0), (x + radius, y + radius, z1)
    return Cylinder(lo=lo, hi=hi, texture=Lacquer(under, normal, 0.25))


def ball(x: float, y: float, z: float, radius: float, under: Texture) -> Box:
    """A lacquered ball."""
    centre = np.array([x, y, z])

    def normal(at: Surface) -> np.ndarray:
        return (at.points - centre[:, None]) / radius

    lo, hi = (float(c) for c in centre - radius), (float(c) for c in centre + radius)
    return Ball(lo=tuple(lo), hi=tuple(hi), texture=Lacquer(under, normal, 0.6))  # type: ignore[arg-type]


def solids() -> Iterator[Box]:
    """The room first, then the crane and what stands around it."""
    yield Room(lo=(-WALLS,) * 3, hi=(WALLS,) * 3, texture=plain("ffffff"), glow=1.0)
    steel, yellow, red = plain("59646b", 0.2), plain("e2a81f", 0.15, 0.2), plain("b2382c", 0.2)
    wood = stripes("b98d58", "8a6136", 0.03)
    # plate with studs
    yield box((-0.95, -0.7, -0.6), (0.95, 0.7, -0.53), checks("5b7d54", "3f5f45", 0.11), 0.1)
    for i in range(12):
        for j in range(9):
            x, y = -0.88 + 0.16 * i, -0.64 + 0.16 * j
            under_tower = abs(x - 0.32) < 0.3 and abs(y) < 0.3
            under_house = -0.75 < x < -0.2 and abs(y) < 0.42
            if not (under_tower or under_house):
                yield can(x, y, 0.045, -0.59, -0.495, plain("6d9164", 0.1))
    # tower, jib and counterweight
    for x in (0.2, 0.44):
        for y in (-0.12, 0.12):
            yield can(x, y, 0.014, -0.53, 0.62, yellow)
    for level in range(9):
        z = -0.45 + 0.13 * level
        for y in (-0.126, 0.114):
            yield box((0.2, y, z), (0.44, y + 0.012, z + 0.012), yellow)
        for x in (0.194, 0.434):
            yield box((x, -0.12, z), (x + 0.012, 0.12, z + 0.012), yellow)
    for y, z in ((-0.07, 0.64), (0.058, 0.64), (-0.006, 0.76)):
        yield box((-0.9, y, z), (0.85, y + 0.012, z + 0.012), yellow)
    for k in range(18):
        x = -0.88 + 0.1 * k
        yield box((x, -0.07, 0.64), (x + 0.008, 0.07, 0.648), yellow)
        yield box((x, -0.004, 0.64), (x + 0.008, 0.004, 0.77), yellow)
    yield box((0.62, -0.1, 0.42), (0.82, 0.1, 0.64), stripes("6b6f73", "3d4144", 0.03))
    yield box((0.22, -0.1, 0.46), (0.42, 0.1, 0.62), checks("d9dde0", "7c98a8", 0.05), 0.6)
    # what hangs from it
    for x, z, r in ((-0.8, -0.05, 0.09), (-0.5, 0.2, 0.07), (-0.2, 0.05, 0.05)):
        yield can(x, 0.0, 0.006, z, 0.64, steel)
        yield ball(x, 0.0, z, r, stripes("3f6e8c", "e7e0cf", 0.03, upright=False))
    # house, stack of boards, fence, mast
    yield box((-0.7, -0.3, -0.53), (-0.28, 0.3, -0.22), spines(0.07, ("7c3b32", "b0894a"), 4))
    for k in range(6):
        z = -0.22 + 0.03 * k
        yield box((-0.72 + 0.04 * k, -0.34, z), (-0.26 - 0.04 * k, 0.34, z + 0.03), red)
    for k in range(5):
        z = -0.53 + 0.05 * k
        yield box((0.62, -0.6 + 0.02 * k, z), (0.9, -0.3, z + 0.025), wood, 0.05)
    for k in range(16):
        yield can(-0.9 + 0.12 * k, 0.66, 0.01, -0.53, -0.3, plain("e6dcc6"))
    for z in (-0.47, -0.36):
        yield box((-0.92, 0.655, z), (0.92, 0.665, z + 0.018), plain("e6dcc6"))
    yield can(-0.84, -0.6, 0.008, -0.53, 0.3, steel)
    yield ball(-0.84, -0.6, 0.33, 0.04, red)


@lru_cache(maxsize=1)
def tracer() -> Tracer:
    """The lit object; built once per process."""
    spread = np.stack(np.meshgrid([-0.3, 0.0, 0.3], [-0.3, 0.0, 0.3], [0.0])).reshape(3, -1)
    sun = Light(
        points=6.0 * SUN[:, None] + spread, facing=(0.0, 0.0, 0.0), power=(26.0, 25.0, 23.0)
    )
    return Tracer(list(solids()), [sun], (0.45, 0.47, 0.5), spacing=0.02)


def photograph(camera: Camera) -> np.ndarray:
    """The object as a camera sees it, [H, W, 4] uint8 with straight alpha."""
    Lacquer.eye = camera.position
    over_room = tracer().image(camera, SAMPLES)
    fine = Camera(
        width=SAMPLES * camera.width,
        height=SAMPLES * camera.height,
        fx=SAMPLES * camera.fx,
        fy=SAMPLES * camera.fy,
        cx=SAMPLES * camera.cx,
        cy=SAMPLES * camera.cy,
        c2w=camera.c2w,
    )
    is_object = tracer().depth(fine) < np.linalg.norm(camera.position) + RADIUS
    parts = is_object.reshape(camera.height, SAMPLES, camera.width, SAMPLES)
    alpha = parts.mean(axis=(1, 3))[..., None]
    # The pixel's light is that of the object and of the white room, each by its share.
    light = (over_room / 255.0) ** 2.2 - (1.0 - alpha)
    rgb = np.clip(light / np.maximum(alpha, 1e-9), 0.0, 1.0) ** (1 / 2.2)
    rgba = np.concatenate([rgb * (alpha > 0.0), alpha], axis=2)
    return np.rint(255.0 * rgba).astype(np.uint8)


def poses(n: int, seed: int) -> Iterator[np.ndarray]:
    """c2w [3, 4] of cameras at random on the upper half of a sphere, looking at its middle."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        azimuth, up = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.05, 0.98)
        flat = np.sqrt(1.0 - up * up)
        back = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), up])
        right = np.cross((0.0, 0.0, 1.0), back)
        right /= np.linalg.norm(right)
        yield np.stack([right, np.cross(back, right), back, AWAY * back], axis=1)


def turning() -> np.ndarray:
    """The rotation of the object against the axes, [3, 3]: a point p comes to turning() @ p."""
    cosine, sine = np.cos(TURN), np.sin(TURN)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _write(job: tuple[Path, np.ndarray, int]) -> None:
    path, c2w, size = job
    focal = 0.5 * size / np.tan(0.5 * ANGLE_X)
    camera = Camera(
        width=size, height=size, fx=focal, fy=focal, cx=0.5 * size, cy=0.5 * size, c2w=c2w
    )
    Image.fromarray(photograph(camera)).save(path)


def write_scan(
    folder: Path, n_views: dict[str, int], size: int = 800, workers: int | None = None
) -> None:
    """Write photographs and frames.

    Args:
        folder: New; receives transforms_train.json and the others, and the images.
        n_views: Photographs of each split: train, val, test.
        size: Width and height, pixels.
        workers: Processes; None: one for each core.
    """
    turn = turning()
    jobs = []
    for seed, (split, n) in enumerate(n_views.items()):
        (folder / split).mkdir(parents=True)
        frames = []
        for number, c2w in enumerate(poses(n, seed)):
            jobs.append((folder / split / f"r_{number}.png", c2w, size))
            turned = np.vstack([turn @ c2w, [0.0, 0.0, 0.0, 1.0]])
            frames.append(
                {"file_path": f"./{split}/r_{number}", "transform_matrix": turned.tolist()}
            )
        text = json.dumps({"camera_angle_x": ANGLE_X, "frames": frames}, indent=1)
        (folder / f"transforms_{split}.json").write_text(text)
    with ProcessPoolExecutor(workers or usable_cores(), get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(_write, jobs), start=1):
            if done % 10 == 0:
                print(f"{done} of {len(jobs)} photographs", flush=True)


def main() -> None:
    """Write the folder that is requested."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="new")
    parser.add_argument("--size", type=int, default=800, help="width and height, pixels")
    parser.add_argument("--views", type=int, nargs=3, default=(100, 10, 50), help="train val test")
    parser.add_argument("--workers", type=int, help="processes, by default one for each core")
    args = parser.parse_args()
    if args.folder.exists():
        parser.error(f"{args.folder} exists; name a new folder.")
    write_scan(
        args.folder,
        dict(zip(("train", "val", "test"), args.views, strict=True)),
        args.size,
        args.workers,
    )


if __name__ == "__main__":
    main()
