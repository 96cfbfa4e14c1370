"""Camera paths of nerfstudio: what its viewer and its Blender add-on save as camera_path.json.

Each frame has ``camera_to_world``, 16 numbers row by row in OpenGL axes, and ``fov``, the vertical
field of view in degrees. They lie in nerfstudio's own coordinates: those of the photographs' poses,
turned, moved and scaled by what its runs keep as dataparser_transforms.json.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from warpnerf.checks import InputError
from warpnerf.media.camera_path import MAX_SIDE
from warpnerf.media.recorded_path import MAX_KEYS, Key, RecordedPath, checked_path
from warpnerf.scenes.files import read_json

TRANSFORMS = "dataparser_transforms.json"
"""Name of the file that says how nerfstudio's coordinates lie, in the folder of its run."""


class Frame(msgspec.Struct):
    """A frame of a path."""

    camera_to_world: list[float]
    fov: float


class CameraPath(msgspec.Struct):
    """camera_path.json, as far as it is read."""

    camera_path: list[Frame]
    render_width: float
    render_height: float
    camera_type: str = "perspective"
    fps: float | None = None
    seconds: float | None = None


class Applied(msgspec.Struct):
    """transforms.json, as far as it tells what its poses were before: p of the scene was at
    applied_scale * (applied_transform @ (p, 1))."""

    applied_transform: list[list[float]] = msgspec.field(default_factory=np.eye(4).tolist)
    applied_scale: float = 1.0


class Transforms(msgspec.Struct):
    """dataparser_transforms.json: what p was before that is at scale * (transform @ (p, 1))."""

    transform: list[list[float]]
    scale: float


def read_nerfstudio_path(
    path: Path,
    transforms: Path | None,
    scene: Path | None = None,
    offset: Sequence[float] | None = None,
) -> RecordedPath:
    """Read a camera path of nerfstudio in a scene's coordinates.

    Args:
        path: Of camera_path.json.
        transforms: Of dataparser_transforms.json; None: the path is in the scene's coordinates.
        scene: Folder or transforms.json of the scene, whose ``applied_transform`` and
            ``applied_scale`` are in what ``transforms`` holds; None, or without that file: none.
        offset: [3] what the scene's coordinates are less than those of its file; None: nothing.

    Returns:
        A path whose keys are the frames, with their number per second.

    Raises:
        InputError: A file cannot be read, or holds what no camera can do.
    """
    read = read_json(path, CameraPath)
    if read.camera_type != "perspective":
        raise InputError(
            f"{path}: camera_type is {read.camera_type}, but only perspective is rendered; save "
            "the path with perspective cameras."
        )
    n = len(read.camera_path)
    if not 1 <= n <= MAX_KEYS:
        raise InputError(f"{path}: camera_path has {n} frames, but must have 1 to {MAX_KEYS}.")
    sizes = (read.render_width, read.render_height)
    if not all(1 <= side <= MAX_SIDE for side in sizes):
        raise InputError(f"{path}: render_width and render_height must be 1 to {MAX_SIDE} pixels.")
    wrong = next((k for k, f in enumerate(read.camera_path) if len(f.camera_to_world) != 16), None)
    if wrong is not None:
        raise InputError(f"{path}: camera_path[{wrong}].camera_to_world must be 16 numbers.")
    poses = np.array([frame.camera_to_world for frame in read.camera_path]).reshape(n, 4, 4)[:, :3]
    if transforms is not None:
        poses = _in_scene(poses, transforms, _applied(scene))
    if offset is not None:
        poses[:, :, 3] -= np.asarray(offset)
    for name, value in (("fps", read.fps), ("seconds", read.seconds)):
        if value is not None and not 0.0 <= value < math.inf:
            raise InputError(f"{path}: {name} is {value:g}, but must be a number from 0 on.")
    fps = read.fps or 24.0
    seconds = read.seconds if read.seconds and not read.fps else n / fps
    times = np.linspace(0.0, seconds, n) if n > 1 else [0.0]
    keys = [
        Key(seconds=float(at), fov=frame.fov, c2w=pose.tolist())
        for at, frame, pose in zip(times, read.camera_path, poses, strict=True)
    ]
    width, height = map(round, sizes)
    return checked_path(RecordedPath(width=width, height=height, keys=keys, fps=n / seconds), path)


def _applied(scene: Path | None) -> Applied:
    """What a scene's transforms.json says was done to its poses before they were written."""
    file = None if scene is None else scene / "transforms.json" if scene.is_dir() else scene
    if file is None or file.suffix != ".json" or not file.is_file():
        return Applied()
    return read_json(file, Applied)


def _in_scene(poses: np.ndarray, transforms: Path, applied: Applied) -> np.ndarray:
    """Poses [n, 3, 4] of nerfstudio's coordinates in the scene's."""
    read = read_json(transforms, Transforms)
    shape = [len(row) for row in read.transform]
    if shape != [4, 4, 4] or not read.scale > 0.0:
        raise InputError(
            f"{transforms}: transform must be three rows of four numbers, and scale above 0; name "
            f"the {TRANSFORMS} of a nerfstudio run."
        )
    transform = np.array(read.transform)
    rotation, shift = transform[:, :3], transform[:, 3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3:
        raise InputError(f"{transforms}: transform must turn and move only.")
    moved = poses.copy()
    moved[:, :, :3] = rotation.T @ poses[:, :, :3]
    moved[:, :, 3] = (poses[:, :, 3] / read.scale - shift) @ rotation
    before = np.array(applied.applied_transform)
    if before.shape not in ((3, 4), (4, 4)):
        raise InputError(f"{transforms}: applied_transform of the scene must be 3 x 4 numbers.")
    moved[:, :, :3] = before[:3, :3] @ moved[:, :, :3]
    moved[:, :, 3] = applied.applied_scale * (moved[:, :, 3] @ before[:3, :3].T + before[:3, 3])
    return moved
