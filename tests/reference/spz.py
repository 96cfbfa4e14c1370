"""A reader of .spz files, written from the format's description, which shares no code with ours."""

from __future__ import annotations

import math
import zlib
from typing import Any


def read_spz(data: bytes) -> list[dict[str, Any]]:
    """The splats of a file of version 2 without higher harmonics, one at a time."""
    raw = zlib.decompress(data, wbits=16 + zlib.MAX_WBITS)
    assert raw[:4] == b"NGSP"
    version, count = (int.from_bytes(raw[at : at + 4], "little") for at in (4, 8))
    degree, fraction, flags, reserved = raw[12:16]
    assert (version, degree, flags, reserved) == (2, 0, 0, 0)
    starts, at = {}, 16
    for name, size in (("place", 9), ("alpha", 1), ("colour", 3), ("scale", 3), ("turn", 3)):
        starts[name] = at
        at += size * count
    assert len(raw) == at
    splats = []
    for n in range(count):
        place = [
            int.from_bytes(raw[k : k + 3], "little", signed=True) / 2**fraction
            for k in range(starts["place"] + 9 * n, starts["place"] + 9 * n + 9, 3)
        ]
        colour = [
            0.5 + 0.28209479177387814 * (b / 255 - 0.5) / 0.15
            for b in raw[starts["colour"] + 3 * n :][:3]
        ]
        scale = [math.exp(b / 16 - 10) for b in raw[starts["scale"] + 3 * n :][:3]]
        x, y, z = (b / 127.5 - 1 for b in raw[starts["turn"] + 3 * n :][:3])
        w = math.sqrt(max(0.0, 1 - x * x - y * y - z * z))
        splats.append(
            {
                "place": place,
                "alpha": raw[starts["alpha"] + n] / 255,
                "rgb": colour,
                "scale": scale,
                "wxyz": [w, x, y, z],
            }
        )
    return splats
