"""Scenes whose files are damaged, or say what cannot be."""

from __future__ import annotations

import json
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.fuzz_readers import FORMATS, MUTATIONS
from tests.hostile.running import Case, fresh
from tests.hostile.values import JSON, mutated
from tests.support.cli_process import TINY
from tests.support.tiny_scenes import picture, ring, write_blender, write_transforms

NUMBERS = ("0", "-1", "nan", "inf", "1e300", "1e999", "", "x", "9" * 30, "0.0", "-0", "4294967296")
"""In place of a number in text."""

NAMES = (
    ".",
    "..",
    "/",
    "",
    "a/../../b",
    "images",
    "x" * 300,
    "\\",
    "~",
    "a\tb",
    "\u202e",
    "000.png",
)
"""In place of the name of a photograph."""


def words_for(rng: random.Random, scene: str) -> list[str]:
    """A command that reads a scene."""
    if rng.random() < 0.12:
        return ["train", scene, "--output", "out/run", *TINY, "--eval-views", "1"]
    extra = rng.choice(
        ([], [], [], ["--json", "out.json"], ["--downscale", "2"], ["--output", "out.png"])
    )
    return ["inspect", scene, *extra]


def bytes_changed(rng: random.Random, file: Path) -> None:
    """Mutate a file as ``fuzz_readers`` does."""
    raw = file.read_bytes()
    for _ in range(rng.choice((1, 1, 2))):
        raw = rng.choice(MUTATIONS)(rng, raw) if raw else raw
    file.write_bytes(raw)


def number_changed(rng: random.Random, file: Path) -> None:
    """Another number, name or none at all where a word of a text file stands."""
    lines = file.read_text(errors="replace").splitlines()
    rows = [k for k, line in enumerate(lines) if line and not line.startswith("#")]
    at = rng.choice(rows or [0])
    words = lines[at].split(" ") if lines else [""]
    change = rng.random()
    k = rng.randrange(len(words))
    if change < 0.6:
        words[k] = rng.choice(NUMBERS)
    elif change < 0.75:
        words[-1] = rng.choice(NAMES)
    elif change < 0.85:
        del words[k:]
    lines = lines or [""]
    lines[at] = " ".join(words)
    if change > 0.95:
        lines.insert(at, lines[rng.randrange(len(lines))])
    elif change > 0.9:
        del lines[at]
    file.write_text("\n".join(lines) + "\n")


def colmap(rng: random.Random, folder: Path) -> Case:
    """A model in text or binary with one file changed."""
    name = rng.choice([n for n in FORMATS if n.startswith("colmap-")])
    file = FORMATS[name](fresh(folder) / "scene")
    if file.suffix == ".txt" and rng.random() < 0.7:
        number_changed(rng, file)
    else:
        bytes_changed(rng, file)
    return Case(words=words_for(rng, "scene"), said=name)


def hostile_array(rng: random.Random, array: np.ndarray) -> np.ndarray:
    """An array of another shape, type or content."""
    array = np.array(array)
    number = rng.choice((np.nan, np.inf, -np.inf, 0.0, -1.0, 1e30, 1e300, 1e-300))
    change = rng.randrange(10)
    if change < 4 and array.size and array.dtype.kind == "f":
        array.flat[rng.randrange(array.size)] = number
        return array
    if change == 4 and array.dtype.kind == "f":
        return np.full_like(array, number)
    if change == 5 and array.ndim:
        return np.delete(array, rng.randrange(array.shape[-1]), axis=-1)
    if change == 6:
        return array[: rng.randrange(len(array))] if array.ndim else array.reshape(1, 1)
    if change == 7:
        return array.astype(rng.choice(["f2", "i4", "c8", "U3", "?", ">f8", "u1", "S2"]))
    if change == 8:
        return array.reshape(-1) if array.ndim != 1 else array[None, None]
    return array * number


HEADERS = (
    "{'descr': '<f8', 'fortran_order': False, 'shape': (True, 17), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-4, 17), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4, 17.0), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': 17, }",
    "{'descr': '<f8', 'fortran_order': 3, 'shape': (4, 17), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (4, 17), }",
    "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (4, 17), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4294967296, 4294967296), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (4, '17'), }",
    "{'descr': None, 'fortran_order': False, 'shape': (4, 17), }",
    "{'descr': '<f8', 'shape': (4, 17), }",
    "[" * 300,
    "",
)


def header_changed(rng: random.Random, raw: bytes) -> bytes:
    """An .npy file with another header."""
    size = struct.unpack("<H", raw[8:10])[0]
    header = rng.choice(HEADERS).encode()
    return raw[:8] + struct.pack("<H", len(header)) + header + raw[10 + size :]


def llff(rng: random.Random, folder: Path) -> Case:
    """poses_bounds.npy with other numbers, or another header."""
    file = FORMATS["llff"](fresh(folder) / "scene")
    change = rng.random()
    if change < 0.5:
        np.save(file, hostile_array(rng, np.load(file)))
    elif change < 0.6:
        array = np.load(file)
        array[:, -2:] = array[:, -1:-3:-1] * rng.choice((1.0, 0.0, -1.0))  # near behind far
        np.save(file, array)
    elif change < 0.8:
        file.write_bytes(header_changed(rng, file.read_bytes()))
    else:
        bytes_changed(rng, file)
    return Case(words=words_for(rng, "scene"), said="llff")


def npz(rng: random.Random, folder: Path) -> Case:
    """Arrays of other shapes, types and numbers, under these and other names."""
    file = FORMATS["npz"](fresh(folder) / "scene")
    if rng.random() < 0.2:
        bytes_changed(rng, file)
        return Case(words=words_for(rng, "scene/scene.npz"), said="npz, bytes")
    with np.load(file) as given:
        arrays = dict(given)
    name = rng.choice(sorted(arrays))
    change = rng.random()
    if change < 0.8:
        arrays[name] = hostile_array(rng, arrays[name])
    elif change < 0.9:
        del arrays[name]
    else:
        arrays[rng.choice(("H", "images", "x" * 200, "../x", ""))] = np.zeros(3)
    np.savez(file, **arrays)
    return Case(words=words_for(rng, "scene/scene.npz"), said=f"npz, {name}")


EXTRAS: tuple[dict[str, Any], ...] = (
    {},
    {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.01, "k3": 0.0, "k4": 0.0},
    {"camera_model": "OPENCV", "k1": 0.1, "k2": 0.01, "p1": 0.001, "p2": 0.0},
    {"train_filenames": ["images/000.png", "images/001.png"], "test_filenames": ["images/002.png"]},
    {"aabb_scale": 4, "scale": 1.0, "offset": [0, 0, 0], "applied_transform": [[1, 0, 0, 0]] * 3},
    {"depth_unit_scale_factor": 0.001, "applied_scale": 2.0, "mask_path": "images/000.png"},
)


def transforms(rng: random.Random, folder: Path) -> Case:
    """transforms.json with other values at some of its places."""
    scene = fresh(folder) / "scene"
    if rng.random() < 0.15:
        content: Any = write_blender(scene, "train", ring(4))
        file = scene / "transforms_train.json"
    else:
        content = write_transforms(scene) | rng.choice(EXTRAS)
        file = scene / "transforms.json"
        if rng.random() < 0.2:
            lens = {key: content[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")}
            content["frames"] = [{**lens, **frame} for frame in content["frames"]]
    if rng.random() < 0.1:
        key = rng.choice(("k1", "k2", "k3", "k4", "p1", "fl_x", "camera_angle_x", "cx", "w"))
        content[key] = rng.choice((1e300, -1e300, 1e30, -1.0, 1e-300, 0))
    else:
        content = mutated(rng, content)
    text = json.dumps(content)
    if rng.random() < 0.05:
        text = rng.choice(("\ufeff", "", "[" * 3000, "{" * 50_000, "null", "//")) + text
    file.write_text(text, encoding="utf-8", errors="surrogatepass")
    return Case(words=words_for(rng, "scene"), said="transforms")


def _as_link(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.name)


def _as_folder(file: Path) -> None:
    file.unlink()
    file.mkdir()


def _as_pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def _as_device(file: Path) -> None:
    file.unlink()
    file.symlink_to("/dev/zero")


PLACES: tuple[Callable[[Path], None], ...] = (
    *(_as_link, _as_folder, _as_pipe, _as_device, Path.unlink),
    lambda file: file.write_bytes(b""),
)
"""What may stand where a file is expected."""


def _other_picture(rng: random.Random, file: Path) -> None:
    size = rng.choice(((1, 1), (8, 6), (6, 8), (16, 12), (7, 6), (4000, 1)))
    mode = rng.choice(
        ("RGB", "RGBA", "L", "LA", "P", "1", "I", "F", "CMYK", "YCbCr", "I;16", "HSV")
    )
    kind = rng.choice(("PNG", "JPEG", "GIF", "TIFF", "BMP", "WEBP", "PPM", "ICO", "PDF", "TGA"))
    try:
        Image.new(mode, size).save(file, format=kind)
    except (OSError, ValueError, KeyError):
        Image.fromarray(picture(1)).save(file)


def photographs(rng: random.Random, folder: Path) -> Case:
    """A photograph that is damaged, of another kind or size, or no file."""
    scene = fresh(folder) / "scene"
    content = write_transforms(scene)
    file = scene / "images" / f"00{rng.randrange(4)}.png"
    change = rng.random()
    if change < 0.4:
        bytes_changed(rng, file)
    elif change < 0.7:
        _other_picture(rng, file)
    elif change < 0.9:
        rng.choice(PLACES)(file)
    else:
        name = rng.choice([n for n in NAMES if n] + [str(value) for value in JSON[:12]])
        content["frames"][0]["file_path"] = name
        (scene / "transforms.json").write_text(json.dumps(content))
    if rng.random() < 0.15:  # without poses; too few to be posed, so COLMAP is not begun
        (scene / "transforms.json").unlink()
        (scene / "images" / "003.png").unlink(missing_ok=True) if file.name != "003.png" else None
        return Case(words=["inspect", "scene"], said="photographs without poses")
    return Case(words=words_for(rng, "scene"), said=f"photographs, {file.name}")
