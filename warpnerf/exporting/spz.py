"""Gaussian splats in Niantic's compressed format, .spz, version 2: about a seventh of a PLY file.

Format: https://github.com/nianticlabs/spz. A gzip stream of a header of 16 bytes, then for all
splats positions (three fixed-point numbers of 24 bits), opacities, colours, logarithms of scales
and quaternions (8 bits per number). Axes are right, up, back. Version 2 is what readers of later
versions read, too.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct

import numpy as np

from warpnerf.checks import InputError
from warpnerf.exporting.splats import FIRST_HARMONIC, Splats
from warpnerf.scenes.cameras.quaternions import quaternions, to_y

log = logging.getLogger(__name__)

MAGIC, VERSION = 0x5053474E, 2

LARGEST = 2**23 - 1
"""Of a coordinate, in units of the last bit."""

FINEST = 23
"""Bits behind the point, at most."""

COLOUR_STEP = 0.15
"""Of a coefficient of the constant harmonic: the byte is 255 (0.5 + 0.15 f_dc)."""

SMALLEST_SCALE, SCALE_STEPS = -10.0, 16.0
"""Natural logarithm of the smallest scale, and steps in a unit of the logarithm."""

COARSEST = 0.25
"""Step of a position, in median scales of splats, at most."""


def splats_spz(splats: Splats, up: np.ndarray | None = None) -> list[bytes]:
    """Compress Gaussian splats as an .spz file.

    Args:
        splats: To write, in scene units. Those that lie so far out that fewer bits would be left
            for all others are dropped.
        up: Direction in which the cameras stand upright, [3] unit vector, which is turned to y;
            None: y.

    Returns:
        The pieces of the file.

    Raises:
        InputError: Scales are smaller or larger than the format has.
    """
    logs = np.log(splats.scales.astype(np.float64))
    middle = float(np.median(logs))
    largest_scale = SMALLEST_SCALE + 255.0 / SCALE_STEPS
    if not SMALLEST_SCALE <= middle <= largest_scale:
        raise InputError(
            f"the splats are {math.exp(middle):.2g} scene units large, and .spz has sizes from "
            f"{math.exp(SMALLEST_SCALE):.1g} to {math.exp(largest_scale):.0f}; write .splat.ply."
        )
    turn = to_y(up)
    points = splats.centres.astype(np.float64) @ turn.T
    reach = np.abs(points).max(axis=1)
    least_bits = math.ceil(-math.log2(COARSEST * math.exp(middle)))
    kept = reach * 2.0**least_bits <= LARGEST
    if not kept.any():
        raise InputError("the scene lies too far from its origin for .spz; write .splat.ply.")
    bits = min(FINEST, math.floor(math.log2(LARGEST / max(float(reach[kept].max()), 1e-30))))
    if bits < 0:
        raise InputError("the scene is too large for .spz; write .splat.ply.")
    _say_losses(int((~kept).sum()), int((logs[kept] > largest_scale).any(axis=1).sum()), len(kept))
    fixed = np.round(points[kept] * 2.0**bits).astype("<i4")
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]
    coefficients = (splats.rgb[kept] - 0.5) / FIRST_HARMONIC
    vector = _vectors(turned(splats.rotations[kept].astype(np.float64), turn))
    parts = (
        positions,
        _bytes(255.0 * splats.opacity[kept]),
        _bytes(255.0 * (0.5 + COLOUR_STEP * coefficients)),
        _bytes(SCALE_STEPS * (logs[kept] - SMALLEST_SCALE)),
        _bytes(127.5 * (1.0 + vector)),
    )
    header = struct.pack("<IIIBBBB", MAGIC, VERSION, int(kept.sum()), 0, bits, 0, 0)
    content = b"".join([header, *(part.tobytes() for part in parts)])
    return [gzip.compress(content, mtime=0)]


def _say_losses(dropped: int, cut: int, n: int) -> None:
    """Log what the format cannot hold."""
    if dropped:
        log.info(f"{dropped} of {n} splats lie too far out for .spz and are left out")
    if cut:
        log.info(f"{cut} of {n} splats are larger than .spz has sizes for, and made smaller")


def turned(rotations: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Quaternions w, x, y, z [n, 4] after a further rotation [3, 3]."""
    a = quaternions(turn[None])[0]
    w = a[0] * rotations[:, :1] - rotations[:, 1:] @ a[1:, None]
    vector = a[0] * rotations[:, 1:] + rotations[:, :1] * a[1:] + np.cross(a[1:], rotations[:, 1:])
    return np.concatenate([w, vector], axis=1)


def _vectors(rotations: np.ndarray) -> np.ndarray:
    """What is written of quaternions w, x, y, z [n, 4]: x, y, z [n, 3], with w positive.

    A half turn about a splat's own axis does not change it. Of the four such quaternions that with
    the largest w is written: it is rebuilt from x, y, z, and coarsely where it is small.
    """
    w, x, y, z = rotations.T
    same = np.array([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]])
    best = np.abs(same[:, 0]).argmax(axis=0)
    chosen = same[best, :, np.arange(len(w))]
    return np.asarray(np.where(chosen[:, :1] < 0.0, -1.0, 1.0) * chosen[:, 1:])


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(np.clip(values, 0.0, 255.0)).astype(np.uint8)
