"""A camera path in a file: places that a camera passes, and when. The viewer records them.

    {
      "warpnerf_path": 1,
      "width": 1280, "height": 720,
      "keys": [
        {"seconds": 0.0, "fov": 50.0, "c2w": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3]]},
        {"seconds": 2.0, "fov": 50.0, "c2w": [[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 3]]}
      ]
    }

``c2w`` is camera to world in OpenGL axes and scene units, ``fov`` the vertical field of view in
degrees.
"""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np

from warpnerf.checked import checked_arguments
from warpnerf.checks import InputError
from warpnerf.media.camera_path import MAX_SIDE, require_frames, spline
from warpnerf.scenes.cameras.camera import Camera
from warpnerf.scenes.files import read_json

VERSION = 1
MAX_KEYS = 10_000
MAX_SECONDS = 86_400.0
MAX_COORDINATE = 1e9
"""Scene units."""
MIN_FOV, MAX_FOV = 1.0, 170.0
"""Degrees."""
RIGID = 1e-3
"""How far axes of a pose may be from being of unit length, and at right angles."""


class Key(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A keyframe: a place that the camera passes."""

    seconds: float
    """When, from the beginning."""
    fov: float
    """Vertical field of view, degrees."""
    c2w: list[list[float]]
    """[3, 4] camera to world, OpenGL axes, scene units."""


class RecordedPath(msgspec.Struct, frozen=True, kw_only=True, eq=False):
    """A camera path with keyframes, as its file has it."""

    warpnerf_path: int = VERSION
    """The version of the format."""
    width: int
    """Of the picture, pixels."""
    height: int
    """Of the picture, pixels."""
    keys: list[Key]
    """In the order of their times; at least one."""
    fps: float | msgspec.UnsetType = msgspec.UNSET
    """Frames per second, where a key is a frame; unset: any number."""

    @property
    def seconds(self) -> float:
        """The duration in seconds."""
        return self.keys[-1].seconds - self.keys[0].seconds

    def to_json(self) -> bytes:
        """The camera path as JSON, the content of its file."""
        return msgspec.json.format(msgspec.json.encode(self), indent=1) + b"\n"

    @checked_arguments
    def cameras(self, n_frames: int, size: tuple[int, int] | None = None) -> list[Camera]:
        """Cameras along a smooth path through the keys, at times evenly spread.

        Args:
            n_frames: How many, from the first key to the last.
            size: Width and height, pixels; None: those of the file.

        Returns:
            n_frames cameras; a single key stands still.

        Raises:
            InputError: A width or height is not from 1 to MAX_SIDE, or n_frames not from 1 to
                MAX_FRAMES.
        """
        require_frames(n_frames)
        width, height = size or (self.width, self.height)
        for name, side in (("width", width), ("height", height)):
            if not 1 <= side <= MAX_SIDE:
                raise InputError(f"the {name} is {side} pixels; choose one of 1 to {MAX_SIDE}.")
        times = [key.seconds for key in self.keys]
        at = np.linspace(times[0], times[-1], n_frames)
        fovs = np.interp(at, times, [key.fov for key in self.keys])
        poses = np.array([key.c2w for key in self.keys], np.float64)
        if len(poses) > 1:
            poses = spline(poses, np.interp(at, times, np.arange(len(poses), dtype=float)))
        else:
            poses = np.repeat(poses, n_frames, axis=0)
        cameras = []
        for pose, fov in zip(poses, fovs, strict=True):
            focal = 0.5 * height / math.tan(math.radians(0.5 * fov))
            cameras.append(
                Camera(
                    width=width,
                    height=height,
                    fx=focal,
                    fy=focal,
                    cx=0.5 * width,
                    cy=0.5 * height,
                    c2w=pose,
                )
            )
        return cameras


@checked_arguments
def read_path(path: str | Path) -> RecordedPath:
    """Read a camera path from its file.

    Args:
        path: Of the file; the viewer saves such.

    Returns:
        The path; its ``cameras`` make a video with ``render_video``.

    Raises:
        InputError: It cannot be read, is no path, or holds what no camera can do.
    """
    path = Path(path)
    return checked_path(read_json(path, RecordedPath), path)


def checked_path(recorded: RecordedPath, path: Path) -> RecordedPath:
    """The same camera path.

    Args:
        recorded: What was read.
        path: Of its file, for messages.

    Raises:
        InputError: It holds what no camera can do.
    """
    if recorded.warpnerf_path != VERSION:
        raise InputError(
            f"{path}: warpnerf_path is {recorded.warpnerf_path}, but this version of warpnerf "
            f"reads {VERSION}; record the path again."
        )
    for name in ("width", "height"):
        if not 1 <= getattr(recorded, name) <= MAX_SIDE:
            raise InputError(
                f"{path}: {name} is {getattr(recorded, name)}, but must be 1 to {MAX_SIDE} pixels; "
                "correct it there."
            )
    if not 1 <= len(recorded.keys) <= MAX_KEYS:
        raise InputError(
            f"{path}: keys are {len(recorded.keys)}, but must be 1 to {MAX_KEYS}; record the path "
            "again."
        )
    for index, key in enumerate(recorded.keys):
        wrong = _wrong(key, recorded.keys[index - 1] if index else None)
        if wrong:
            raise InputError(f"{path}: keys[{index}].{wrong}; correct it there.")
    return recorded


def _wrong(key: Key, before: Key | None) -> str | None:
    """What is wrong with a key, beginning with the field."""
    if not 0.0 <= key.seconds <= MAX_SECONDS:
        return f"seconds is {key.seconds:g}, but must be from 0 to {MAX_SECONDS:g}"
    if before is not None and key.seconds <= before.seconds:
        return f"seconds is {key.seconds:g}, but must be later than the key before"
    if not MIN_FOV <= key.fov <= MAX_FOV:
        return f"fov is {key.fov:g}, but must be from {MIN_FOV:g} to {MAX_FOV:g} degrees"
    if [len(row) for row in key.c2w] != [4, 4, 4]:
        return "c2w must be three rows of four numbers"
    pose = np.array(key.c2w)
    if np.abs(pose).max() > MAX_COORDINATE:
        return f"c2w holds {np.abs(pose).max():.3g}, which is too far away"
    axes = pose[:, :3]
    if np.abs(axes.T @ axes - np.eye(3)).max() > RIGID or np.linalg.det(axes) < 0.0:
        return "c2w must turn and move only: unit axes at right angles, right-handed"
    return None
