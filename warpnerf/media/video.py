"""Moving pictures to files: H.264 in MP4 and ProRes 4444 in MOV where PyAV is installed, GIF, or a
folder of PNG files.

A file is written whole or not at all, and so is a folder.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from collections.abc import Iterator
from fractions import Fraction
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from warpnerf.checks import InputError, require_extra, require_positive
from warpnerf.media.pictures import png
from warpnerf.writing import temporary_name, write_atomically

QUALITY = "18"
"""Constant rate factor of H.264: hardly to be told from the original."""

MIN_FPS = 0.02
"""A frame in fifty seconds; slower pauses have no place in the formats."""

MAX_FPS = 1000.0
MAX_GIF_FPS = 50.0
"""Pauses in a GIF are hundredths of a second, and viewers slow down a pause of one."""


def video_file(path: str | Path, fps: float) -> tuple[Path, str | None]:
    """Where a video will go, and in which format: .mp4, .mov, .gif, or without an ending a folder.

    Args:
        path: As it was requested.
        fps: Frames per second.

    Returns:
        The path, .gif instead of .mp4 where PyAV is missing, and what has to be said about that.

    Raises:
        InputError: Another ending, a frame rate that the format does not have, or a place that
            cannot be written to.
    """
    path = Path(path)
    require_positive("the frame rate", fps)
    note = None
    if path.suffix == ".mp4" and importlib.util.find_spec("av") is None:
        path = path.with_suffix(".gif")
        note = f'PyAV is not installed (pip install "warpnerf[video]"): writing {path} instead'
    if path.suffix == ".mov":
        require_extra("av", "video", "a video (.mov)")
    if fps < MIN_FPS:
        raise InputError(f"{path}: at least {MIN_FPS:g} frames per second, not {fps:g}.")
    limit = MAX_GIF_FPS if path.suffix == ".gif" else MAX_FPS
    if fps > limit:
        raise InputError(
            f"{path}: has at most {limit:g} frames per second, not {fps:g}; use a lower frame rate."
        )
    if path.suffix not in (".mp4", ".gif", ".mov", ""):
        raise InputError(
            f"{path}: no such video format; let the name end in .mp4 or .gif (.mov for ProRes with "
            "alpha), or in nothing for a folder of PNG files."
        )
    if not path.parent.is_dir():
        raise InputError(f"{path}: its folder does not exist; make it first.")
    if path.suffix and path.is_dir():
        raise InputError(f"{path}: is a folder; choose another name.")
    if not path.suffix and path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(f"{path}: exists already; name a new folder for the PNG files.")
    if not os.access(path.parent, os.W_OK):
        raise InputError(f"{path}: its folder cannot be written to; choose another one.")
    return path, note


def write_video(path: str | Path, frames: Iterator[np.ndarray], fps: float) -> Path:
    """Write a video, as the ending of its name says; see ``video_file``.

    Args:
        path: Of the file, or of a folder for PNG files. An older file is replaced.
        frames: [H, W, 3] uint8 each, or [H, W, 4] with alpha for .mov and PNG files, all of one
            size; at least one.
        fps: Frames per second.

    Returns:
        Where it went: .gif instead of .mp4 where PyAV is missing.

    Raises:
        InputError: As ``video_file``.
        OSError: It cannot be written; what was there before is left as it was.
    """
    path, _ = video_file(path, fps)
    if path.suffix == ".mp4":
        write_atomically(path, _encoded(frames, fps, "mp4"))
    elif path.suffix == ".mov":
        write_atomically(path, _encoded(frames, fps, "mov"))
    elif path.suffix == ".gif":
        write_atomically(path, _gif(frames, fps))
    else:
        _write_folder(path, frames)
    return path


def require_alpha(path: str | Path, transparent: bool) -> None:
    """Raise InputError where a video of this name has no alpha channel, and one is wanted."""
    if transparent and Path(path).suffix not in (".mov", ""):
        raise InputError(
            f"{path}: this format has no transparency; let the name end in .mov (ProRes 4444), or "
            "in nothing for a folder of PNG files."
        )


def _encoded(frames: Iterator[np.ndarray], fps: float, container_name: str) -> memoryview:
    """H.264, 4:2:0, in MP4, or ProRes 4444 with alpha in MOV. Edges are repeated to even sizes."""
    import av

    rate = Fraction(fps).limit_denominator(1001)
    first = _even(next(frames))
    file = BytesIO()
    with av.open(file, "w", format=container_name) as container:
        if container_name == "mp4":
            stream = container.add_stream("h264", rate=rate, options={"crf": QUALITY})
            stream.pix_fmt = "yuv420p"
        else:
            stream = container.add_stream("prores_ks", rate=rate, options={"profile": "4444"})
            stream.pix_fmt = "yuva444p10le"
        stream.height, stream.width = first.shape[:2]
        kind = "rgb24" if first.shape[2] == 3 else "rgba"
        for pixels in _chain(first, map(_even, frames)):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format=kind)))
        container.mux(stream.encode(None))
    return file.getbuffer()


def _even(pixels: np.ndarray) -> np.ndarray:
    height, width = pixels.shape[:2]
    return np.pad(pixels, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")


def _gif(frames: Iterator[np.ndarray], fps: float) -> memoryview:
    """256 colours for each frame, repeated for ever."""
    pictures = _timed(frames, fps)
    file = BytesIO()
    next(pictures).save(file, "GIF", save_all=True, append_images=pictures, loop=0)
    return file.getbuffer()


def _timed(frames: Iterator[np.ndarray], fps: float) -> Iterator[Image.Image]:
    """Pictures with their pauses, milliseconds: in hundredths, which add up to the video's time."""
    for number, pixels in enumerate(frames):
        picture = Image.fromarray(pixels)
        begin, end = (10 * round(100.0 * n / fps) for n in (number, number + 1))
        picture.info["duration"] = end - begin
        yield picture


def _write_folder(path: Path, frames: Iterator[np.ndarray]) -> None:
    temporary = path.with_name(temporary_name(path.name))
    temporary.mkdir()
    try:
        for number, pixels in enumerate(frames):
            (temporary / f"{number:05}.png").write_bytes(png(pixels))
        temporary.replace(path)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _chain(first: np.ndarray, rest: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    yield first
    yield from rest
