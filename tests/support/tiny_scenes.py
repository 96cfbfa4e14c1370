"""Scene folders of a few small images, for tests to break in one place each."""

from __future__ import annotations

import json
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.scene import Scene, View

DATA = Path(os.environ.get("WARPNERF_DATA", Path(__file__).parents[3] / "shared" / "data"))


def needs_capture(name: str) -> pytest.MarkDecorator:
    """Skip where a real capture is not on this machine."""
    return pytest.mark.skipif(
        not (DATA / name).is_dir(), reason=f"no capture {name} in {DATA}; set WARPNERF_DATA"
    )


def look_at(position: tuple[float, float, float], target: tuple[float, float, float]) -> np.ndarray:
    """[4, 4] camera to world, OpenGL axes, z up."""
    back = np.subtract(position, target).astype(np.float64)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, np.array(position, float)], axis=1)
    return pose


def ring(n: int, *, radius: float = 3.0, height: float = 1.0) -> list[np.ndarray]:
    """Poses on a circle that look at the origin."""
    angles = 2.0 * np.pi * np.arange(n) / n
    return [
        look_at((radius * np.cos(a), radius * np.sin(a), height), (0.0, 0.0, 0.0)) for a in angles
    ]


def camera_at(pose: np.ndarray, **changes: Any) -> Camera:
    values = {"width": 8, "height": 6, "fx": 10.0, "fy": 10.0, "cx": 4.0, "cy": 3.0} | changes
    return Camera(c2w=pose[:3], **values)


def picture(seed: int, *, width: int = 8, height: int = 6, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def transforms_content(n: int, scale: int = 1) -> dict[str, Any]:
    """What ``write_transforms`` writes."""
    lens = {"fl_x": 10.0, "fl_y": 11.0, "cx": 4.25, "cy": 2.75, "w": 8, "h": 6}
    lens = {key: scale * value for key, value in lens.items()}
    frames = [
        {"file_path": f"images/{i:03d}.png", "transform_matrix": pose.tolist()}
        for i, pose in enumerate(ring(n))
    ]
    return {**lens, "frames": frames}


def write_transforms(folder: Path, n: int = 4, scale: int = 1) -> dict[str, Any]:
    """A transforms.json with its images; returns the content, to be changed and saved again."""
    (folder / "images").mkdir(parents=True)
    for i in range(n):
        pixels = picture(i, width=8 * scale, height=6 * scale)
        Image.fromarray(pixels).save(folder / f"images/{i:03d}.png")
    content = transforms_content(n, scale)
    save(folder / "transforms.json", content)
    return content


def write_blender(folder: Path, split: str, poses: list[np.ndarray], *, channels: int = 4) -> Any:
    (folder / split).mkdir(parents=True)
    frames = []
    for i, pose in enumerate(poses):
        Image.fromarray(picture(i, channels=channels)).save(folder / f"{split}/r_{i}.png")
        frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
    content = {"camera_angle_x": 0.6911112070083618, "frames": frames}
    save(folder / f"transforms_{split}.json", content)
    return content


def save(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content))


def hand_made_png(
    path: Path,
    *,
    size: tuple[int, int],
    depth: int,
    colour: int,
    raw: bytes,
    transparent: bytes = b"",
) -> Path:
    """A PNG that Pillow does not write; raw rows begin with their filter byte."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + kind
            + content
            + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", *size, depth, colour, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + (chunk(b"tRNS", transparent) if transparent else b"")
        + chunk(b"IDAT", zlib.compress(raw))
        + chunk(b"IEND", b"")
    )
    return path


def tiny_scene(poses: list[np.ndarray], **lens: Any) -> Scene:
    """A scene made by hand: noise seen from these poses, the last one for testing."""
    views = []
    for i, pose in enumerate(poses):
        camera = camera_at(pose, **lens)
        pixels = picture(i, width=camera.width, height=camera.height)
        views.append(View(name=f"{i:03}.png", camera=camera, image=pixels))
    return Scene(
        name="tiny",
        views=views,
        splits={"train": tuple(range(len(poses) - 1)), "test": (len(poses) - 1,)},
        box_min=np.full(3, -1.0),
        box_max=np.full(3, 1.0),
        unbounded=False,
        content_distance=3.0,
    )
