"""The sharp frames of a video, as pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from warpnerf.checks import InputError, require_extra
from warpnerf.scenes.formats.contents import NEEDED

if TYPE_CHECKING:
    import av

MEASURED_WIDTH = 960
"""Pixels of a row in which sharpness is measured: what is blurred there is blurred for training."""

QUALITY = 95
"""Of the JPEG files."""


def sharp_frames(
    video: Path, folder: Path, n_frames: int, on_frame: Callable[[float], None]
) -> list[Path]:
    """Write the sharpest frame of each of as many equal parts of a video.

    The video is read once, and two frames of it are in memory at a time. They are turned upright
    where the video says how.

    Args:
        video: A file that PyAV reads.
        folder: For frame_00001.jpg and so on; made here.
        n_frames: Parts; of a video with fewer frames, all are written.
        on_frame: Called with the share of the video that is read, [0, 1].

    Returns:
        The pictures, in order of time.

    Raises:
        InputError: It is no video, is damaged, or too short; or PyAV is missing.
        OSError: The folder cannot be written.
    """
    require_extra("av", "sfm", f"{video}: reading a video")
    import av

    folder.mkdir(parents=True, exist_ok=True)
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise InputError(f"{video}: holds no pictures, only sound; name a video.")
            pictures = _sharpest(container, video, folder, n_frames, on_frame)
    except av.error.FFmpegError as error:
        raise InputError(
            f"{video}: is not readable as a video ({error.strerror}); copy it again, or convert it "
            "to MP4."
        ) from None
    if len(pictures) < NEEDED:
        raise InputError(
            f"{video}: has {len(pictures)} frames, and poses need at least {NEEDED}; name a longer "
            "video."
        )
    return pictures


def sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian of a gray picture, [H, W]: large where edges are sharp."""
    pixels = gray.astype(np.float32)
    middle = pixels[1:-1, 1:-1]
    across = pixels[1:-1, :-2] + pixels[1:-1, 2:]
    along = pixels[:-2, 1:-1] + pixels[2:, 1:-1]
    return float((across + along - 4.0 * middle).var())


def _sharpest(
    container: av.container.InputContainer,
    video: Path,
    folder: Path,
    n_frames: int,
    on_frame: Callable[[float], None],
) -> list[Path]:
    stream = container.streams.video[0]
    stream.thread_type = "AUTO"
    start, seconds = _times(container, video)
    pictures: list[Path] = []
    part, best, best_frame = 0, -1.0, None

    def keep() -> None:
        if best_frame is not None:
            path = folder / f"frame_{len(pictures) + 1:05}.jpg"
            image = Image.fromarray(_upright(best_frame))
            image.save(path, quality=QUALITY, subsampling=0)
            pictures.append(path)

    for frame in container.decode(stream):
        if frame.time is None:
            continue
        share = min(max((frame.time - start) / seconds, 0.0), 1.0)
        here = min(int(share * n_frames), n_frames - 1)
        if here != part:
            keep()
            part, best, best_frame = here, -1.0, None
        found = sharpness(_gray(frame))
        if found > best:
            best, best_frame = found, frame
        on_frame(share)
    keep()
    return pictures


def _times(container: av.container.InputContainer, video: Path) -> tuple[float, float]:
    """Time of the first frame, and seconds from there to the end of the last."""
    stream = container.streams.video[0]
    start = float((stream.start_time or 0) * stream.time_base)
    if stream.duration is not None:
        seconds = float(stream.duration * stream.time_base)
    elif container.duration is not None:
        seconds = container.duration / 1e6
    else:  # as browsers record: the packets say it, which are not decoded
        times = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
        seconds = float((max(times, default=0) + 1) * stream.time_base) - start
        container.seek(0)
    if not seconds > 0.0:
        raise InputError(f"{video}: has no frames; copy it again, or convert it to MP4.")
    return start, seconds


def _gray(frame: Any) -> np.ndarray:
    """[H, W] uint8, reduced to ``MEASURED_WIDTH``."""
    width = min(frame.width, MEASURED_WIDTH)
    height = max(3, round(frame.height * width / frame.width))
    return frame.reformat(width=width, height=height, format="gray").to_ndarray()


def _upright(frame: Any) -> np.ndarray:
    """[H, W, 3] uint8 rgb, turned as the video says."""
    return np.rot90(frame.to_ndarray(format="rgb24"), round(frame.rotation / 90.0))
