"""The configuration of camera pose estimation by structure from motion."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from warpnerf.checked import checked
from warpnerf.checks import InputError, require_one_of, require_whole, said

CameraModel = Literal[
    "auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"
]
Matching = Literal["auto", "exhaustive", "sequential"]
Mapper = Literal["incremental", "global"]
Lenses = Literal["auto", "one", "each"]


MAX_SIZE = 100_000
"""Pixels of a photograph's longer side."""


@checked("")
@dataclass(frozen=True, kw_only=True)
class PoseConfig:
    """The configuration of camera pose estimation by structure from motion."""

    camera_model: CameraModel = "auto"
    """Of the lens, as COLMAP names it; auto: RADIAL, but SIMPLE_RADIAL where fewer than ten
    photographs share one. OPENCV also finds a focal length of its own for each direction and
    tangential distortion, for which the camera must have been turned or moved in all directions."""
    lenses: Lenses = "auto"
    """Which photographs share a lens: those of one size, camera and focal length by EXIF (auto),
    all (one), or none (each)."""
    matching: Matching = "auto"
    """Which pairs are compared: all (exhaustive), those near each other by name (sequential);
    auto: sequential for videos and more than 200 photographs."""
    mapper: Mapper = "incremental"
    """One photograph after the other, or all at once (global), which is faster where they are
    many."""
    frames: int = 150
    """Taken from a video."""
    max_image_size: int = 1600
    """Longer side, pixels, to which photographs are reduced to look for features."""
    masks: Path | None = None
    """Folder of masks; nothing is looked for where they are black."""
    threads: int | None = None
    """CPU threads, at most one per usable core, which is the default."""

    def __post_init__(self) -> None:
        """Refuse what is none of these.

        Raises:
            InputError: A value is out of its range.
        """
        choices = {
            "camera_model": CameraModel,
            "lenses": Lenses,
            "matching": Matching,
            "mapper": Mapper,
        }
        for name, kind in choices.items():
            require_one_of(name, getattr(self, name), get_args(kind))
        require_whole("frames", self.frames, 3)
        require_whole("max_image_size", self.max_image_size, 100)
        if self.max_image_size > MAX_SIZE:
            raise InputError(
                f"max_image_size must be at most {MAX_SIZE}, not {said(self.max_image_size)}."
            )
        if self.threads is not None:
            require_whole("threads", self.threads, 1)
        if self.masks is not None and not Path(self.masks).is_dir():
            raise InputError(f"masks: {self.masks} is no folder; name the folder of the masks.")
