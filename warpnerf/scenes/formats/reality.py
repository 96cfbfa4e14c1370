"""RealityCapture's and RealityScan's CSV of internal and external camera parameters.

A row for each photograph: name, x, y, alt; heading, pitch and roll in degrees; the focal length f
for a film 36 mm wide; the principal point px, py from the middle, in the longer side of the image;
and Brown's distortion k1 to k4, t1, t2. With no angle, a camera looks down, north at its top.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from warpnerf.checks import InputError
from warpnerf.scenes.cameras.brown import brown_lens
from warpnerf.scenes.cameras.lens import Lens
from warpnerf.scenes.cameras.poses import check_pose
from warpnerf.scenes.files import MAX_JSON_BYTES, beginning, printable, require_regular_file
from warpnerf.scenes.formats.assemble import Reading
from warpnerf.scenes.formats.found_photographs import (
    Entry,
    Photographs,
    PosedCamera,
    scene_of,
)
from warpnerf.scenes.images.images import image_size
from warpnerf.scenes.scene import Scene

NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns without which there are no cameras."""
OPTIONAL = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
"""Columns that a template may leave out: 0."""
FILM = 36.0
"""Millimetres that the longer side of an image is wide."""
LOOKED_AT = 4096
"""Bytes at the beginning of a file by which it is recognised."""
DELIMITERS = ",;\t"


def find_reality(folder: Path) -> list[Path]:
    """Files of cameras in a folder, by name."""
    try:
        files = [path for path in folder.iterdir() if path.suffix.lower() == ".csv"]
    except OSError:
        return []
    return [path for path in sorted(files) if is_reality(path)]


def is_reality(file: Path) -> bool:
    """Whether a file's header has the columns of cameras."""
    try:
        if not file.is_file():
            return False
        with file.open("rb") as stream:
            head = stream.read(LOOKED_AT)
    except OSError:
        return False
    return _header(head.decode(_encoding(head), "replace").splitlines()) is not None


def _encoding(head: bytes) -> str:
    """UTF-8, but UTF-16 where the byte-order mark says so."""
    return "utf-16" if head.startswith((b"\xff\xfe", b"\xfe\xff")) else "utf-8-sig"


def _header(lines: list[str]) -> tuple[int, str, list[str]] | None:
    """Which line is the header, what separates its columns, and their names; None: none is."""
    for number, line in enumerate(lines[:3]):
        for delimiter in DELIMITERS:
            names = [word.strip().lstrip("#").strip().lower() for word in line.split(delimiter)]
            if set(NEEDED) <= set(names):
                return number, delimiter, names
    return None


def load_reality(file: Path, reading: Reading) -> Scene:
    """Load a scene from RealityCapture's CSV.

    Args:
        file: The CSV.
        reading: How photographs are read.

    Returns:
        The scene, in the file's coordinates.

    Raises:
        InputError: The file is damaged, or no photograph is there.
    """

    def entry(place: str, name: str, row: Mapping[str, float]) -> Entry:
        def read(path: Path) -> PosedCamera:
            c2w = check_pose(_pose(row).tolist(), field=f"{file}: {place}: x, y, alt")
            return PosedCamera(c2w=c2w, lens=_lens(file, place, row, image_size(path)))

        return Entry(name=name, place=f"{file}: {place}", read=read)

    entries = [entry(*row) for row in _rows(file)]
    return scene_of(file, entries, Photographs(file.parent), reading)


def _rows(file: Path) -> list[tuple[str, str, dict[str, float]]]:
    """Of each row: its place in the file, its name, and its numbers by their columns."""
    require_regular_file(file)
    if file.stat().st_size > MAX_JSON_BYTES:
        raise InputError(f"{file}: is larger than {MAX_JSON_BYTES >> 20} MiB, so no cameras.")
    try:
        lines = file.read_text(encoding=_encoding(beginning(file, 2))).splitlines()
    except UnicodeDecodeError:
        raise InputError(
            f"{file}: cannot be decoded as text in UTF-8 or UTF-16; export it again."
        ) from None
    header = _header(lines)
    if header is None:
        raise InputError(
            f"{file}: its header lacks columns of {', '.join(NEEDED)}; export internal and "
            "external camera parameters."
        )
    start, delimiter, columns = header
    rows = []
    for number, line in enumerate(lines[start + 1 :], start + 2):
        if not line.strip() or line.startswith("#"):
            continue
        place = f"line {number}"
        try:
            words = next(csv.reader([line], delimiter=delimiter))
        except csv.Error as error:
            raise InputError(f"{file}: {place}: is no row: {error}; export it again.") from None
        if len(words) < len(columns):
            raise InputError(
                f"{file}: {place}: has {len(words)} columns, but the header {len(columns)}; export "
                "it again."
            )
        given = dict(zip(columns, words, strict=False))
        numbers = {}
        for column in (*NEEDED[1:], *OPTIONAL):
            word = given.get(column, "0")
            if delimiter != "," and "." not in word:  # of a country with decimal commas
                word = word.replace(",", ".")
            try:
                numbers[column] = float(word)
            except ValueError:
                numbers[column] = math.nan
            if not math.isfinite(numbers[column]):
                raise InputError(
                    f"{file}: {place}: {column}: {printable(word.strip()[:40])!r} is no finite "
                    "number; export it again."
                )
        rows.append((place, given["name"].strip(), numbers))
    if not rows:
        raise InputError(f"{file}: has no row below its header; export it again.")
    return rows


def _pose(row: Mapping[str, float]) -> np.ndarray:
    """Camera to world, [3, 4], OpenGL axes: heading clockwise from north, then pitch, then roll."""
    heading, pitch, roll = (math.radians(row[key]) for key in ("heading", "pitch", "roll"))
    turned = _about(2, -heading) @ _about(0, pitch) @ _about(1, roll)
    position = np.array([row["x"], row["y"], row["alt"]])
    return np.concatenate([turned, position[:, None]], axis=1)


def _about(axis: int, angle: float) -> np.ndarray:
    """The rotation about an axis, counterclockwise, radians."""
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[i, i] = turn[j, j] = math.cos(angle)
    turn[j, i] = math.sin(angle)
    turn[i, j] = -turn[j, i]
    return turn


def _lens(file: Path, place: str, row: Mapping[str, float], size: tuple[int, int]) -> Lens:
    """The lens of a row for a photograph of a size."""
    if row["f"] <= 0.0:
        raise InputError(f"{file}: {place}: f: {row['f']:g} is no focal length; export it again.")
    longer = max(size)
    focal = row["f"] * longer / FILM
    return brown_lens(
        file,
        place,
        {
            "fl_x": focal,
            "fl_y": focal,
            "cx": 0.5 * size[0] + row["px"] * longer,
            "cy": 0.5 * size[1] + row["py"] * longer,
        },  # the file does not say of what size photographs are, nor so whether they were turned
        radial=[row[f"k{i}"] for i in (1, 2, 3, 4)],
        tangential=[row["t1"], row["t2"], 0.0, 0.0],
    )
