"""Georeferenced captures: coordinates of a country, as UTM, are centred on their cameras.

Single precision, which kernels work in, has seven digits: of positions in millions of metres none
would be left for what the photographs show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpnerf.scenes.extent.points import Points
from warpnerf.scenes.formats.frame import Frame

FAR_OFF = 1e3
"""Cameras farther from the origin than so many times their median distance from their middle are
centred; nearer ones keep their coordinates."""


def centred(
    frames: Sequence[Frame], points: Points | None
) -> tuple[list[Frame], Points | None, np.ndarray | None]:
    """Centre poses and points that lie far from the origin, in double precision.

    Args:
        frames: At least one.
        points: Of the scene, if it has some.

    Returns:
        Frames and points, and what was subtracted from their coordinates, [3] scene units, a round
        number; None: nothing was.
    """
    places = np.array([frame.c2w[:, 3] for frame in frames])
    middle = np.median(places, axis=0)
    spread = float(np.median(np.linalg.norm(places - middle, axis=1)))
    if not (spread > 0.0 and np.abs(middle).max() > FAR_OFF * spread):
        return list(frames), points, None
    unit = 10.0 ** math.floor(math.log10(spread))
    offset = unit * np.round(middle / unit)
    back = np.concatenate([np.zeros((3, 3)), offset[:, None]], axis=1)
    frames = [replace(frame, c2w=frame.c2w - back) for frame in frames]
    if points is not None:
        points = replace(points, positions=points.positions - offset)
    return frames, points, offset


def in_words(offset: np.ndarray) -> str:
    """An offset as it is shown."""
    return f"({', '.join(f'{value:.12g}' for value in offset)})"
