"""The points of a COLMAP model, points3D.bin or points3D.txt, and which photograph shows which.

Where these are not there, or empty, points3D.ply takes their place, as 3DGS and exporters write it.
"""

from __future__ import annotations

import os
import struct
from array import array
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.extent.points import Points, usable
from warpnerf.scenes.files import exists, require_regular_file
from warpnerf.scenes.formats.colmap_models import model_kind
from warpnerf.scenes.formats.ply import read_ply

HEAD_BYTES = 8 + 3 * 8 + 3 + 8
"""Of a point in points3D.bin before its track: number, position, colour, error."""
TRACK_BYTES = 4 + 4
"""Of an entry of a track: the image's number, and which of its keypoints it is."""
PLY = "points3D.ply"
MAX_LINE = 2**22
"""Characters of a line of points3D.txt: a track of some 300 000 photographs."""


class UnusablePlyError(InputError):
    """A points3D.ply beside a model, which other programs write in forms of their own."""


def read_points(model: Path, images: Mapping[int, str], folder: Path) -> Points | None:
    """Read the points of a model.

    Args:
        model: Its folder.
        images: Names of its photographs, by their numbers in the model.
        folder: The scene's folder, which ``Points.source`` is relative to.

    Returns:
        The points, with the indices of those that each photograph shows, but for points3D.ply,
        which does not tell; None without such a file.

    Raises:
        UnusablePlyError: There is none but a points3D.ply that cannot be read.
        InputError: The file is damaged.
    """
    found: Points | None = None
    forms = [("points3D.bin", _of_bytes), ("points3D.txt", _of_text)]
    for name, read in reversed(forms) if model_kind(model) == "txt" else forms:
        file = model / name
        if not exists(file):
            continue
        require_regular_file(file)
        try:
            positions, numbers, lengths = read(file)
        except OSError as error:
            raise InputError(
                f"{file}: cannot be read: {error.strerror or error}; change that, or move it away."
            ) from None
        except MemoryError:
            raise InputError(
                f"{file}: has {file.stat().st_size / 1e9:.3g} GB, more than the memory that is "
                "free; move it away, as training does without points, or filter them."
            ) from None
        source = Path(os.path.relpath(file, folder)).as_posix()
        found = _tracked(positions, numbers, lengths, images, source)
        break
    if found is not None and len(found.positions):
        return found
    for place in _up_to(model, folder):
        file = place / PLY
        if exists(file):
            try:
                positions = read_ply(file)
            except InputError as error:
                raise UnusablePlyError(str(error)) from None
            source = Path(os.path.relpath(file, folder)).as_posix()
            return Points(positions=positions[usable(positions)], tracks=None, source=source)
    return found


def _up_to(model: Path, folder: Path) -> list[Path]:
    """A model's folder and those around it, to the scene's."""
    places = [model.resolve(), *model.resolve().parents]
    end = folder.resolve()
    return places[: places.index(end) + 1] if end in places else places[:1]


def _tracked(
    positions: np.ndarray,
    numbers: np.ndarray,
    lengths: np.ndarray,
    images: Mapping[int, str],
    source: str,
) -> Points:
    """Points by photograph, from the photographs of each point."""
    kept = usable(positions)
    if not lengths.any():  # some programs write points without tracks
        return Points(positions=positions[kept], tracks=None, source=source)
    index = np.repeat(np.where(kept, np.cumsum(kept) - 1, -1).astype(np.int32), lengths)
    numbers, index = numbers[index >= 0], index[index >= 0]
    order = np.argsort(numbers, kind="stable")
    numbers, index = numbers[order], index[order]
    tracks = {
        name: index[np.searchsorted(numbers, n) : np.searchsorted(numbers, n, "right")]
        for n, name in images.items()
    }
    return Points(positions=positions[kept], tracks=tracks, source=source)


def _of_bytes(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions [n, 3], image numbers of all tracks in a row, lengths of the tracks [n]."""
    data = file.read_bytes()
    if len(data) < 8:
        raise _damaged(file, f"ends after {len(data)} bytes")
    (count,) = struct.unpack_from("<Q", data)
    if 8 + count * (HEAD_BYTES + 8) > len(data):
        raise _damaged(file, f"counts {count} points, but ends before")
    positions = bytearray()
    tracks = bytearray()
    lengths = np.empty(count, np.int64)
    at = 8
    for point in range(count):
        begin = at + HEAD_BYTES + 8
        if begin > len(data):
            raise _damaged(file, f"ends within its point {point}")
        (length,) = struct.unpack_from("<Q", data, at + HEAD_BYTES)
        end = begin + length * TRACK_BYTES
        if end > len(data):
            raise _damaged(file, f"ends within its point {point}")
        positions += data[at + 8 : at + 32]
        tracks += data[begin:end]
        lengths[point] = length
        at = end
    where = np.frombuffer(positions, "<f8").astype(np.float64).reshape(-1, 3)
    return where, np.frombuffer(tracks, "<u4")[::2], lengths


def _of_text(file: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """As ``_of_bytes``, from lines of id, position, colour, error, and the track."""
    positions, numbers, lengths = array("d"), array("I"), array("q")
    with file.open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in enumerate(iter(lambda: lines.readline(MAX_LINE), ""), 1):
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            try:
                x, y, z = map(float, words[1:4])
                if len(words) < 8 or len(words) % 2 or len(line) == MAX_LINE:
                    raise ValueError
                positions.extend((x, y, z))
                numbers.extend(map(int, words[8::2]))
            except (ValueError, OverflowError):
                raise _damaged(file, f"has no point as COLMAP writes it in line {number}") from None
            lengths.append(len(words) // 2 - 4)
    where = np.array(positions, np.float64).reshape(-1, 3)
    return where, np.array(numbers, np.uint32), np.array(lengths, np.int64)


def _damaged(file: Path, how: str) -> InputError:
    return InputError(f"{file}: {how}; export it again, or move it away: points are optional.")
