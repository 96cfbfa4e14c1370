"""Photographs of the built-in room as people take them.

    python benchmarks/room_scan.py path/to/new/folder --size 320 240

Who takes them turns around in its middle, walks around its table, far from it or close, or does
both. A COLMAP text model beside them holds points of the room's surfaces with the photographs that
show them, as structure from motion would find them: with noise, and with a share of outliers far
behind the walls and close before the cameras.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from warpnerf.scenes.builtin.room import first_hit, photograph
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.cameras.quaternions import quaternions
from warpnerf.scenes.cameras.undistort import directions

NOISE = 0.005
"""Of a point's distance, standard deviation."""
GRAIN = (7.0, 17.0, 41.0, 83.0)
"""Frequencies of the noise on grainy surfaces, 1 / metre."""
GRAIN_CONTRAST = 0.15
"""Of each of them."""
OUTLIERS = 0.03
"""Share of points along their ray anywhere from 0.02 to 5 times as far."""


def scan_cameras(n: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Cameras within 0.75 m of the room's middle, 0.8 to 1.9 m high, that look away from it."""
    rng = np.random.default_rng(seed)
    cameras: list[Camera] = []
    while len(cameras) < n:
        angle = 2.0 * np.pi * (len(cameras) * 0.381966 + rng.uniform(-0.02, 0.02))
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([0.25, 0.0, 0.0]) + rng.uniform(0.25, 0.75) * out
        eye[2] = rng.uniform(0.8, 1.9)
        turned = angle + rng.uniform(-0.4, 0.4)
        ahead = np.array([np.cos(turned), np.sin(turned), rng.uniform(-0.35, 0.25)])
        cameras += _standing(eye, ahead, width, height)
    return cameras


def inward_cameras(n: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Cameras on an oval around the table, 1 to 1.8 m high, that look at it."""
    rng = np.random.default_rng(seed)
    cameras: list[Camera] = []
    for k in itertools.count():
        if len(cameras) == n:
            return cameras
        angle = 2.0 * np.pi * (k * 0.381966 + rng.uniform(-0.02, 0.02))
        eye = np.array([0.1 + rng.uniform(1.1, 1.5) * np.cos(angle), 0.0, rng.uniform(1.0, 1.8)])
        eye[1] = rng.uniform(1.4, 1.9) * np.sin(angle)
        target = [-0.2, 0.0, 0.57] + rng.uniform(-0.2, 0.2, 3) * [1.0, 1.0, 0.6]
        cameras += _standing(eye, target - eye, width, height)
    return cameras


def table_cameras(n: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Cameras close around the table, 0.6 to 1.1 m high, that look at what stands on it."""
    rng = np.random.default_rng(seed)
    cameras: list[Camera] = []
    for k in itertools.count():
        if len(cameras) == n:
            return cameras
        angle = 2.0 * np.pi * (k * 0.381966 + rng.uniform(-0.02, 0.02))
        away = rng.uniform(0.45, 0.65) * np.array([np.cos(angle), np.sin(angle), 0.0])
        eye = np.array([-0.3, 0.05, rng.uniform(0.6, 1.1)]) + away
        target = np.array([-0.3, 0.05, 0.6]) + rng.uniform(-0.08, 0.08, 3)
        cameras += _standing(eye, target - eye, width, height)


def mixed_cameras(n: int, width: int, height: int, seed: int = 0) -> list[Camera]:
    """Half of them look inward, half outward."""
    inward = inward_cameras(n // 2, width, height, seed)
    return inward + scan_cameras(n - n // 2, width, height, seed)


def _standing(eye: np.ndarray, ahead: np.ndarray, width: int, height: int) -> list[Camera]:
    """An upright camera, 65 degrees wide, none where something stands right before it."""
    focal = 0.5 * width / np.tan(np.radians(65.0) / 2.0)
    back = -ahead / np.linalg.norm(ahead)
    right = np.cross((0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    if first_hit(eye[None], -back[None])[0] <= 0.3:
        return []
    return [
        Camera(
            width=width,
            height=height,
            fx=focal,
            fy=focal,
            cx=0.5 * width,
            cy=0.5 * height,
            c2w=np.stack([right, np.cross(back, right), back, eye], axis=1),
        )
    ]


SCANS: dict[str, Callable[[int, int, int], list[Camera]]] = {
    "room-scan": scan_cameras,
    "room-inward": inward_cameras,
    "room-table": table_cameras,
    "room-mixed": mixed_cameras,
}
"""The cameras of each capture, by how many there are, and width and height of its pictures."""


def write_scan(
    folder: Path,
    n_views: int = 125,
    n_points: int = 4000,
    size: tuple[int, int] = (160, 120),
    scan: str = "room-scan",
    *,
    grainy: bool = False,
) -> float:
    """Write photographs and model.

    Args:
        folder: New; receives images/ and sparse/0/.
        n_views: Photographs.
        n_points: Of the model.
        size: Width and height, pixels.
        scan: One of SCANS.
        grainy: Whether all surfaces have a grain down to a centimetre, as real ones do.

    Returns:
        The median true distance over all pixels, metres.
    """
    (folder / "images").mkdir(parents=True)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    cameras = SCANS[scan](n_views, *size)
    depths = []
    poses = ["# Images"]
    for number, camera in enumerate(cameras):
        rgb, depth = photograph(camera)
        if grainy:
            rgb = _with_grain(camera, rgb, depth)
        depths.append(depth)
        Image.fromarray(rgb).save(folder / f"images/{number:04}.png")
        rotation = (camera.c2w[:, :3] * [1.0, -1.0, -1.0]).T
        numbers = [*quaternions(rotation[None])[0], *(-rotation @ camera.position)]
        poses += [f"{number + 1} {' '.join(map(repr, map(float, numbers)))} 1 {number:04}.png", ""]
    camera = cameras[0]
    lens = f"{float(camera.fx)} {camera.cx} {camera.cy}"
    (model / "cameras.txt").write_text(f"1 SIMPLE_PINHOLE {size[0]} {size[1]} {lens}\n")
    (model / "images.txt").write_text("\n".join(poses) + "\n")
    lines = [
        f"{number + 1} {' '.join(map(repr, map(float, point)))} 0 0 0 1.0 "
        + " ".join(f"{view + 1} 0" for view in views)
        for number, (point, views) in enumerate(_points(cameras, depths, n_points))
    ]
    (model / "points3D.txt").write_text("\n".join(lines) + "\n")
    return float(np.median(np.stack(depths)))


def _with_grain(camera: Camera, rgb: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """A photograph, [H, W, 3] uint8, with a grain on the surfaces at these depths, [H, W]."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays = directions(camera, pixels) @ camera.c2w[:, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    places = camera.position + depth.reshape(-1, 1) * rays
    grain = sum(_noise(places * frequency) for frequency in GRAIN)
    shaded = rgb.reshape(-1, 3) * (1.0 + GRAIN_CONTRAST * np.asarray(grain)[:, None])
    return np.clip(shaded, 0.0, 255.0).astype(np.uint8).reshape(rgb.shape)


def _noise(places: np.ndarray) -> np.ndarray:
    """Value noise of period 1 at places [n, 3]: [n] in [-1, 1]. See Ebert et al. 2003."""
    corner = np.floor(places).astype(np.int64)
    share = places - corner
    share = share * share * (3.0 - 2.0 * share)
    value = np.zeros(len(places))
    for offset in itertools.product((0, 1), repeat=3):
        i, j, k = (corner + offset).T
        mixed = (i * 0x9E3779B1) ^ (j * 0x85EBCA77) ^ (k * 0xC2B2AE3D)
        mixed = (mixed ^ (mixed >> 15)) * 0x2C1B3C6D & 0xFFFFFFFF
        weight = np.where(np.array(offset) == 1, share, 1.0 - share).prod(axis=1)
        value += weight * (((mixed >> 8) & 0xFFFF) / 32767.5 - 1.0)
    return value


def _points(
    cameras: list[Camera], depths: list[np.ndarray], n_points: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points at random pixels, and the numbers of the cameras that see them."""
    rng = np.random.default_rng(1)
    found = []
    while len(found) < n_points:
        k = int(rng.integers(len(cameras)))
        camera = cameras[k]
        u, v = rng.integers(camera.width), rng.integers(camera.height)
        sight = [(u + 0.5 - camera.cx) / camera.fx, (camera.cy - v - 0.5) / camera.fy, -1.0]
        ray = camera.c2w[:, :3] @ (np.array(sight) / np.linalg.norm(sight))
        point = camera.position + depths[k][v, u] * ray
        views = _sees(cameras, point)
        if len(views) < 2:
            continue
        far = depths[k][v, u] * (1.0 + rng.normal(0.0, NOISE))
        if rng.uniform() < OUTLIERS:
            far *= np.exp(rng.uniform(np.log(0.02), np.log(5.0)))
        found.append((camera.position + far * ray, views))
    return found


def _sees(cameras: list[Camera], point: np.ndarray) -> np.ndarray:
    """The cameras that have a point in their picture, with nothing before it."""
    origins = np.array([camera.position for camera in cameras])
    away = np.linalg.norm(point - origins, axis=1)
    directions = (point - origins) / away[:, None]
    inside = np.zeros(len(cameras), bool)
    for k, camera in enumerate(cameras):
        x, y, z = camera.c2w[:, :3].T @ directions[k]
        if z < 0.0:
            inside[k] = abs(camera.fx * x / z) < camera.cx and abs(camera.fy * y / z) < camera.cy
    candidates = np.flatnonzero(inside)
    hits = first_hit(origins[candidates], directions[candidates])
    return candidates[hits >= 0.999 * away[candidates]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("folder", type=Path, help="new, receives images/ and sparse/0/")
    parser.add_argument("--scan", choices=list(SCANS), default="room-scan")
    parser.add_argument("--views", type=int, default=125)
    parser.add_argument("--size", type=int, nargs=2, default=(160, 120), help="width, height")
    parser.add_argument("--grainy", action="store_true", help="all surfaces have a fine grain")
    parser.add_argument("--points", type=int, default=4000, help="of the model; 0: none")
    args = parser.parse_args()
    size = tuple(args.size)
    write_scan(args.folder, args.views, args.points, size, args.scan, grainy=args.grainy)


if __name__ == "__main__":
    main()
